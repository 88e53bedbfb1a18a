"""Plan a transfer experiment, which trains on held-out classes from a run's policy and from scratch.

The plan consists of a suite file and demonstrations for each held-out class, and of the runs to train.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium.spaces import Box

from bidex_meta.data import Dataset, open_dataset, part_files, writer
from bidex_meta.data.collect import collect_successes, progress, resumed_writer
from bidex_meta.errors import BidexError, known_name
from bidex_meta.evaluation.transfer_measures import NOTHING
from bidex_meta.experiments.evaluating import FinalEvaluation
from bidex_meta.experiments.learners import learner_kind
from bidex_meta.experiments.run_config import check, resolve
from bidex_meta.experiments.run_data import dataset_metadata
from bidex_meta.experiments.sweep_plan import PlannedRun
from bidex_meta.rules import V1, plain_name
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import write_atomic
from bidex_meta.runs.folder import AnyConfig
from bidex_meta.suite import Suite, SuiteClass
from bidex_meta.training.launch import say
from bidex_meta.utils.files import JsonObject, absolute, is_file, read_text
from bidex_meta.utils.plugins import short_name
from bidex_meta.witness.demonstrators import Scripted
from bidex_meta.witness.scripts import scripts_of
from bidex_meta.worlds import Worlds, WorldsConfig, open_worlds

_NETWORK = ("architecture", "hidden", "activation", "normalise_observations", "point_widths")
"""Fields of a learner's config that a policy to start from must share."""
_EVALUATIONS = 100  # evaluations of a reinforcement-learning run, evenly spaced
_LONG = 10**9  # steps in which only the critic learns, so that a run on demonstrations keeps the cloned policy
_PATIENCE = 3  # maximum number of rounds in which a script plays


@dataclass(frozen=True)
class Cell:
    """One run of a transfer experiment: a class, an initial policy, a number of demonstrations, and a seed."""

    run: PlannedRun
    task: str  # the held-out class
    arm: str  # name of the initial policy: a run, or from scratch
    demonstrations: int | None  # number of episodes; None: by reinforcement


class Arm(NamedTuple):
    """A policy from which training starts: the policy of a run, or a fresh policy."""

    name: str
    path: Path | None  # the run's folder; None: a fresh policy
    network: JsonObject  # the values of the learner's config that decide the network


def arms_of(folders: Sequence[RunFolder]) -> list[Arm]:
    """Return the initial policies that a transfer experiment compares.

    They are the policy of the first run, untrained weights with the network of the first run, and the policies of the
    other runs, in this order. Raises BidexError if two runs' folders have the same name.
    """
    arms = []
    for folder in folders:
        values = folder.config().learner_values
        network = {name: values[name] for name in _NETWORK if name in values}
        path = absolute(folder.path)
        arms.append(Arm(path.name, path, network))
    arms.insert(1, Arm(NOTHING, None, arms[0].network))
    names = [arm.name for arm in arms]
    for name in names:
        if names.count(name) > 1:
            raise BidexError(f"Two starts are called {name}. Name runs whose folders have different names.")
    return arms


def held_out(worlds: Worlds, asked: Sequence[str]) -> list[str]:
    """Return the held-out classes of a suite (tested, not trained on): all of them, or those requested.

    Raises BidexError if the suite has no held-out class.
    """
    if worlds.suite is None:
        classes = []
    else:
        classes = worlds.suite.classes
    found = [entry.name for entry in classes if entry.splits == ("test",)]
    if not found:
        raise BidexError(
            f"Expected a run on a suite with classes that are not trained on (ML4-v2, ML20-v2), got one on "
            f"{worlds.name}. Name another run."
        )
    return list(dict.fromkeys(known_name(f"held-out class of {worlds.name}", name, found) for name in asked)) or found


def suite_file(worlds: Any, name: str, folder: Path) -> Path:
    """Write a copy of the suite into ``folder`` in which only one held-out class is trained on; return the path.

    Padding, hidden goals, rules and the class's 50 tasks are those of the meta-test.
    """
    suite: Suite = worlds.suite
    names = worlds.benchmark.task_classes("test")[name].variation_space.names
    tasks = [task.variation.tolist() for task in worlds.benchmark.tasks_of(name, "test")]
    listed = [{"name": str(i), "fixed": dict(zip(names, task, strict=True))} for i, task in enumerate(tasks)]
    entries = [_entry(each, "train" if each.name == name else "test") for each in suite.classes]
    for entry, each in zip(entries, suite.classes, strict=True):
        entry["tasks"] = listed if each.name == name else [vars(task) | {"split": "test"} for task in each.tasks]
    content: dict[str, object] = {
        "name": f"{suite.file.stem}-{short_name(name)}", "version": suite.version, "kind": "meta",
        "description": f"{name} of {suite.name}: its test tasks of seed {worlds.seed}, to be trained on",
        "observation": suite.observation, "task_id": suite.task_id, **vars(suite.rules), "base": suite.base,
    }  # fmt: skip
    if not all(entry["tasks"] for entry in entries):
        content["tasks_per_class"] = suite.tasks_per_class
    if suite.points:
        content["points"] = {"count": suite.points, "kinds": suite.point_kinds}
    if suite.touch:
        content["touch"] = True
    if suite.randomisation is not None:
        content["randomisation"] = {key: _listed(value) for key, value in vars(suite.randomisation).items()}
    lines = [f"{key} = {_toml(value)}" for key, value in content.items()]
    text = "\n".join([*lines, "classes = [", *(f"    {_toml(entry)}," for entry in entries), "]\n"])
    path = folder / f"{content['name']}.toml"
    if is_file(path) and read_text(path, "a suite file") != text:
        raise BidexError(f"{path} is of other tasks than those of {worlds.name}'s meta-test. Name another --out.")
    write_atomic(path, lambda file: file.write(text.encode()))
    return absolute(path)


def _entry(each: SuiteClass, split: str) -> dict[str, Any]:
    if each.gamma is not None:
        own = {"gamma": each.gamma}
    else:
        own = {}
    scale = {"reward_scale": each.reward_scale, "options": dict(each.options)}
    return {"name": each.class_name, "split": split, **scale, **own}


def _listed(value: object) -> object:
    """Return a tuple as a list, and any other value unchanged."""
    if isinstance(value, tuple):
        return list(value)
    return value


def _toml(value: object) -> str:
    """Format a value as TOML on one line; leave empty entries out of tables."""
    if isinstance(value, dict):
        entries = (f"{json.dumps(key)} = {_toml(each)}" for key, each in value.items() if each not in ([], {}))
        return f"{{ {', '.join(entries)} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value, ensure_ascii=False)


def demonstrations_of(file: Path, name: str, given: Sequence[str], folder: Path, count: int) -> Dataset | None:
    """Return demonstrations of a class: a given data set, or at least ``count`` episodes of the class's script.

    Returns None if there is neither a data set nor a script. BidexError is raised for a data set that was recorded
    under other rules, because an episode that succeeds under other rules may fail here.
    """
    worlds = open_worlds(WorldsConfig(suite=str(file)))
    task = worlds.task_classes()[name]
    for dataset in map(open_dataset, given):
        if [plain_name(slot.partition("/")[0]) for slot in dataset.metadata["tasks"]] != [name]:
            continue
        if dataset.metadata.get("rules", asdict(V1)) != asdict(task.rules):
            raise BidexError(
                f"--data {dataset.name} has {name} with other rules than {file.stem}. Record it with the suite's "
                "version (docs/versions.md)."
            )
        return dataset
    if not task.moving_base or task.name not in scripts_of(task.rules):
        return None
    folder = folder / f"{short_name(name)}-script-v0"
    if _is_complete(folder):
        return open_dataset(folder)
    say(f"{name}: its script plays until {count} of its episodes have succeeded.")
    plan = {"kind": "demonstrations", "suite": str(file), "size": count}
    with writer.claimed(folder, plan):
        world: Any = worlds.world("train")
        writer.begin(folder, plan)
        out = resumed_writer(folder)
        while progress(out).episodes[0] < count and out.parts < _PATIENCE:
            collect_successes(world, lambda seed: Scripted(world, seed=seed), out, 0)
        about = dataset_metadata(worlds, world, "demonstrations", [{"algo": None, "actions": "script"}])
        writer.finish(folder, folder.name, world.single_observation_space, world.single_action_space, about)
        world.close()
    return open_dataset(folder)


def some_of(dataset: Dataset, name: str, count: int, seed: int, folder: Path) -> Path:
    """Write a data set of ``count`` successful episodes, drawn by the seed; return its folder.

    With the same seed, a smaller draw is part of a larger one. BidexError is raised if there are too few episodes.
    """
    folder = folder / f"{short_name(name)}-{count}-seed{seed}-v0"
    source = str(absolute(dataset.folder))
    if _is_complete(folder):
        if (before := open_dataset(folder).metadata.get("drawn_from")) != source:
            raise BidexError(f"{folder} was drawn from {before}, not {source}. Leave --data as it was, or --out.")
        return folder
    solved = np.flatnonzero(dataset.table["success"])
    if len(solved) < count:
        raise BidexError(
            f"Expected {count} successful episodes of {name}, found {len(solved)} in {dataset.name}. Give more by "
            "--data, or ask for fewer --demonstrations."
        )
    drawn = {*np.random.default_rng(seed).permutation(solved)[:count].tolist()}
    plan = {"kind": "demonstrations", "of": source, "size": count, "seed": seed}
    with writer.claimed(folder, plan):
        writer.begin(folder, plan)
        out = writer.DatasetWriter(folder)
        for number, episode in enumerate(dataset.episodes()):
            if number in drawn:
                out.add(episode)
        out.commit()
        spaces = (Box(-np.inf, np.inf, (dataset.observation_size,)), Box(-1.0, 1.0, (dataset.action_size,)))
        about = dataset.metadata | {"tasks": [name], "reward_scales": {}, "drawn_from": source}
        writer.finish(folder, folder.name, *spaces, about)
    return folder


def _is_complete(folder: Path) -> bool:
    inner = folder / "data"
    return is_file(inner / part_files.METADATA) and not is_file(inner / part_files.RECORDING)


def evaluate_every(steps: int, config: AnyConfig) -> int:
    """Return the number of iterations between evaluations, for about 100 evaluations of a run; at least 1."""
    iteration = config.num_envs * config.learner_values["rollout_steps"]
    return max(1, steps // (_EVALUATIONS * iteration))


def cells_of(
    config: AnyConfig, final: FinalEvaluation, file: Path, name: str, arms: Sequence[Arm], out: Path, steps: int,
    counts: Sequence[int], dataset: Dataset | None
) -> Iterator[Cell]:  # fmt: skip
    """Yield the runs of a transfer experiment on one class, with the seed of ``config``.

    For each entry of ``counts`` there is a run per arm (initial policy) that learns from this number of demonstrations.
    After these there is a run per arm that trains by reinforcement learning for ``steps`` steps; none if ``steps`` is
    0. Without a data set, counts above 0 are left out.
    """
    preset = replace(config, learner=learner_kind(config.algo).presets[config.preset]).learner_values
    changed = {key: value for key, value in config.learner_values.items() if value != preset[key]}
    # The share of the recorded environments follows from the steps, which differ between the tracks.
    base = replace(config, suite=str(file), record_share=0.0)
    tracks: list[tuple[int | None, AnyConfig]] = []
    for count in counts:
        if count and dataset is None:
            continue
        data = config.demonstrations
        if count and dataset is not None:
            data = (str(absolute(some_of(dataset, name, count, config.seed, out / "data"))),)
        once = changed | {"critic_first": _LONG}
        tracks.append((count, replace(base, steps=1, demonstrations=data, learner=once)))  # one iteration is enough
    if steps:
        every = evaluate_every(steps, config)
        tracks.append((None, replace(base, steps=steps, evaluate_every=every, learner=changed)))
    for count, track in tracks:
        how = config.algo if count is None else f"{count}-demonstrations"
        for arm in arms:
            start = None if arm.path is None else str(arm.path)
            given = replace(track, start_from=start, learner=track.learner | arm.network)
            path = out / "runs" / f"{short_name(name)}-{arm.name}-{how}-seed{config.seed}".replace(" ", "-")
            resolved = resolve(given)
            check(resolved)
            yield Cell(PlannedRun(path, given, arm.name, final, resolved), name, arm.name, count)
