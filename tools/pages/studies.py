"""A study: the files of ``results/data/STUDY``, seeds of an arm together, as the tables and pictures of a page."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.comparison import Estimate, Group, classes_of, estimates, group_of, iqm
from bidex_meta.evaluation.histories import curves_of
from bidex_meta.outside import short_name
from bidex_meta.record import plots
from bidex_meta.record.folder import flat
from bidex_meta.record.stored import StoredRun

_FEW = 4
"""Classes up to which their returns stand in the table of arms."""
_FREE = ("seed", "start_from", "device", "threads", "logger", "evaluate_every", "video_every", "processes", "preset")
"""Entries of a config in which seeds of an arm may differ."""


@dataclass(frozen=True)
class Arm:
    """What a study compares: the same on several seeds."""

    group: Group
    """Its runs' final evaluations, labelled with its name."""
    runs: list[StoredRun]
    """Its runs."""

    @property
    def parameters(self) -> int | None:
        """Numbers that its policy has learned; None where that is not known."""
        counts = {run.content["parameters"] for run in self.runs}
        return counts.pop() if len(counts) == 1 else None


@dataclass(frozen=True)
class Study:
    """Arms on one suite or class."""

    name: str
    """Of its folder."""
    on: str
    """The suite or class."""
    runs: list[StoredRun]
    """By the names of their files."""
    split: str | None = None
    """Of a meta-test the split whose classes are shown; None: all."""

    @cached_property
    def arms(self) -> list[Arm]:
        """Its arms, the best first.

        Raises:
            BidexError: Runs of an arm differ in more than the seed, or do not cover the same classes.
        """
        by_arm: dict[str, list[StoredRun]] = {}
        for run in self.runs:
            by_arm.setdefault(run.arm, []).append(run)
        for name, runs in by_arm.items():
            refuse_differing(name, runs)
        arms = [Arm(self._only(group_of(name, runs)), runs) for name, runs in by_arm.items()]
        return sorted(arms, key=lambda arm: -iqm(arm.group.success).value)

    def _only(self, group: Group) -> Group:
        """Of a meta-test the classes of ``split``, by their own names."""
        ending = f" ({self.split})"
        if self.split is None:
            return group
        kept = [i for i, name in enumerate(group.classes) if name.endswith(ending)]
        if not kept:
            raise BidexError(f"Study {self.name}: {group.paths[0]} has no {self.split} classes. Leave split out.")
        return replace(
            group,
            classes=[group.classes[i].removesuffix(ending) for i in kept],
            success=group.success[:, kept],
            returns=group.returns[:, kept],
            scores=None if group.scores is None else group.scores[:, kept],
        )

    @property
    def classes(self) -> list[str]:
        """Every class of its arms."""
        return list(dict.fromkeys(name for arm in self.arms for name in arm.group.classes))

    @property
    def digest(self) -> str:
        """Of all that its pictures show."""
        return hashlib.sha256(b"".join(run.path.read_bytes() for run in self.runs)).hexdigest()


def read_studies(data: Path, name: str, on: str | None = None, split: str | None = None) -> list[Study]:
    """The studies in ``data/name``, none where there are no files: one for each set of classes that runs were made on.

    Suites of the same classes, such as one with other discounts, are one study. Runs on single classes stand beside a
    suite's where an arm's cover all its classes, and else are a study a class.

    Args:
        data: Folder of the studies' folders.
        name: The study's.
        on: A suite or class alone.
        split: See :class:`Study`.

    Raises:
        BidexError: A file cannot be read.
    """
    runs = [StoredRun.open(path) for path in sorted((data / name).glob("*.json"))]
    whole = [run for run in runs if run.config()["task"] is None]
    by_classes: dict[frozenset[str], list[StoredRun]] = {}
    for run in whole:
        by_classes.setdefault(frozenset(classes_of(run.evaluation())), []).append(run)
    alone = [run for run in runs if run.config()["task"] is not None]
    for classes, members in by_classes.items():
        joining = [run for run in alone if _covered(run, alone) == classes]
        members += joining
        alone = [run for run in alone if run not in joining]
    for run in alone:
        by_classes.setdefault(frozenset([run.config()["task"]]), []).append(run)
    found = [Study(name, _subject(members), members, split) for members in by_classes.values()]
    return [study for study in sorted(found, key=lambda study: study.on) if on in (None, study.on)]


def arms_table(study: Study) -> Iterator[str]:
    """Lines of Markdown: an arm a row, then uniform actions."""
    classes = study.classes if len(study.classes) <= _FEW else []
    yield from head_of(["arm", "seeds", "steps", "success, IQM", "score, IQM", *classes, "parameters", "hours"])
    for arm in study.arms:
        group = arm.group
        score = "–" if group.scores is None else _ranged(iqm(group.scores))
        cells = [
            group.label,
            str(len(group.seeds)),
            f"{group.steps:,}",
            _ranged(iqm(group.success), 100.0, " %"),
            score,
        ]
        cells += _means(group, classes, group.returns, 1.0, "")
        yield row_of([*cells, "–" if arm.parameters is None else f"{arm.parameters:,}", f"{group.hours:.2f}"])
    random = _random(study)
    if random.keys() == set(study.classes):
        success = np.array([[np.mean([row["success"] for row in random[name]]) for name in study.classes]])
        cells = ["uniform actions", "", "", f"{100 * iqm(success).value:.1f} %", "–"]
        cells += [f"{np.mean([row['return'] for row in random[name]]):.4g}" for name in classes]
        yield row_of([*cells, "", ""])


def classes_table(study: Study) -> Iterator[str]:
    """Lines of Markdown: success and return of each class, mean over seeds (least to most)."""
    yield from head_of(["arm", "", *study.classes])
    for arm in study.arms:
        group = arm.group
        yield row_of([group.label, "success", *_means(group, study.classes, group.success, 100.0, " %", True)])
        yield row_of([group.label, "return", *_means(group, study.classes, group.returns, 1.0, "", True)])


def figures(study: Study) -> dict[str, Callable[[], Any]]:
    """What is drawn of a study, by name: learning curves, and final success and score as points with intervals."""
    return {
        "curves": lambda: plots.draw_learning([(arm.group.label, curves_of(arm.runs)) for arm in study.arms]),
        "points": lambda: plots.draw_comparison(estimates([arm.group for arm in study.arms])),
    }


def _subject(runs: Sequence[StoredRun]) -> str:
    """The suite or the class; of several suites of the same classes the shipped one."""
    suites = [run.content["suite"] for run in runs if run.content["suite"] is not None]
    if not suites:
        return short_name(runs[0].config()["task"]).rpartition("/")[2]
    return str(min(suites, key=lambda suite: "file" in suite).get("name"))


def _covered(run: StoredRun, runs: Sequence[StoredRun]) -> frozenset[str]:
    """The classes of all runs that share a run's arm and seed."""
    same = [other for other in runs if (other.arm, other.config()["seed"]) == (run.arm, run.config()["seed"])]
    return frozenset(other.config()["task"] for other in same)


def refuse_differing(name: str, runs: Sequence[StoredRun]) -> None:
    """Seeds of an arm may be of versions that know more or fewer options, but what both know is the same."""
    for run in runs[1:]:
        same = next(known for known in runs if known.config()["task"] == run.config()["task"])
        first, other = flat(same.config()), flat(run.config())
        for key in first.keys() & other.keys():
            if key not in _FREE and first[key] != other[key]:
                raise BidexError(
                    f"{run.path} and {same.path.name} are both of the arm {name!r}, but {key} is {other[key]} and "
                    f"{first[key]}. Collect one anew with --arm."
                )


def _random(study: Study) -> dict[str, list[dict[str, float]]]:
    """By class what uniform actions got in each evaluation in which they were played."""
    found: dict[str, list[dict[str, float]]] = {}
    for run in study.runs:
        for name, row in run.evaluation().get("random", {"classes": {}})["classes"].items():
            found.setdefault(name, []).append(row)
    return found


def _means(
    group: Group, classes: Sequence[str], values: np.ndarray, factor: float, unit: str, ends: bool = False
) -> list[str]:
    told = {}
    for name, column in zip(group.classes, factor * values.T, strict=True):
        told[name] = f"{column.mean():.4g}{unit}"
        if ends and len(column) > 1:
            told[name] += f" ({column.min():.4g} to {column.max():.4g})"
    return [told.get(name, "–") for name in classes]


def _ranged(estimate: Estimate, factor: float = 1.0, unit: str = "") -> str:
    told = f"{factor * estimate.value:.1f}{unit}"
    return (
        told if estimate.interval is None else f"{told} [{', '.join(f'{factor * e:.1f}' for e in estimate.interval)}]"
    )


def head_of(names: Sequence[str]) -> Iterator[str]:
    """A table's head in Markdown, two lines."""
    yield row_of(names)
    yield "|" + "---|" * len(names)


def row_of(cells: Sequence[str]) -> str:
    """A table's row in Markdown."""
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"
