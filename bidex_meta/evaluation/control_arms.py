"""The control of a meta-test: is it the task's own data that adaptation learns from?

Any further training may raise a return. So the held-out tasks are adapted to their own data and, from the same
meta-parameters, to data of each train task of their class. The arms play with common random numbers: the same starts,
the same seed of the agent's own draws, as many episodes. Own minus before is what adaptation gains; own minus foreign
is what of it is due to the task.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bidex_meta.agents import Agent
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.gains import MEASURES, grouped
from bidex_meta.evaluation.meta_test import meta_evaluate
from bidex_meta.evaluation.results import ClassResult, Difference, Evaluation
from bidex_meta.evaluation.statistics import paired_difference
from bidex_meta.runs.atomic import Json
from bidex_meta.world.contract import PooledWorld, TaskWorld


@dataclass(frozen=True)
class Control:
    """The arms of one run: the same episodes in the same order."""

    before: Evaluation
    own: Evaluation  # adapted to data of the tasks themselves
    foreign: list[Evaluation]  # adapted to data of each train task
    adaptations: dict[str, np.ndarray]  # per class the adaptation that each episode followed, (episodes,)
    rollouts: int  # episodes of each task in a shot


def control(
    load: Callable[[], Agent], test_world: TaskWorld, train_world: PooledWorld, shots: int = 1, *,
    say: Callable[[str], None] = lambda line: None, **played: Any
) -> Control:  # fmt: skip
    """Play all arms; ``played`` goes to ``meta_evaluate``, whose errors are raised.

    ``load`` returns the agent, a MetaLearningAgent, anew for each arm, so that all draw the same numbers. The worlds,
    in autoreset mode DISABLED, have as many environments and the same classes (else BidexError); ``train_world``'s
    pools are replaced. ``say`` gets the mean returns of each arm when it has been played, which may take minutes.
    """
    if list(test_world.task_names) != list(train_world.task_names):
        raise BidexError(
            f"Expected the same classes in both splits, as ML1 has them; train: {', '.join(train_world.task_names)}; "
            f"test: {', '.join(test_world.task_names)}."
        )
    pools = train_world.pools
    own = meta_evaluate(load(), test_world, shots, evaluated=(0, shots), **played)
    say(f"before: {_returns(own.before)}; adapted to own data: {_returns(own.after)}")
    foreign = []
    for number in range(max(map(len, pools))):
        sizes = zip(train_world.task_names, pools, test_world.num_slot_tasks, strict=True)
        train_world.set_tasks({name: np.repeat(pool[[number % len(pool)]], n, axis=0) for name, pool, n in sizes})
        found = meta_evaluate(load(), test_world, shots, adapt_world=train_world, evaluated=(shots,), **played)
        foreign.append(found.after)
        say(f"adapted to data of train task {number + 1} of {max(map(len, pools))}: {_returns(found.after)}")
    return Control(own.before, own.after, foreign, own.adaptations, own.rollouts)


def _returns(found: Evaluation) -> str:
    return ", ".join(f"{name} {result.mean_return:.4g}" for name, result in found.classes.items())


def arms(runs: Sequence[Control], class_name: str, names: Sequence[str]) -> dict[str, Json]:
    """Results of each arm in a class over all runs (one for each seed), and the gain of own data above it.

    By arm (``before``, ``own``, ``foreign`` for the mean over the train tasks, then these by their ``names``):
    ``return`` and ``success``, means over runs; ``runs``, the mean return of each; ``own_minus`` by measure, a
    Difference over runs, adaptations and episodes, or None where a measure is missing; none for ``own`` itself.
    """
    by_arm = {"before": [[run.before] for run in runs], "own": [[run.own] for run in runs]}
    by_arm["foreign"] = [run.foreign for run in runs]
    by_arm |= {name: [[run.foreign[i]] for run in runs] for i, name in enumerate(names)}
    found: dict[str, Json] = {}
    for arm, evaluations in by_arm.items():
        results = [[each.classes[class_name] for each in of_run] for of_run in evaluations]
        returns = [float(np.mean([each.mean_return for each in of_run])) for of_run in results]
        found[arm] = {
            "return": float(np.mean(returns)),
            "success": float(np.mean([each.success for of_run in results for each in of_run])),
            "runs": returns,
        }
        if arm != "own":
            minus = {measure: _own_minus(runs, results, class_name, of) for measure, of in MEASURES.items()}
            found[arm]["own_minus"] = minus
    return found


def _own_minus(
    runs: Sequence[Control], others: Sequence[Sequence[ClassResult]], class_name: str,
    of: Callable[[ClassResult], np.ndarray | None]
) -> Difference | None:  # fmt: skip
    """Return the paired difference of adaptation to own data and the mean of others."""
    differences = []
    for run, of_run in zip(runs, others, strict=True):
        own = of(run.own.classes[class_name])
        foreign = [of(other) for other in of_run]
        known = [values for values in foreign if values is not None]
        if own is None or len(known) < len(foreign):
            return None
        differences.append(grouped(own - np.mean(known, axis=0), run.adaptations[class_name]))
    return paired_difference(np.stack(differences))
