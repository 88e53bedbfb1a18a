"""A study: the runs of ``results/data/STUDY.json``, grouped by arm, and its pictures."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bidex_meta.config import flat
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.comparison import Group, curves_of, group_of
from bidex_meta.evaluation.statistics import Estimate, iqm_over_seeds
from bidex_meta.runs import plots
from bidex_meta.runs.evaluations import ClassSummary, PolicyEvaluation
from bidex_meta.runs.stored import StoredRun, read_study
from bidex_meta.utils.plugins import short_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FREE = ("seed", "start_from", "device", "threads", "logger", "evaluate_every", "video_every", "processes", "preset")
"""Config entries in which the runs of an arm may differ."""


@dataclass(frozen=True)
class Arm:
    """The runs of a study that have the same settings but different seeds."""

    group: Group  # Final evaluations of the arm's runs, labelled with the arm's name.
    runs: list[StoredRun]  # Runs of the arm, one or more.

    @cached_property
    def success(self) -> Estimate:
        """Interquartile mean of success over seeds and classes."""
        return iqm_over_seeds(self.group.success)

    @cached_property
    def others(self) -> np.ndarray | None:
        """Success on tasks that were not trained on, (seeds, classes); None if a run has no value for a class."""
        by_seed = []
        for run in self.runs:
            classes = classes_of_others(run)
            if not classes.keys() >= set(self.group.classes):
                return None
            by_seed.append([classes[name].success for name in self.group.classes])
        return np.array(by_seed)

    @property
    def parameters(self) -> int | None:
        """Number of learned parameters of the arm's policy; None if unknown."""
        counts = {run.content["parameters"] for run in self.runs}
        return counts.pop() if len(counts) == 1 else None


@dataclass(frozen=True)
class Study:
    """A study on one suite or class. Its runs are grouped into arms, one for each setting."""

    name: str  # Name of the study's file, without suffix.
    on: str  # The suite or class.
    runs: list[StoredRun]  # All runs, sorted by name.
    split: str | None = None  # Split of a meta-test to show; None: all.

    @cached_property
    def arms(self) -> list[Arm]:
        """Return the arms of the study, best first by the measure of success that tables show.

        Raises BidexError if runs of an arm differ in more than the seed, or do not cover the same classes.
        """
        by_arm: dict[str, list[StoredRun]] = {}
        for run in self.runs:
            by_arm.setdefault(run.arm, []).append(run)
        for name, runs in by_arm.items():
            refuse_differing(name, runs)
        arms = [Arm(self._only(group_of(name, runs)), runs) for name, runs in by_arm.items()]
        if shows_means(arms):
            return sorted(arms, key=lambda arm: -arm.group.success.mean())
        return sorted(arms, key=lambda arm: -arm.success.value)

    def _only(self, group: Group) -> Group:
        """Keep only the classes of a meta-test's ``split``, and strip the split's suffix from their names."""
        ending = f" ({self.split})"
        if self.split is None:
            return group
        kept = [i for i, name in enumerate(group.classes) if name.endswith(ending)]
        if not kept:
            raise BidexError(f"Study {self.name}: {group.paths[0]} has no {self.split} classes. Leave split out.")
        classes = [group.classes[i].removesuffix(ending) for i in kept]
        scores = None if group.scores is None else group.scores[:, kept]
        return replace(
            group, classes=classes, success=group.success[:, kept], returns=group.returns[:, kept], scores=scores
        )

    @property
    def classes(self) -> list[str]:
        """All classes of the study's arms."""
        return list(dict.fromkeys(chain.from_iterable(arm.group.classes for arm in self.arms)))


def shows_means(arms: Sequence[Arm]) -> bool:
    """Return whether tables show means of success, not interquartile means: an arm was evaluated on other tasks."""
    return any(arm.others is not None for arm in arms)


def read_studies(data: Path, name: str, on: str | None = None, split: str | None = None) -> list[Study]:
    """Return the studies in ``data/name.json``, one for each set of classes; [] if there is no such file.

    Suites with the same classes, such as a suite with other discounts, form one study. Runs on single classes join a
    suite's study if an arm covers all classes of the suite; otherwise they form one study per class. ``on`` restricts
    the result to a suite or class. Raises BidexError if the file cannot be read.
    """
    file = data / f"{name}.json"
    runs = read_study(file) if file.exists() else []
    whole = [run for run in runs if run.config().task is None]
    by_classes: dict[frozenset[str], list[StoredRun]] = {}
    for run in whole:
        by_classes.setdefault(frozenset(run.evaluation().results), []).append(run)
    alone = [run for run in runs if run.config().task is not None]
    for classes, members in by_classes.items():
        joining = [run for run in alone if _covered(run, alone) == classes]
        members += joining
        alone = [run for run in alone if run not in joining]
    for run in alone:
        by_classes.setdefault(frozenset([str(run.config().task)]), []).append(run)
    found = [Study(name, _subject(members), members, split) for members in by_classes.values()]
    return [study for study in sorted(found, key=lambda study: study.on) if on in (None, study.on)]


def digest_of(studies: Sequence[Study]) -> str:
    """Return a digest of all data that pictures of the studies show."""
    found = hashlib.sha256()
    for study in studies:
        found.update(json.dumps([run.content for run in study.runs]).encode())
    return found.hexdigest()


def classes_of_others(run: StoredRun) -> dict[str, ClassSummary]:
    """Return a run's results on tasks that it was not trained on; empty if there are none."""
    evaluation = run.evaluation()
    if isinstance(evaluation, PolicyEvaluation) and evaluation.other_tasks is not None:
        return evaluation.other_tasks.policy.classes
    return {}


def classes_of_random(run: StoredRun) -> dict[str, ClassSummary]:
    """Return the results of uniform actions in a run's evaluation; empty if there are none."""
    evaluation = run.evaluation()
    if isinstance(evaluation, PolicyEvaluation) and evaluation.random is not None:
        return evaluation.random.classes
    return {}


def curves_figure(study: Study) -> "Figure":
    """Draw learning curves, one line per arm."""
    return plots.draw_learning([(arm.group.label, curves_of(arm.runs)) for arm in study.arms])


def bars_figure(*studies: Study) -> "Figure":
    """Draw success per class as bars, one colour per arm, with the range over seeds.

    Raises ValueError if two arms have the same name.
    """
    groups: dict[str, list[plots.Bar]] = {}
    for arm in chain.from_iterable(study.arms for study in studies):
        label = arm.group.label
        if label in groups:
            raise ValueError(f"two arms are named {label!r}")
        percent = 100.0 * arm.group.success.T  # (classes, seeds)
        groups[label] = [
            (name, seeds.mean(), (seeds.min(), seeds.max()))
            for name, seeds in zip(arm.group.classes, percent, strict=True)
        ]
    return plots.draw_bars(groups, "success (%); lines show the range over seeds")


def _subject(runs: Sequence[StoredRun]) -> str:
    """Return the suite or class of the runs; among several suites with the same classes, the shipped suite."""
    suites = [run.content["suite"] for run in runs if run.content["suite"] is not None]
    if not suites:
        return short_name(str(runs[0].config().task)).rpartition("/")[2]
    return str(min(suites, key=lambda suite: "file" in suite).get("name"))


def _covered(run: StoredRun, runs: Sequence[StoredRun]) -> frozenset[str]:
    """Return the classes of all ``runs`` that have the same arm and seed as ``run``."""
    same = [other for other in runs if (other.arm, other.config().seed) == (run.arm, run.config().seed)]
    return frozenset(str(other.config().task) for other in same)


def refuse_differing(name: str, runs: Sequence[StoredRun]) -> None:
    """Raise BidexError if the runs of an arm are not different seeds of one setting.

    No two runs may have the same seed and task, or differ in a config entry that both have and that is not in
    ``_FREE``. Entries that only one of the configs has are ignored, because the runs may be from different versions.
    """
    by_seed: dict[tuple[str | None, int], StoredRun] = {}
    for run in runs:
        config = run.config()
        known = by_seed.setdefault((config.task, config.seed), run)
        if known is not run:
            raise BidexError(
                f"{run.path} and {known.path.name} are both seed {config.seed} of the arm {name!r}. Leave one out."
            )
    for run in runs[1:]:
        same = next(known for known in runs if known.config().task == run.config().task)
        first, other = flat(same.content["config"]), flat(run.content["config"])
        for key in first.keys() & other.keys():
            if key not in _FREE and first[key] != other[key]:
                raise BidexError(
                    f"{run.path} and {same.path.name} are both of the arm {name!r}, but {key} is {other[key]} and "
                    f"{first[key]}. Collect one again with --arm."
                )
