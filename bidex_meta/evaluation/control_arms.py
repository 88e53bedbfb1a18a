"""The control of a meta-test: does adaptation learn from the task's own data?

Any further training may raise the return, even on data of another task. Therefore the agent adapts to the data of each
held-out task (*own*) and, from the same meta-parameters, to the data of each train task of the class (*foreign*). These
two, and the agent *before* adaptation, are called arms. They play with common random numbers: the same starts, the same
seed of the agent's own draws, the same number of episodes. The return of *own* minus that of *before* is the gain of
adaptation. The return of *own* minus that of *foreign* is the part of the gain that is due to the task's own data.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bidex_meta.agents import Agent
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.eval_protocol import Protocol
from bidex_meta.evaluation.gains import MEASURES, grouped
from bidex_meta.evaluation.meta_test import meta_evaluate
from bidex_meta.evaluation.play import DEFAULT
from bidex_meta.evaluation.references import Reference
from bidex_meta.evaluation.results import ClassResult, Difference, Evaluation
from bidex_meta.evaluation.statistics import paired_difference
from bidex_meta.runs.atomic import Json
from bidex_meta.world.contract import PooledWorld, TaskWorld


@dataclass(frozen=True)
class Control:
    """Results of the control experiment on one run's agent, on the same episodes in the same order.

    The agent was evaluated before adaptation, after adaptation to the tasks' own data, and after adaptation to data of
    each train task.
    """

    before: Evaluation
    own: Evaluation  # adapted to data of the tasks themselves
    foreign: list[Evaluation]  # adapted to data of each train task
    adaptations: dict[str, np.ndarray]  # by class, number of the adaptation before each episode, (episodes,)
    rollouts: int  # episodes of each task in a shot


def control(
    load: Callable[[], Agent], test_world: TaskWorld, train_world: PooledWorld, *, protocol: Protocol = DEFAULT,
    references: Mapping[str, Reference] | None = None, say: Callable[[str], None] = lambda line: None
) -> Control:  # fmt: skip
    """Run the control experiment of a meta-test, which compares adaptation to a task's own data and to other data.

    An agent is evaluated on test tasks before adaptation, after adaptation to their own data, and after adaptation to
    data of each train task. Each of these evaluations is called an arm and is run by ``meta_evaluate``. ``load`` makes
    a new MetaLearningAgent for each adaptation, so that all arms draw the same random numbers. ``say`` receives the
    mean returns of each arm when the arm is finished, which may take minutes.

    Both worlds must be in autoreset mode DISABLED and have the same number of environments. The task pools of
    ``train_world`` are replaced. Raises BidexError if the worlds have different classes, and the errors of
    ``meta_evaluate``.
    """
    if list(test_world.task_names) != list(train_world.task_names):
        raise BidexError(
            f"Expected the same classes in both splits, as ML1 has them; train: {', '.join(train_world.task_names)}; "
            f"test: {', '.join(test_world.task_names)}."
        )
    pools = train_world.pools
    shots = protocol.shots
    own = meta_evaluate(load(), test_world, protocol=protocol, references=references, evaluated=(0, shots))
    say(f"before: {_returns(own.before)}; adapted to own data: {_returns(own.after)}")
    foreign = []
    for number in range(max(map(len, pools))):
        chosen = {}
        for name, pool, size in zip(train_world.task_names, pools, test_world.num_slot_tasks, strict=True):
            chosen[name] = np.repeat(pool[[number % len(pool)]], size, axis=0)
        train_world.set_tasks(chosen)
        adapted = meta_evaluate(
            load(), test_world, protocol=protocol, references=references, adapt_world=train_world, evaluated=(shots,)
        )
        foreign.append(adapted.after)
        say(f"adapted to data of train task {number + 1} of {max(map(len, pools))}: {_returns(adapted.after)}")
    return Control(own.before, own.after, foreign, own.adaptations, own.rollouts)


def _returns(evaluation: Evaluation) -> str:
    return ", ".join(f"{name} {result.mean_return:.4g}" for name, result in evaluation.classes.items())


def arms(runs: Sequence[Control], class_name: str, names: Sequence[str]) -> dict[str, Json]:
    """Summarise the results of the control experiment in one class over several runs, one per seed.

    The result has an entry for each arm, that is, each condition of the experiment: ``before`` adaptation, after
    adaptation to the task's ``own`` data, and after adaptation to data of each train task, by its name in ``names``.
    The entry ``foreign`` is the mean over the train tasks.

    Each entry has ``return`` and ``success``, which are means over runs, and ``runs``, the mean return of each run.
    Every entry except ``own`` also has ``own_minus``. For each measure, it holds the paired difference ``own`` minus
    this arm, with an interval over runs, adaptations and episodes, or None if the measure is missing.
    """
    results_by_arm: dict[str, list[list[ClassResult]]] = {arm: [] for arm in ("before", "own", "foreign", *names)}
    for run in runs:
        foreign = [evaluation.classes[class_name] for evaluation in run.foreign]
        results_by_arm["before"].append([run.before.classes[class_name]])
        results_by_arm["own"].append([run.own.classes[class_name]])
        results_by_arm["foreign"].append(foreign)
        for i, name in enumerate(names):
            results_by_arm[name].append([foreign[i]])
    summaries: dict[str, Json] = {}
    for arm, results in results_by_arm.items():
        summaries[arm] = _summary(results)
        if arm != "own":
            minus = {measure: _own_minus(runs, results, class_name, of) for measure, of in MEASURES.items()}
            summaries[arm]["own_minus"] = minus
    return summaries


def _summary(results: Sequence[Sequence[ClassResult]]) -> Json:
    """Return the means of one arm's results, which are lists of one or several results per run."""
    returns = []
    successes = []
    for of_run in results:
        returns.append(float(np.mean([result.mean_return for result in of_run])))
        successes += [result.success for result in of_run]
    return {"return": float(np.mean(returns)), "success": float(np.mean(successes)), "runs": returns}


def _own_minus(
    runs: Sequence[Control], others: Sequence[Sequence[ClassResult]], class_name: str,
    of: Callable[[ClassResult], np.ndarray | None]
) -> Difference | None:  # fmt: skip
    """Return the result of adaptation to the tasks' own data minus the mean of other results, paired by episode.

    ``others`` holds, for each run, the results to average. ``of`` selects the measure. The difference has an interval;
    it is None if a measure is missing.
    """
    differences = []
    for run, of_run in zip(runs, others, strict=True):
        own = of(run.own.classes[class_name])
        foreign = [of(other) for other in of_run]
        known = [values for values in foreign if values is not None]
        if own is None or len(known) < len(foreign):
            return None
        differences.append(grouped(own - np.mean(known, axis=0), run.adaptations[class_name]))
    return paired_difference(np.stack(differences))
