"""Plan ``bidex-meta transfer``: a suite file per held-out class, the class's demonstrations, and a run per cell."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium.spaces import Box

from bidex_meta.cli.run_flags import config_of_words
from bidex_meta.config import RunConfig
from bidex_meta.data import Dataset, open_dataset, part_files, writer
from bidex_meta.data.collect import collect_successes, progress, resumed_writer
from bidex_meta.errors import BidexError, known_name
from bidex_meta.evaluation.transfer_measures import NOTHING
from bidex_meta.experiments.run_data import dataset_metadata
from bidex_meta.experiments.sweep_plan import PlannedRun, words_of
from bidex_meta.runs import RunFolder
from bidex_meta.runs.atomic import write_atomic
from bidex_meta.suite import V1, Suite, SuiteClass, plain_name
from bidex_meta.training.launch import say
from bidex_meta.utils.files import absolute, is_file, read_text
from bidex_meta.utils.plugins import short_name
from bidex_meta.witness.demonstrators import Scripted
from bidex_meta.witness.scripts import scripts_of
from bidex_meta.worlds import Worlds, WorldsConfig

_NETWORK = ("architecture", "hidden", "activation", "normalise_observations", "point_widths")
"""Fields of a learner's config that a policy to start from must share."""
_ALGO = "ppo"
_PRESET = "laptop"
_USUAL = (f"--preset={_PRESET}", "--logger=none", "--learner.demonstration-cloning=5000")
_EVALUATIONS = 100  # evaluations of a run by reinforcement, evenly spaced
_LONG = 10**9  # steps in which only the critic learns, so that a run by demonstrations keeps the cloned policy
_PATIENCE = 3  # most rounds of a script


@dataclass(frozen=True)
class Cell:
    """One run of a table."""

    run: PlannedRun
    task: str  # the held-out class
    arm: str  # what it starts from
    demonstrations: int | None  # None: by reinforcement


class Arm(NamedTuple):
    """A start of training: a run's policy, or a fresh policy."""

    name: str
    path: Path | None  # the run's folder; None: a fresh policy
    network: list[str]  # words of its network


def arms_of(paths: Sequence[Path]) -> list[Arm]:
    """Return the first run, a fresh policy with the first run's network, and the other runs."""
    folders = [RunFolder.open(absolute(path)) for path in paths]
    values = [folder.config().learner_values for folder in folders]
    network = [[w for n in _NETWORK if n in own for w in words_of(f"learner.{n}", own[n])] for own in values]
    arms = [Arm(folder.path.name, folder.path, words) for folder, words in zip(folders, network, strict=True)]
    arms.insert(1, Arm(NOTHING, None, network[0]))
    names = [arm.name for arm in arms]
    for name in names:
        if names.count(name) > 1:
            raise BidexError(f"Two starts are called {name}. Name runs whose folders are called differently.")
    return arms


def held_out(worlds: Worlds, asked: Sequence[str]) -> list[str]:
    """Return the held-out classes of a suite (tested, not trained on), all or the requested ones.

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


def _toml(value: object) -> str:
    """Format a value as TOML on one line; leave empty entries out of tables."""
    if isinstance(value, dict):
        entries = (f"{json.dumps(key)} = {_toml(each)}" for key, each in value.items() if each not in ([], {}))
        return f"{{ {', '.join(entries)} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value, ensure_ascii=False)


def demonstrations_of(file: Path, name: str, given: Sequence[str], folder: Path, count: int) -> Dataset | None:
    """Return demonstrations of a class: a given data set, else at least ``count`` episodes of the class's script.

    Returns None if there is neither a data set nor a script. BidexError is raised for a data set of other rules,
    because an episode that succeeds under other rules may fail here.
    """
    worlds = Worlds.open(WorldsConfig(suite=str(file)))
    task = worlds.task_classes()[name]
    for dataset in map(open_dataset, given):
        if [plain_name(slot.partition("/")[0]) for slot in dataset.metadata["tasks"]] != [name]:
            continue
        if dataset.metadata.get("rules", asdict(V1)) != asdict(task.rules):
            raise BidexError(
                f"--data {dataset.name} has {name} by other rules than {file.stem}. Record it by the suite's version "
                "(docs/versions.md)."
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


def shared_words(num_envs: int, more: Sequence[str]) -> list[str]:
    """Return the words of all runs; ``more`` holds the user's words, which override the usual words."""
    return [*_USUAL, *more, f"--algo={_ALGO}", f"--num-envs={num_envs}"]


def reinforced(steps: int, planned: RunConfig[Any]) -> list[str]:
    """Return the words of a run by reinforcement: evaluate 100 times, or after each iteration; [] for 0 steps."""
    iteration = planned.num_envs * planned.learner_values["rollout_steps"]
    if steps:
        return [f"--steps={steps}", f"--evaluate-every={max(1, steps // (_EVALUATIONS * iteration))}"]
    return []


def cells_of(
    file: Path, name: str, arms: Sequence[Arm], seed: int, words: Sequence[str], out: Path, steps: list[str],
    counts: Sequence[int], dataset: Dataset | None
) -> Iterator[Cell]:  # fmt: skip
    """Yield the cells of a class and seed: for each arm one per count of demonstrations, then by reinforcement.

    Without a data set only the cells without demonstrations are yielded, without ``steps`` none by reinforcement.
    """
    for count in (count for count in counts if not count or dataset is not None):
        track = ["--steps=1", f"--learner.critic-first={_LONG}"]  # one iteration
        if count and dataset is not None:
            track.append(f"--demonstrations={absolute(some_of(dataset, name, count, seed, out / 'data'))}")
        yield from (_cell(file, name, arm, seed, [*words, *track], out, count) for arm in arms)
    if steps:
        yield from (_cell(file, name, arm, seed, [*words, *steps], out, None) for arm in arms)


def _cell(file: Path, name: str, arm: Arm, seed: int, words: list[str], out: Path, count: int | None) -> Cell:
    if arm.path is None:
        start = []
    else:
        start = [f"--start-from={arm.path}"]
    if count is None:
        how = _ALGO
    else:
        how = f"{count}-demonstrations"
    path = out / "runs" / f"{short_name(name)}-{arm.name}-{how}-seed{seed}".replace(" ", "-")
    run = PlannedRun(path, arm.name, name, seed, (f"--suite={file}", *words, *arm.network, *start))
    return Cell(replace(run, config=config_of_words(run.begin[1:])), name, arm.name, count)
