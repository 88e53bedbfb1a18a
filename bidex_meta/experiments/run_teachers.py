"""Teachers of ``bidex-meta run`` (--teacher): the teacher of each class, and the teachers' policies."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bidex_meta.config import RunConfig
from bidex_meta.errors import BidexError
from bidex_meta.experiments import run_data
from bidex_meta.experiments.learners import ALGOS, LearnerKind, learner_kind
from bidex_meta.experiments.policies import load_checkpoint, policy_of, slots_of
from bidex_meta.runs import RunFolder
from bidex_meta.runs.versions import read_versions
from bidex_meta.training.launch import launch, say
from bidex_meta.training.learner import Capability
from bidex_meta.witness.demonstrators import Scripted
from bidex_meta.witness.scripts import scripts_of
from bidex_meta.witness.teachers import Teachers, Tutor
from bidex_meta.world.contract import VectorWorld
from bidex_meta.worlds import Worlds, open_worlds
from bidex_meta.worlds.own import OwnSuite

SCRIPTS = "scripts"


def whole_paths(names: Sequence[str]) -> tuple[str, ...]:
    """Return teachers in the form that a config stores: paths of run folders are made absolute."""
    return tuple(name if name == SCRIPTS else run_data.whole_paths([name])[0] for name in names)


def check_teachers(kind: LearnerKind, config: RunConfig, source: Worlds) -> None:
    """Raise BidexError if the teachers in a config do not fit its learner or ``source``.

    The check is made before any world or learner is built. ``source`` is the suite or class to train on.
    """
    if not config.teacher:
        if Capability.TAUGHT in kind.capabilities:
            raise BidexError(f"{kind.name} learns from teachers. Add --teacher scripts, or --teacher RUN.")
        return
    if not _takes(kind):
        takers = ", ".join(name for name in ALGOS if _takes(learner_kind(name)))
        raise BidexError(f"{kind.name} has no teachers; --teacher goes with {takers}. Leave one of them out.")
    if source.hides_goals and Capability.ADAPTS not in kind.capabilities:
        raise BidexError(
            f"{kind.name}: its policy cannot infer the goals that {source.name} hides. Name an MT suite, or use "
            "--algo icl."
        )
    if SCRIPTS in config.teacher and (config.device != "cpu" or config.engine == "warp"):
        raise BidexError("--teacher scripts reads states of C MuJoCo. Add --device cpu, and leave --engine out.")
    if not teacher_of_class(config.teacher, source):
        raise BidexError(f"No class of {source.name} has a teacher among {', '.join(config.teacher)}. Name another.")


def _takes(kind: LearnerKind) -> bool:
    return bool(kind.capabilities & {Capability.TAUGHT, Capability.IMITATES})


def teacher_of_class(names: Sequence[str], source: Worlds) -> dict[str, str]:
    """Choose the teacher of each class; return it by the class's name in ``source.task_classes()``.

    ``names`` are runs, or ``scripts`` for scripted policies. The first of these that has learned (or has a script for)
    a class teaches it. Classes without a teacher are left out. Raises BidexError if a run has learned none of the
    classes.
    """
    knows = {name: _scripted(source) if name == SCRIPTS else _known_to(name, source) for name in names}
    teachers = {}
    for task in source.task_classes():
        knowing = [name for name in names if task in knows[name]]
        if knowing:
            teachers[task] = knowing[0]
    return teachers


def _scripted(source: Worlds) -> set[str]:
    """Return the names of the classes that have a scripted policy; raise BidexError if the hands' bases are fixed."""
    if not source.moving_bases:
        raise BidexError(
            f"--teacher scripts moves the hands' bases, which are fixed in {source.name}. Add --base moving."
        )
    return {name for name, task in source.task_classes().items() if task.name in scripts_of(task.rules)}


def _known_to(name: str, source: Worlds) -> set[str]:
    """Return the names of the classes in ``source`` that the policy of a run can teach.

    The run must have learned the class with its goal shown, with the same observations and actions. ``name`` is the
    run's folder. Raises BidexError if there is no such class, or if the run's policy adapts to tasks.
    """
    config = RunFolder.open(Path(name)).config()
    if Capability.ADAPTS in learner_kind(config.algo).capabilities:
        raise BidexError(f"--teacher {name}: {config.algo} adapts to tasks; expected a policy that does not adapt.")
    other = open_worlds(config.to_json())
    own = source.task_classes()
    theirs = other.task_classes()
    if other.class_name is None and (other.hides_goals or not (_same_form(source, other) or _is_by_class(other))):
        known = set[str]()
    else:
        known = set(_same_classes(own, theirs))
    if not known or source.points != other.points or (source.points and not _same_form(source, other)):
        raise BidexError(
            f"--teacher {name} has learned {other.name}, of which {source.name} has no class in the same form. "
            "Expected a run on a suite that shows goals, or on a single class, with the same rules, bases, objects and "
            "touch."
        )
    return known


def _same_form(source: Worlds, other: Worlds) -> bool:
    """Return whether two suites that show goals have the same observations."""
    if other.class_name is not None or source.hides_goals or slots_of(source) != slots_of(other):
        return False
    if isinstance(source, OwnSuite) and isinstance(other, OwnSuite):
        there = other.suite.observation, other.benchmark.padded_size
        return (source.suite.observation, source.benchmark.padded_size) == there
    return True


def _is_by_class(other: Worlds) -> bool:
    """Return whether ``other`` is a suite of ours whose task id tells classes apart, not tasks of one class."""
    slots = slots_of(other)
    return isinstance(other, OwnSuite) and len(set(slots)) == len(slots)


def _same_classes(own: Mapping[str, object], theirs: Mapping[str, object]) -> dict[str, str]:
    """Return, for each class of one suite that another has too, its name in that other suite."""
    found = {}
    for task, here in own.items():
        same = [name for name, there in theirs.items() if _alike(here, there)]
        if same:
            found[task] = same[0]
    return found


def _alike(one: object, other: object) -> bool:
    """Return whether two classes are the same, with equal observations and actions."""
    names = ("name", "rules", "layout", "action_size", "object")
    return all(getattr(one, name, None) == getattr(other, name, None) for name in names)


def teachers_of(config: RunConfig, source: Worlds, world: VectorWorld) -> Teachers:
    """Return the teachers of a run in its world, and log which class each teacher labels."""
    assigned = teacher_of_class(config.teacher, source)
    classes = source.task_classes()
    slots = slots_of(source)
    device = launch().own_device(config.device)
    tutors = []
    for name in config.teacher:
        learn = [task for task, teacher in assigned.items() if teacher == name]
        say(f"Teacher {name}: {', '.join(learn) or 'no class is left for it'}.")
        rows = _rows(world, slots, learn)
        if name != SCRIPTS and len(rows):
            folder = RunFolder.open(Path(name))
            state, steps = load_checkpoint(folder)
            policy = policy_of(folder, state, device)
            origin = {"algo": folder.config().algo, "policy": state["learner"]["policy"]}
            other = open_worlds(folder.config().to_json())
            width = int(world.single_observation_space.shape[0])
            more = None
            if other.class_name is not None:
                width = classes[learn[0]].observation_size
            elif isinstance(other, OwnSuite) and not _same_form(source, other):
                width = min(width - world.num_id_columns, other.benchmark.padded_size)
                their = _same_classes(classes, other.task_classes())
                names = [their[slots[i]] for i in world.task_id[rows].tolist()]
                more = _appended(other, names, width).to(world.device)
            tutors.append(Tutor(policy, rows, width, more, origin, (name, steps)))
    if untaught := [task for task in classes if task not in assigned]:
        rest = ", and not learned" * (Capability.TAUGHT in learner_kind(config.algo).capabilities)
        say(f"Without a teacher{rest}: {', '.join(untaught)}.")
    scripted = [task for task, teacher in assigned.items() if teacher == SCRIPTS]
    inner: Any = getattr(world, "unwrapped", world)  # the world without its recorder
    privileged = inner if source.hides_goals else None
    if not scripted:
        return Teachers(world, tutors, privileged=privileged)
    names = [inner.slots[i].name for i, task in enumerate(slots) if task in scripted]
    mask = torch.zeros(world.num_envs, dtype=torch.bool)
    mask[_rows(world, slots, scripted)] = True
    return Teachers(world, tutors, Scripted(inner, names=names), mask, privileged)


def steps_of(teachers: Teachers) -> list[int]:
    """Return the environment steps of each run that teaches, in the order of the tutors."""
    return [tutor.trained[1] for tutor in teachers.tutors if tutor.trained is not None]


def check_same(folder: RunFolder, teachers: Teachers) -> None:
    """Raise BidexError if a teacher of a resumed run has trained on since the run began."""
    before = read_versions(folder.path).get("teacher_steps")
    for was, tutor in zip(before or (), teachers.tutors, strict=False):
        if tutor.trained is not None and tutor.trained[1] != was:
            name, steps = tutor.trained
            raise BidexError(
                f"{folder.path}: its teacher {name} had {was:,} steps when the run began, and has {steps:,} now. A run "
                "keeps its teachers: copy the teacher's old checkpoint back, or start a new run."
            )


def _appended(other: OwnSuite, names: Sequence[str], width: int) -> Tensor:
    """Return the entries (k, m) that a policy of ``other`` reads after the first ``width`` entries of an observation.

    These are padding, and the task id if the suite shows it. ``names`` are the classes of the k environments, by their
    names in ``other``.
    """
    padding = torch.zeros(len(names), other.benchmark.padded_size - width)
    if other.suite.observation != "one-hot":
        return padding
    slots = slots_of(other)
    numbers = torch.tensor([slots.index(name) for name in names])
    return torch.cat([padding, torch.eye(len(slots))[numbers]], dim=1)


def _rows(world: VectorWorld, slots: Sequence[str], tasks: Sequence[str]) -> Tensor:
    """Return the indices of the environments that belong to the classes ``tasks``, int64 (k,)."""
    chosen = torch.tensor([i for i, task in enumerate(slots) if task in tasks], device=world.device)
    return torch.isin(world.task_id, chosen).nonzero().squeeze(1)
