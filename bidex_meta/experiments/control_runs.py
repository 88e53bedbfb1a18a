"""Control experiment of adaptation: a policy adapts to a held-out task's own data, and to data of other tasks."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.comparison import run_kind
from bidex_meta.evaluation.control_arms import arms, control
from bidex_meta.evaluation.eval_protocol import Protocol
from bidex_meta.experiments import metatest
from bidex_meta.experiments.learners import learner_kind, resolve_device
from bidex_meta.experiments.policies import policy_loader
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.provenance import check_alike
from bidex_meta.training.launch import say
from bidex_meta.training.learner import Capability
from bidex_meta.world.threads import set_up_torch, torch_settings_kept
from bidex_meta.worlds import open_worlds
from bidex_meta.worlds.own import OwnSuite


@dataclass(frozen=True)
class ControlResult:
    """Result of the control experiment over all runs."""

    runs: list[str]  # the runs' folders
    title: str  # learner and suite
    shots: int
    trials: int
    rollouts: int  # episodes of each task in a shot
    episodes: dict[str, int]  # evaluation episodes of one arm, by class
    classes: dict[str, dict[str, Json]]  # results by class and arm, from ``arms``

    def to_json(self) -> Json:
        """Return the result with plain values, ready for JSON."""
        entries = {name: value for name, value in vars(self).items() if name not in ("title", "classes")}
        classes = {name: {arm: _plain(of) for arm, of in by_arm.items()} for name, by_arm in self.classes.items()}
        return entries | {"classes": classes}


def _plain(arm: Json) -> Json:
    gains = arm.get("own_minus", {})
    return arm | {"own_minus": {name: None if gain is None else asdict(gain) for name, gain in gains.items()}}


@torch_settings_kept()
def control_runs(
    folders: Sequence[RunFolder], *, shots: int, rollouts: int | None, episodes: int, trials: int, num_envs: int,
    seed: int, device: str, engine: str
) -> ControlResult:  # fmt: skip
    """Test whether adapting to a task's own data helps more than adapting to data of other tasks.

    For each held-out task, a policy is evaluated before adaptation, after it has adapted to the task's own data, and
    after it has adapted to data of each train task. The runs differ only in the seed.

    Args:
        folders: Runs of a learner that adapts, on a suite whose classes are in both splits.
        shots: Adaptation rounds, one after the other.
        rollouts: Episodes of each task in a shot; None: as in training, at most 40.
        episodes: Evaluation episodes after each adaptation.
        trials: Number of adaptations to each task, each from the unadapted policy and with new episodes.
        num_envs: Maximum number of environments stepped together.
        seed: Seed of the episodes' starts.
        device: ``auto``, ``cpu`` or ``cuda:N``.
        engine: ``auto``, ``c`` or ``warp``.

    Raises BidexError for runs that cannot be evaluated together.
    """
    _check(folders)
    results = []
    for folder in folders:
        stored = folder.config()
        here = resolve_device(device, open_worlds(stored.to_json()).on_gpu)
        config = replace(stored, device=here, engine=engine)
        worlds = open_worlds(config.to_json())
        if isinstance(worlds, OwnSuite) and set(worlds.benchmark.train_tasks) & set(worlds.benchmark.test_tasks):
            raise BidexError(
                f"{folder.path}: {worlds.name} has the same tasks in both splits, so data of train tasks are no data "
                "of other tasks. Name runs on a suite whose splits differ."
            )
        set_up_torch(config.threads, config.deterministic)
        counts = [len(pool) for pool in worlds.tasks("test").values()]
        adaptation = metatest.Adaptation.of(worlds, config)
        of_shot = metatest.rollouts_of(adaptation, rollouts, max(1, num_envs // len(counts)))
        size = metatest.environments_for(len(counts), max(counts) * trials, of_shot, num_envs)
        say(f"{folder.path}: {trials} adaptations of each held-out task, {size} environments.")
        test = worlds.world("test", size)
        train = worlds.world("train", size)
        protocol = Protocol(
            "test", seed, shots=shots, rollouts=of_shot, episodes_per_task=episodes, trials=trials,
            max_adapt_steps=adaptation.max_adapt_steps,
        )  # fmt: skip
        load = policy_loader(folder, here)[0]
        results.append(control(load, test, train, say=say, protocol=protocol, references=worlds.references()))
        test.close()
        train.close()
    config = folders[0].config()
    worlds = open_worlds(config.to_json())
    tasks = worlds.tasks("train")
    own = results[0].own.classes
    return ControlResult(
        runs=[str(folder.path) for folder in folders],
        title=f"{config.algo} on {worlds.name}",
        shots=shots,
        trials=trials,
        rollouts=results[0].rollouts,
        episodes={name: result.episodes * len(results) for name, result in own.items()},
        classes={name: arms(results, name, tasks[name]) for name in own},
    )


def _check(folders: Sequence[RunFolder]) -> None:
    """Raise BidexError unless all runs adapt, have the same classes in both splits, and differ only in the seed."""
    check_alike(folders)
    first = run_kind(folders[0].config())
    seeds: dict[int, Path] = {}
    for folder in folders:
        config = folder.config()
        if Capability.ADAPTS not in learner_kind(config.algo).capabilities:
            raise BidexError(f"{folder.path}: {config.algo} does not adapt to tasks. Name runs of maml, promp or rl2.")
        metatest.check_worlds(open_worlds(config.to_json()), config.algo)
        if (other := seeds.setdefault(config.seed, folder.path)) is not folder.path:
            raise BidexError(f"{folder.path} and {other} both have seed {config.seed}. Name one run for each seed.")
        if differing := [name for name, value in run_kind(config).items() if value != first.get(name)]:
            raise BidexError(
                f"Expected runs that differ only in the seed, but {folders[0].path} and {folder.path} differ in "
                f"{', '.join(differing)}. Name them in separate calls."
            )
