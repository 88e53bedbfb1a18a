"""`Benchmark("ML20")`: a suite file and a seed become task classes, tasks and worlds.

The properties `train_classes`, `test_classes`, `train_tasks` and `test_tasks`, and the class `Task`, have Meta-World's
names, so that code for Meta-World also runs here.
"""

import hashlib
from itertools import chain
from pathlib import Path
from typing import Literal, cast

import numpy as np
import torch
from gymnasium.vector import AutoresetMode

from bidex_meta.errors import BidexError, shortened, unknown_name
from bidex_meta.rules import Randomisation, versioned_name
from bidex_meta.suite import MOST_POINTS, OTHER_SEED, OTHERS, SPLITS, ListedTask, Split, Suite, SuiteClass
from bidex_meta.suite_files import load_suite
from bidex_meta.tasks import registry
from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.task import ByClass, Task
from bidex_meta.tasks.variation import VariationSpace
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.plugins import name_with_object
from bidex_meta.utils.validation import whole_number
from bidex_meta.world import PointsRule, Slot, World, WorldConfig
from bidex_meta.world.episodes import checked_mode
from bidex_meta.world.single_env import EnvRecipe, SuiteEnv

TaskSampling = Literal["uniform", "fixed", "fresh"]


class Benchmark:
    """A suite with its task classes, tasks and worlds.

    `name_or_path` is a shipped suite (`bidex_meta.suite_names()`), the path of your own suite file, or a `Suite`.
    `seed`, a non-negative integer, chooses the tasks and is the default seed of the worlds. The same name and seed give
    the same tasks in every process; no global random generator is used. `train_classes` and `test_classes` make single
    environments, as in Meta-World. If `bidex_meta.metaworld` is imported, a `Benchmark` is also a
    `metaworld.Benchmark`. `tasks_per_class` is the number of train tasks per class. With 0, training draws a new task
    in each episode or trial, and `train_tasks` are tasks that training never draws. With None, the suite's file
    decides.

    Raises BidexError for an unknown suite, a faulty suite file or seed, or if `tasks_per_class` is given for a suite
    that lists its tasks.

    Examples:
        >>> from bidex_meta import Benchmark
        >>> ml4 = Benchmark("ML4", seed=0)
        >>> list(ml4.test_classes), len(ml4.train_tasks)
        (['TwoCatchUnderarm'], 150)
    """

    def __init__(self, name_or_path: str | Path | Suite, seed: int = 0, tasks_per_class: int | None = None) -> None:
        if isinstance(name_or_path, Suite):
            suite = name_or_path
        else:
            suite = load_suite(name_or_path)
        self.suite = suite.with_train_tasks(tasks_per_class)
        self.seed = whole_number("seed", seed, 0)
        classes = {entry.name: _task_class(self.suite, entry) for entry in self.suite.classes}
        self._classes = ByClass(classes, self.suite.rules)
        self._tasks: dict[Split, dict[str, list[Task]]] = {}
        for split in SPLITS:
            self._tasks[split] = {entry.name: self._draw(entry, split) for entry in self.suite.split_classes(split)}
        overlap = set(self.train_tasks) & set(self.test_tasks)
        listed = chain.from_iterable(entry.tasks for entry in self.suite.classes)
        choices = any(task.split == "both" for task in listed)
        if overlap and not choices:
            raise BidexError(f"{self.suite.file}: expected no task in both splits, got {len(overlap)} in both.")
        actions = {name: task_class.action_size for name, task_class in self._classes.items()}
        if len(set(actions.values())) > 1:
            raise BidexError(
                f"{self.suite.file}: base: expected classes with one number of actions, got {actions}. "
                'Write base = "moving".'
            )

    def __repr__(self) -> str:
        return f"Benchmark({self.name!r}, seed={self.seed})"

    @property
    def name(self) -> str:
        """Return the suite's name."""
        return self.suite.name

    @property
    def train_classes(self) -> dict[str, type[SuiteEnv]]:
        """Return the environment classes of the train split by `env_name`, in the order of the suite file.

        In a suite of version 2, look-ups also accept a class's name without `-v2`.
        """
        return self._env_classes("train")

    @property
    def test_classes(self) -> dict[str, type[SuiteEnv]]:
        """Return the environment classes of the test split; empty in a multi-task suite."""
        return self._env_classes("test")

    @checked_arguments
    def task_classes(self, split: Split = "train") -> dict[str, TaskClass]:
        """Return the task classes of a split by name; a task class defines scene, observation and reward."""
        classes = {entry.name: self._classes[entry.name] for entry in self.suite.split_classes(split)}
        return ByClass(classes, self.suite.rules)

    @property
    def train_tasks(self) -> list[Task]:
        """Return the tasks of the train split, grouped by class."""
        return list(chain.from_iterable(self._tasks["train"].values()))

    @property
    def test_tasks(self) -> list[Task]:
        """Return the tasks of the test split, grouped by class; empty in a multi-task suite."""
        return list(chain.from_iterable(self._tasks["test"].values()))

    def tasks_of(self, name: str, split: str = "train") -> list[Task]:
        """Return the tasks of a class in a split; in version 2 the ending `-v2` of the name may be left out.

        Raises BidexError if the split does not have the class.
        """
        tasks = ByClass(self._tasks[self._checked_split(split)], self.suite.rules)
        if name not in tasks:
            raise unknown_name(f"class of {self.name}", name, tasks)
        return list(tasks[name])

    @property
    def others(self) -> "Benchmark":
        """Return the same suite with unseen tasks.

        They are the listed test tasks of classes that list some. Otherwise their number is that of the train tasks, and
        they are drawn with a seed that no run uses for training. Raises BidexError if the suite lists all its tasks,
        and no test tasks.
        """
        return self.with_new_tasks(self.seed + OTHER_SEED)

    def with_new_tasks(self, seed: int) -> "Benchmark":
        """Return the same suite with unseen tasks, as ``others`` does, but drawn with ``seed``."""
        found = Benchmark(self.suite.unseen(), seed)
        known = set(self.train_tasks)
        for task in found.train_tasks:
            if task in known:
                raise BidexError(
                    f"{self.name}: expected a suite with unseen tasks of its train classes, but it lists all tasks of "
                    f"{task.env_name}. Leave unseen tasks out: play the train or test tasks."
                )
        return found

    @property
    def padded_size(self) -> int:
        """Return the size to which observations are padded: the observation size of the widest class.

        The task id is not counted.
        """
        return max(task_class.observation_size for task_class in self._classes.values())

    def make_world(
        self,
        split: str = "train",
        num_envs: int | None = None,
        device: str | torch.device = "auto",
        seed: int | None = None,
        autoreset_mode: AutoresetMode | str | None = None,
        threads: int | None = None,
        engine: str = "auto",
        stagger: bool = True,
        randomisation: Randomisation | bool | None = None,
        pixels: int = 0,
        episodes_per_task: int | None = None,
        deterministic: bool = False,
        switches: str = "",
    ) -> World:
        """Make a batched world of one split.

        In a training world (autoreset mode SAME_STEP) of a multi-task suite, every episode draws one task of the
        environment's class. In a meta suite, and in every evaluation world (mode DISABLED), environment j of a class
        keeps task j modulo the number of tasks. There are two exceptions. With `tasks_per_class=0` every episode of a
        training world of the train split draws a new task. With `episodes_per_task`, each environment of a training
        world draws tasks, and keeps each of them for that number of episodes.

        Args:
            split: `"train"`, `"test"`, or `"others"`: unseen tasks of the train classes; see the property `others`.
            num_envs: Number of environments, divided evenly among the classes; None: 1024 on the CPU, 8192 on an
                accelerator.
            device: `"auto"` (CUDA if there is a GPU), `"cpu"`, `"cuda"`, ... or a `torch.device`.
            seed: Seed of starts and task draws; None: the benchmark's seed.
            autoreset_mode: SAME_STEP (the default, for training), NEXT_STEP (for Gymnasium's tools) or DISABLED (for
                evaluation), as a member of Gymnasium's `AutoresetMode` or as text.
            threads: Engine threads on the CPU; None: one per core. Results do not depend on it.
            engine: `"c"` (C MuJoCo, on the CPU), `"warp"` (mujoco_warp, on either device) or `"auto"`: the faster one.
            stagger: In training worlds the first episodes begin at random elapsed steps, so that environments do not
                all end together; these first episodes do not count. False: all begin at step 0.
            randomisation: True: the randomisation of the suite's file; False: none; None: that of the suite's file, but
                only in training worlds; or a `Randomisation` (docs/randomisation.md).
            pixels: Edge length of the square pictures in `info["pixels"]`, pixels (docs/looking.md); 0: no pictures.
            episodes_per_task: Number of consecutive episodes in which an environment keeps a drawn task, as in a trial
                (docs/clients.md#trials-as-episodes). None: as described above.
            deterministic: Whether physics on a GPU repeats bit for bit, which takes longer (docs/gpu.md); on the CPU it
                always does.
            switches: Experimental changes of the physics, such as `"incremental"` (docs/gpu.md#switches).

        Raises BidexError for a split without classes, too few environments, an unknown mode, device or engine.
        """
        if split == OTHERS:
            return self.others.make_world(
                "train", num_envs, device, seed, autoreset_mode, threads, engine, stagger, randomisation, pixels,
                episodes_per_task, deterministic, switches
            )  # fmt: skip
        slots = self._slots(self._checked_split(split))
        mode = checked_mode(autoreset_mode)
        evaluates = mode.name == "DISABLED"
        if randomisation is None:
            randomisation = not evaluates
        if isinstance(randomisation, bool):
            if randomisation:
                randomisation = self.suite.randomisation
            else:
                randomisation = None
        if seed is None:
            seed = self.seed
        if split == "train" and self.suite.train_tasks == 0:
            task_sampling = "fresh"
        elif evaluates or (self.suite.kind == "meta" and episodes_per_task is None):
            task_sampling = "fixed"
        else:
            task_sampling = "uniform"
        if self.suite.points:
            points = PointsRule(self.suite.points, self.suite.point_kinds)
        else:
            points = None
        config = WorldConfig(
            num_envs=num_envs,
            device=device,
            engine=engine,
            deterministic=deterministic,
            switches=switches,
            seed=seed,
            autoreset_mode=mode,
            observation=self.suite.observation,
            pad_to=self.padded_size,
            task_sampling=task_sampling,
            threads=threads,
            stagger=stagger,
            points=points,
            randomisation=randomisation,
            pixels=pixels,
            episodes_per_task=1 if episodes_per_task is None else episodes_per_task,
        )
        return World(slots, config)

    def _draw(self, entry: SuiteClass, split: Split) -> list[Task]:
        # The class's name seeds the draws, so that all objects of a class have the same goals.
        task_class = self._classes[entry.name]
        space = task_class.variation_space
        key = entry.class_name
        if entry.tasks:
            variations = [_listed(space, self.seed, key, task) for task in entry.tasks if task.of(split)]
        else:
            variations = _drawn(space, self.seed, key, split, self.suite.drawn_tasks(split))
        env_name = versioned_name(entry.name, self.suite.rules)
        hidden = self.suite.observation == "masked"
        tasks = []
        for variation in variations:
            tasks.append(Task.from_variation(env_name, variation, task_class.instruction(variation, hidden)))
        return tasks

    def _env_classes(self, split: Split) -> dict[str, type[SuiteEnv]]:
        moving = True if self.suite.base == "moving" else None
        hides = self.suite.observation == "masked"
        points = (self.suite.points, self.suite.point_kinds)
        classes = dict[str, type[SuiteEnv]]()
        for entry in self.suite.split_classes(split):
            look = (moving, tuple(entry.options.items()), self.padded_size, hides)
            own = entry.reward_scale, entry.class_name, self.suite.rules, points, bool(entry.tasks)
            randomisation = self.suite.randomisation if split == "train" else None
            recipe = EnvRecipe(entry.name, *look, *own, self.suite.touch, randomisation)
            classes[recipe.env_name] = recipe.make_class()
        return ByClass(classes, self.suite.rules)

    def _checked_split(self, split: str) -> Split:
        if not isinstance(split, str) or split not in self.suite.splits:
            known = ", ".join(self.suite.splits)
            what = f"{self.name} has the splits {known}, got {shortened(split)}"
            raise BidexError(f"{what}. Name one of these, or {OTHERS}.")
        return cast(Split, split)

    def _slots(self, split: Split) -> list[Slot]:
        slots = []
        for entry in self.suite.split_classes(split):
            task_class = self._classes[entry.name]
            variations = [task.variation for task in self._tasks[split][entry.name]]
            if self.suite.task_id == "class":
                slots.append(Slot(entry.name, task_class, np.stack(variations), entry.reward_scale, entry.gamma))
                continue
            names = [f"{entry.name}/{task.name}" for task in entry.tasks if task.of(split)]
            for name, variation in zip(names, variations, strict=True):
                slots.append(Slot(name, task_class, variation[None], entry.reward_scale, entry.gamma))
        return slots


def make_task_world(
    task_name: str,
    num_envs: int | None = None,
    device: str | torch.device = "auto",
    seed: int = 0,
    autoreset_mode: AutoresetMode | str | None = None,
    threads: int | None = None,
    task_sampling: TaskSampling | None = None,
    moving_base: bool | None = None,
    engine: str = "auto",
    stagger: bool = True,
    points: int = 0,
    object: str | None = None,
    randomisation: Randomisation | None = None,
    pixels: int = 0,
    task_seed: int | None = None,
    touch: bool = False,
    deterministic: bool = False,
    switches: str = "",
) -> World:
    """Make a world of a single task class with 50 tasks, which a seed draws.

    Observations show the goal; they have no task id and no padding. `task_name` is a task class, e.g.
    `"CatchUnderarm"`, or your own class as `"package.module:Class"` (docs/own-task.md). `"HandOver"` is the only class
    with fixed bases; it has 398 observation entries and 40 actions. Arguments that `Benchmark.make_world` does not
    have:

    - `task_sampling`: with `"uniform"` each episode draws one of the 50 tasks; with `"fixed"` environment j keeps task
      j modulo 50; with `"fresh"` each episode draws a new task, which is not one of the 50. None: uniform in training
      worlds, fixed in evaluation worlds.
    - `moving_base`: whether the hands' bases move; None: as the class defines it.
    - `points`: number of points of the cloud that replaces the object's state (docs/points.md); 0: the state is shown.
    - `touch`: whether observations show touch sensors of both hands (docs/world.md#the-contract).
    - `randomisation`: randomisation of the environments (docs/randomisation.md); None: nothing is randomised.
    - `task_seed`: seed that draws the 50 tasks; None: `seed`.
    - `object`: name or MJCF file (docs/objects.md) of an object that replaces the class's own object. The name in the
      world's `task_names` then ends in a dash and the object's name.

    Raises BidexError for an unknown class or object, too few environments, an unknown mode, device or engine.
    """
    task_name = registry.resolve(task_name)
    mode = checked_mode(autoreset_mode)
    task_class = registry.get(task_name, moving_base, touch, **registry.with_object(object))
    of_tasks = whole_number("seed", seed, 0)
    if task_seed is not None:
        of_tasks = whole_number("task_seed", task_seed, 0)
    tasks = _drawn(task_class.variation_space, of_tasks, task_name, "train", 50)
    slot = Slot(name_with_object(task_name, object), task_class, tasks)
    if task_sampling is None:
        if mode.name == "DISABLED":
            task_sampling = "fixed"
        else:
            task_sampling = "uniform"
    config = WorldConfig(
        num_envs=num_envs,
        device=device,
        engine=engine,
        deterministic=deterministic,
        switches=switches,
        seed=seed,
        autoreset_mode=mode,
        task_sampling=task_sampling,
        threads=threads,
        stagger=stagger,
        points=PointsRule(points) if whole_number("points", points, 0, MOST_POINTS) else None,
        randomisation=randomisation,
        pixels=pixels,
    )
    return World([slot], config)


def _task_class(suite: Suite, entry: SuiteClass) -> TaskClass:
    try:
        moving = True if suite.base == "moving" else None
        if "moving_base" in entry.options:
            raise BidexError(f'{entry.name}: options: expected no moving_base. Write base = "moving" or "alone".')
        task_class = registry.get(entry.class_name, moving, suite.touch, **entry.options)
        task_class.adopt(suite.rules)
        for task in entry.tasks:
            for component in task.fixed:
                if component not in task_class.variation_space.names:
                    raise unknown_name(f"component of {entry.name}", component, task_class.variation_space.names)
    except BidexError as error:
        raise BidexError(f"{suite.file}: classes: {error}") from error
    return task_class


def _generator(*key: object) -> np.random.Generator:
    # sha256 is used because hash() differs from process to process.
    digest = hashlib.sha256("\x1f".join(map(str, ("bidex-meta task", *key))).encode()).digest()
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(int.from_bytes(digest, "little"))))


def _drawn(space: VariationSpace, seed: int, name: str, split: Split, count: int) -> np.ndarray:
    return space.sample(_generator(seed, name, split), count)


def _listed(space: VariationSpace, seed: int, name: str, task: ListedTask) -> np.ndarray:
    variation = space.sample(_generator(seed, name, "listed", task.name), 1)[0]
    for component, value in task.fixed.items():
        variation[space.names.index(component)] = value
    return variation
