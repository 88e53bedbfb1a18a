"""The config of a run.

Flags set the config, and ``config.json`` stores it. Resumed runs and sweeps compare their config with the stored one.
"""

import dataclasses
import json
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, TypeVar

import msgspec
import tyro
from msgspec import Meta
from tyro.constructors import PrimitiveConstructorSpec

from bidex_meta.errors import BidexError, shortened
from bidex_meta.suite import MOST_POINTS, MOST_TASKS
from bidex_meta.utils.files import Json, JsonObject, read_json
from bidex_meta.utils.validation import (
    Count,
    Environments,
    Finite,
    NonNegative,
    Positive,
    Seed,
    Text,
    Threads,
    builtin,
    check_fields,
    parse,
)

LearnerSettings = TypeVar("LearnerSettings")

UNRESOLVED: Any = None
"""Default of a field that ``bidex_meta.experiments.run_config.resolve`` fills in."""

_UNRESOLVED = ("num_envs", "steps", "threads")
_WRITTEN = ("suite", "task", "algo", "learner", "num_envs", "steps", "seed")
"""Fields that every ``config.json`` must have."""

STOPPING_EPISODES = 100
"""Finished episodes of each class before metrics of training end a run early: their means are over about 100 episodes.
"""
EPISODES = "Train/episodes"
"""Tag of the smallest number of finished episodes of a class."""

MAY_CHANGE = {"may_change": True}
"""Metadata of a field that a resumed run may change, because the field does not affect what is learned."""


def _whole_number(words: list[str]) -> int:
    try:
        value = float(words[0].replace("_", ""))
        if value != int(value) or value < 0:
            raise ValueError
    except (ValueError, OverflowError):
        raise ValueError(f"expected a whole number such as 20000000 or 2e7, not {shortened(words[0])}") from None
    return int(value)


_FLAG_OF_STEPS = PrimitiveConstructorSpec(
    nargs=1,
    metavar="INT",
    instance_from_str=_whole_number,
    is_instance=lambda value: isinstance(value, int),
    str_from_instance=lambda value: [str(value)],
)
Steps = Annotated[int, Meta(ge=0, le=10**15), _FLAG_OF_STEPS]
"""A whole number that may be written 2e7 on the command line."""
TrainSteps = Annotated[int, Meta(ge=1, le=10**15), _FLAG_OF_STEPS]
"""Training makes at least one iteration."""

Several = Annotated[tuple[Text, ...], tyro.conf.UseAppendAction]
"""A flag that may be given several times."""


Switch = Annotated[bool, tyro.conf.FlagCreatePairsOff]
"""A flag without a value and without a ``--no-`` counterpart."""


@dataclass(frozen=True, kw_only=True)
class RunConfig(Generic[LearnerSettings]):
    """Everything that decides what a run does, for example ``RunConfig(suite="MT4-v2", learner={"gamma": 0.99})``.

    ``learner`` is the learner's own config, or a dict of the values that differ from its preset. Raises BidexError for
    a field that is out of its bounds.
    """

    suite: Text | None = None
    """Suite to train on: a name (see `bidex-meta list suites`) or the path of a TOML file."""
    task: Text | None = None
    """Train on this single task class instead of a suite; or your own class as package.module:Class
    (docs/own-task.md)."""
    base: Literal["own", "moving", "fixed"] = "own"
    """With --task: whether the hands' bases move; own: as the class itself defines it. In HandOver the bases are fixed;
    in all other classes and in our suites they move."""
    points: Annotated[int, Meta(ge=0, le=MOST_POINTS)] = 0
    """Number of points of the cloud that observations show in place of objects' states, as if from a depth camera
    (docs/points.md; the original has 768). 0: observations show the states, unless the suite's file says otherwise."""
    touch: Switch = False
    """Add touch sensors to observations: 14 normal forces at fingertips and palms (docs/world.md)."""
    object: Text | None = None
    """With --task: the object to throw in place of the class's own object: a name of `bidex-meta list objects`, or the
    path of an MJCF file (docs/objects.md)."""
    tasks_per_class: Annotated[int, Meta(ge=0, le=MOST_TASKS)] | None = None
    """With --suite: number of train tasks of each class. 0: a new task in each episode, or in each trial of a learner
    that adapts (docs/own-suite.md). By default the suite's file decides."""
    start_from: Text | None = None
    """Start from the policy in this run's last checkpoint (network and observation statistics). None: a new policy."""
    algo: Text = "mtppo"
    """Learner (see `bidex-meta list algos`), or your own class as package.module:Class (docs/own-learner.md)."""
    preset: Text = "auto"
    """Named defaults for the learner's options. auto: metaworld for Meta-World's suites; v2 for version 2, if the
    learner has it; otherwise laptop on a CPU and paper on a GPU (exceptions: docs/training.md)."""
    learner: LearnerSettings = field(default_factory=dict)  # pyright: ignore[reportAssignmentType]
    """Options of the learner (in Python also a dict of the values that differ from its preset)."""
    num_envs: Environments = UNRESOLVED
    """Number of environments that each process steps together, over all tasks."""
    steps: TrainSteps = field(default=UNRESOLVED, metadata=MAY_CHANGE)
    """Environment steps to train for, over all environments of all processes; may be written 2e7. With --dataset:
    gradient updates."""
    minutes: Positive | None = field(default=None, metadata=MAY_CHANGE)
    """Minutes to train for, summed over all resumes. Training ends after --minutes or --steps, whichever is reached
    first. Building the world and evaluations do not count and can take longer in short runs. None: no limit."""
    evaluate_every: Count | None = field(default=None, metadata=MAY_CHANGE)
    """Evaluate every N iterations, and keep the best policy as checkpoints/best.pt. An evaluation plays up to ten tasks
    of each class, one episode each, or more if there would be fewer than ten episodes in all. Learners that adapt are
    evaluated on train tasks, after two shots. Evaluations do not affect training. None: never."""
    video_every: Count | None = field(default=None, metadata=MAY_CHANGE)
    """Film one environment of each class every N iterations; films go into videos/ and to the logger. None: never."""
    logger: Literal["tensorboard", "wandb", "none"] = field(default="tensorboard", metadata=MAY_CHANGE)
    """Logger that receives metrics, config and films in addition to metrics.jsonl."""
    dataset: Several = ()
    """With --algo bc, bcq, td3bc or iql: learn from this data set (a name of `bidex-meta data list`, or a folder)
    instead of acting. The run is for the suite or task that the data set was recorded on. If given several times: learn
    from all of them."""
    task_seed: tyro.conf.Suppress[tyro.conf.Fixed[Seed | None]] = None
    """Seed of the tasks that the data sets were recorded on."""
    demonstrations: Several = ()
    """With --algo mtppo and ppo: imitate this data set too, with a weight that decays (see
    --learner.demonstration-batch). It is named as for --dataset; see `bidex-meta record demonstrations`. If given
    several times: imitate all of them."""
    teacher: Several = ()
    """With --algo dagger, icl, mtppo and ppo: the teacher that labels the states that the policy visits. The value is
    scripts (the scripts of all classes that have one), or the folder of a run on the same suite or on one of the
    suite's classes. If given several times: each class takes the first teacher that knows it."""
    record: Steps = 0
    """Store about this number of training transitions as the data set replay/ in the run's folder, in whole episodes of
    some of the environments (docs/data.md). There are more if one environment of each class makes more. 0: none."""
    record_share: tyro.conf.Suppress[tyro.conf.Fixed[NonNegative]] = 0.0
    """``record`` divided by the steps that the run began with. The share is stored so that a run that is resumed for
    more steps records the same environments."""
    stop_at_return: Finite | None = field(default=None, metadata=MAY_CHANGE)
    """End as soon as the mean return reaches this value. It is measured in evaluations if --evaluate-every is given,
    otherwise in training, after 100 finished episodes of each class. None: never."""
    stop_at_success: Annotated[float, Meta(gt=0.0, le=1.0)] | None = field(default=None, metadata=MAY_CHANGE)
    """Stop as soon as this fraction of episodes succeeds, such as 0.8. It is measured in evaluations if
    --evaluate-every is given, otherwise in training with exploration noise, after 100 finished episodes of each class.
    None: never."""
    stop_at_score: Finite | None = field(default=None, metadata=MAY_CHANGE)
    """Stop as soon as the score in evaluations reaches this value (docs/evaluation.md). Needs --evaluate-every. None:
    never."""
    processes: tyro.conf.Suppress[tyro.conf.Fixed[Count]] = 1
    """Processes that train together."""
    seed: Seed = 0
    """Seed of tasks, start states and learner."""
    device: Text = "auto"
    """Device to train on: auto (a GPU if there is one), cpu or cuda:N."""
    engine: Literal["auto", "c", "warp"] = "auto"
    """Physics engine: c (C MuJoCo, CPU only), warp (mujoco_warp, CPU or GPU), or auto (the faster one on the
    device)."""
    deterministic: bool = False
    """Make a run on a GPU repeatable bit for bit, which slows physics and learning down. Runs on a CPU are always
    repeatable."""
    switches: str = ""
    """Experimental changes of the physics, separated by commas, such as incremental (docs/gpu.md)."""
    threads: Threads = UNRESOLVED
    """Threads of torch and of the physics in each process; by default the cores of a machine are divided among its
    processes. A resumed run keeps its number of threads."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "learner", builtin(self.learner))
        check_fields(self, "run", as_flags=True, unresolved=_UNRESOLVED)

    @property
    def learner_values(self) -> JsonObject:
        """Return the learner's config as a dict of JSON values."""
        return json.loads(msgspec.json.encode(self.learner))

    def to_json(self) -> JsonObject:
        """Return the config as ``config.json`` holds it."""
        return json.loads(msgspec.json.encode(self))

    def flat(self) -> JsonObject:
        """Return the config as one flat dict of JSON values, with names such as ``seed`` and ``learner.gamma``."""
        return flat(self.to_json())

    def differences(self, other: "RunConfig", ignored: Collection[str] = ()) -> Iterator[tuple[str, Json, Json]]:
        """Compare this config with ``other``: yield a triple for each entry that differs.

        The triple has the entry's name, its value in this config and its value in ``other``. Entries in ``ignored`` are
        left out, and so are entries that a resumed run may change.
        """
        free = {entry.name for entry in dataclasses.fields(self) if entry.metadata.get("may_change")}
        here = self.flat()
        there = other.flat()
        for name in sorted((here.keys() | there.keys()) - free - set(ignored)):
            if here.get(name) != there.get(name):
                yield name, here.get(name), there.get(name)

    @property
    def stops_by_training(self) -> bool:
        """Return whether metrics of training, not of evaluations, can end the run early."""
        return self.evaluate_every is None and (self.stop_at_return, self.stop_at_success) != (None, None)

    def early_end(self, metrics: Mapping[str, Json]) -> str | None:
        """Return the tag of the metric that ends the run early, or None if the run continues.

        Metrics of training count after ``STOPPING_EPISODES`` episodes. Runs of older versions did not log their number.
        """
        if self.stops_by_training and metrics.get(EPISODES, STOPPING_EPISODES) < STOPPING_EPISODES:
            return None
        if self.evaluate_every is None:
            prefix = "Train"
        else:
            prefix = "Eval"
        limits = {
            f"{prefix}/mean_return": self.stop_at_return,
            f"{prefix}/success_rate": self.stop_at_success,
            "Eval/score": self.stop_at_score,
        }
        for tag, limit in limits.items():
            if limit is not None and (value := metrics.get(tag)) is not None and value >= limit:
                return tag
        return None

    def goal(self, last: Mapping[str, Json]) -> int:
        """Return the number of environment steps at which the run is complete.

        This is ``steps``. If the run has a time limit, or if a metric ended it early, it is instead the step of
        ``last``, the run's last metrics.
        """
        if self.minutes is not None or self.early_end(last):
            return last["step"]
        return self.steps


def flat(content: Mapping[str, Json], prefix: str = "") -> JsonObject:
    """Return nested tables as one flat dict: ``{"learner": {"gamma": 0.9}}`` becomes ``{"learner.gamma": 0.9}``."""
    found: JsonObject = {}
    for name, value in content.items():
        found.update(flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value})
    return found


def read_config(path: Path) -> RunConfig[JsonObject]:
    """Return a run's ``config.json``. Raises BidexError if the file is not a config, or cannot be read."""
    return config_of(read_json(path, "a run's config"), str(path))


def config_of(content: object, where: str) -> RunConfig[JsonObject]:
    """Return a run's config from the content of a file.

    Raises BidexError if the content is not a config. The message names the file as ``where``.
    """
    missing = [name for name in _WRITTEN if isinstance(content, dict) and name not in content]
    if missing:
        raise BidexError(f"{where}: expected an entry {missing[0]}, found none. Give a run folder.")
    config = parse(content, RunConfig[JsonObject], where)
    if (config.suite is None) == (config.task is None):
        raise BidexError(f"{where}: expected either a suite or a task, with null for the other. Give a run folder.")
    # Defaults are copied into the config, because msgspec does not write defaults that only the class holds.
    return dataclasses.replace(config, threads=config.threads or 1)


def printed(config: RunConfig) -> str:
    """Return the config as indented JSON."""
    return json.dumps(config.to_json(), indent=2)
