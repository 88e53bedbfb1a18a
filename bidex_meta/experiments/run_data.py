"""Data sets that ``bidex-meta run`` learns from (--dataset) or imitates (--demonstrations), and their metadata."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict

import gymnasium

from bidex_meta.clients.gymnasium_ids import task_id
from bidex_meta.data import Dataset, open_dataset
from bidex_meta.data.joined import check_touch, class_physics
from bidex_meta.errors import BidexError, known_name
from bidex_meta.experiments.learners import ALGOS, LearnerKind, learner_kind
from bidex_meta.rules import V1, rules_apart
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.versions import collect_versions
from bidex_meta.tasks.registry import name_among
from bidex_meta.training.launch import launch, say
from bidex_meta.training.learner import Capability
from bidex_meta.utils.files import absolute, expanded
from bidex_meta.world.contract import VectorWorld
from bidex_meta.worlds import Worlds

UPDATES = 300_000  # default number of updates of an offline run
_FORM = ("suite", "task", "base", "object", "points", "touch", "tasks_per_class")


def dataset_metadata(source: Worlds, world: VectorWorld, kind: str, policies: Sequence[Json], **more: object) -> Json:
    """Return this package's entry in the metadata of a data set, ready for JSON; ``more`` are further items.

    ``policies`` describes the policies that acted; ``Episode.policy`` is an index into it. The entry has:

    - ``suite`` and ``suite_version``, or ``task``, ``base`` and ``object``; the others are None
    - ``points``: number of points of the observed point cloud; ``touch``: whether observations show touch sensors
    - ``tasks_per_class``: number of train tasks per class if it is not the suite's own; otherwise None
    - ``tasks``: names of the world's slots (classes, or listed tasks as Class/task)
    - ``instructions``: instruction of each slot's class
    - ``physics``: {class: digest of its physics}, empty for another library's classes; ``joined.join`` compares it
    - ``reward_scales``: factor of the reward by slot; ``rules``: the suite's rules; ``hides_goals``
    - ``randomisation``: fields of the world's ``Randomisation``; None: nothing was randomised
    - ``observation_groups``: name and index ranges of each group
    - ``kind`` (``random``, ``medium``, ...), ``policies``, and ``seed`` of the tasks
    - ``references``: {class: fields of ``evaluation.references.Reference``}, unscaled returns
    - ``versions`` and ``commit``
    - ``gymnasium_id``: id of the same environment in Gymnasium; None for a suite or a class with changed options
    """
    alone = source.class_name
    versions = collect_versions()
    names = {name.partition("/")[0] for name in world.task_names}
    references = {name: asdict(known) for name, known in source.references().items() if name in names}
    altered = source.object or source.points or source.touch or source.moving_base is not None
    env_id = None
    if alone and not altered and task_id(alone) in gymnasium.registry:
        env_id = task_id(alone)
    base = None
    if alone:
        base = {None: "own", True: "moving", False: "fixed"}[source.moving_base]
    slots = getattr(world, "slots", ())
    rules = asdict(slots[0].task_class.rules) if slots else asdict(V1)
    version = None
    count = None
    if source.suite:
        version = source.suite.version
        count = source.suite.train_tasks
    drawn = getattr(getattr(world, "unwrapped", world), "randomisation", None)
    if drawn is not None:
        drawn = asdict(drawn)
    return {
        "suite": None if alone else source.name,
        "suite_version": version,
        "task": alone, "object": source.object, "points": source.points, "touch": source.touch,
        "base": base,
        "tasks_per_class": count,
        "tasks": list(world.task_names),
        "instructions": {slot.name: slot.task_class.instruction() for slot in slots},
        "physics": class_physics(slots),
        "randomisation": drawn,
        "reward_scales": {slot.name: slot.reward_scale for slot in slots},
        "rules": rules,
        "hides_goals": source.hides_goals,
        "observation_groups": [[g.name, [[p.start, p.stop] for p in g.where]] for g in world.observation_groups],
        "kind": kind, "policies": list(policies), "seed": source.seed,
        "references": references,
        "versions": versions, "commit": (versions["git"] or {}).get("commit"),
        "gymnasium_id": env_id,
        **more,
    }  # fmt: skip


def whole_paths(names: Sequence[str]) -> tuple[str, ...]:
    """Return data sets in the form that a config stores: paths of folders are made absolute.

    This is needed because a run may be resumed from another working folder.
    """
    return tuple(str(absolute(name)) if expanded(name).is_dir() else name for name in names)


def open_datasets(names: Sequence[str]) -> list[Dataset]:
    """Open data sets by names or folders; errors are those of ``open_dataset``."""
    return [open_dataset(name) for name in names]


def implied(datasets: Sequence[Dataset]) -> Json:
    """Return the settings of the world in which all data sets were recorded.

    The settings are ``suite``, or ``task``, ``base`` and ``object``; and those of ``_FORM`` that follow. The dict is
    empty if there are no data sets, or if the first has no metadata of this package. Raises BidexError if the settings
    differ.
    """
    forms = [tuple(dataset.metadata.get(name) or None for name in _FORM) for dataset in datasets]
    if not forms or forms[0][:2] == (None, None):
        return {}
    which = sorted({str(suite or task or "elsewhere") for suite, task, *_ in forms})
    suite = "Name the suite that one policy shall learn: --suite NAME, of exactly these classes."
    if len(which) > 1:
        raise BidexError(f"The data sets are of {' and '.join(which)}. {suite}")
    same = "Name some that were recorded alike"
    mends = {
        "base": f"{same}, or what fits all: --task NAME --base BASE.",
        "points": f"{same}.",
        "touch": f"{same}.",
        "tasks_per_class": f"{same}.",
        "object": suite,
    }
    usual = {"points": 0, "touch": False, "object": "its own"}
    for name, mend in mends.items():
        values = {str(form[_FORM.index(name)] or usual.get(name)) for form in forms}
        if len(values) > 1:
            raise BidexError(f"The data sets of {which[0]} differ in {name}: {' and '.join(sorted(values))}. {mend}")
    return {name: value for name, value in zip(_FORM, forms[0], strict=True) if value is not None}


def task_seed(datasets: Sequence[Dataset]) -> int | None:
    """Return the seed of the tasks of the data sets: a learner is evaluated on those tasks.

    If the seeds differ, the first data set's seed is returned, and a line is logged.
    """
    if not datasets:
        return None
    seeds = [dataset.metadata.get("seed") for dataset in datasets]
    if len({*seeds}) > 1:
        say(f"The data sets have tasks of the seeds {', '.join(map(str, seeds))}; evaluations play those of the first.")
    return seeds[0]


def check_offline(kind: LearnerKind, record: int, datasets: Sequence[Dataset], source: Worlds) -> None:
    """Raise BidexError if a learner cannot train on the given data sets.

    This is the case if an offline learner has no data, or another learner has some; if ``record`` is set for an offline
    learner; if several processes share an offline run; or if the data's observations do not fit ``source``.
    """
    if Capability.OFFLINE not in kind.capabilities:
        if datasets:
            names = ", ".join(name for name in ALGOS if Capability.OFFLINE in learner_kind(name).capabilities)
            raise BidexError(f"{kind.name} learns by playing; --dataset goes with {names}. Leave one of them out.")
        return
    if not datasets:
        raise BidexError(f"{kind.name} learns from data. Add --dataset NAME (see bidex-meta data list).")
    if record:
        raise BidexError(f"{kind.name} does not play, so there is nothing to record. Leave --record out.")
    if launch().count > 1:
        raise BidexError(
            f"{kind.name} learns in one process, but there are {launch().count}. Start it without torchrun."
        )
    for dataset in datasets:
        _check_shown(dataset, source)


def check_demonstrations(kind: LearnerKind, names: Sequence[str], source: Worlds) -> None:
    """Raise BidexError if a learner cannot imitate the given demonstrations; only their metadata are read.

    The demonstrations must be of classes of ``source``, with the same number of actions (that is, the same kind of
    bases) and fitting observations.
    """
    if names and Capability.IMITATES not in kind.capabilities:
        takers = ", ".join(name for name in ALGOS if Capability.IMITATES in learner_kind(name).capabilities)
        raise BidexError(f"{kind.name} does not imitate; --demonstrations goes with {takers}. Leave one of them out.")
    for dataset in open_datasets(names):
        classes = source.task_classes()
        for slot in dataset.metadata["tasks"]:
            known_name(f"class in {source.name} of", name_among(slot.partition("/")[0], classes), classes)
        _check_shown(dataset, source)
        actions = max(task_class.action_size for task_class in classes.values())
        if dataset.action_size != actions:
            if dataset.action_size > actions:
                mend = "Add --base moving"
            else:
                mend = "Record it with the same bases"
            raise BidexError(
                f"{dataset.name} has {dataset.action_size} actions, {source.name} here {actions}: its bases do not "
                f"move alike. {mend}."
            )


def _check_shown(dataset: Dataset, source: Worlds) -> None:
    """Raise BidexError if the observations of a data set do not fit those of ``source``.

    Both must have the same touch sensors. If ``source`` shows the goals, the data must show the goals too. If
    ``source`` hides the goals, the data may still show the goals, unless the observations contain point clouds.
    """
    check_touch(dataset, source.touch)
    about = dataset.metadata
    if about.get("hides_goals", source.hides_goals) == source.hides_goals:
        return
    if about["hides_goals"]:
        raise BidexError(f"{dataset.name} hides goals, {source.name} shows them. Record a data set on {source.name}.")
    if about.get("points"):
        raise BidexError(f"{dataset.name} has point clouds, but {source.name} hides goals. Record without --points.")


def announced(names: Sequence[str], what: str, source: Worlds) -> list[Dataset]:
    """Open data sets, log their total size after the text ``what``, and return the data sets.

    A note is logged for each data set that was recorded under other rules than those of ``source``.
    """
    datasets = open_datasets(names)
    steps = sum(dataset.num_steps for dataset in datasets)
    episodes = sum(dataset.num_episodes for dataset in datasets)
    say(f"{what} {steps:,} transitions of {episodes:,} episodes.")
    for dataset in datasets:
        recorded = dataset.metadata.get("rules")
        if isinstance(recorded, Mapping) and source.rules and (apart := rules_apart(recorded, source.rules)):
            say(f"Note: {dataset.name} was recorded by other rules than those of {source.name}: {apart}.")
    return datasets
