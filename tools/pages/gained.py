"""Meta-tests: success after each shot, and each run's gain compared with a control without meta-training."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from math import hypot
from typing import TYPE_CHECKING

import numpy as np

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.statistics import Estimate
from bidex_meta.runs import plots
from bidex_meta.runs.evaluations import MetaTestEvaluation, SplitSummary
from bidex_meta.runs.stored import StoredRun
from bidex_meta.utils.files import read_json
from tools.pages.studies import Study
from tools.pages.tables import mean_and_range, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CONTROL = "control"
"""The arm that others are compared with: same starting policy and adaptation, no meta-training."""
_HEAD = ("class", "arm", "seed", "steps", "shots × rollouts", "success", "return", "gain [95 %]", "over control [95 %]")


def gains_table(study: Study) -> Iterator[str]:
    """Yield one row per run, class by class; a gain whose interval excludes zero is bold.

    A gain is the meta-test's gain in return, with an interval over adaptations and their episodes. "Over control" is
    the difference to the gain of the control's run of the same seed; half widths add as independent errors (the root
    of the sum of squares). The split is that of the study, by default ``test``. Raises BidexError if a run has no
    meta-test of the split, or if an arm has several runs of one seed.
    """
    split = study.split or "test"
    parts: dict[tuple[str, int], tuple[StoredRun, SplitSummary]] = {}
    for run in study.runs:
        part = _splits(run).get(split)
        key = (run.arm, run.config().seed)
        if part is None:
            raise BidexError(f"Study {study.name}: {run.path} has no meta-test of {split} tasks. Leave it out.")
        if key in parts:
            raise BidexError(f"{run.path} and {parts[key][0].path.name} are both seed {key[1]} of the arm {key[0]!r}.")
        parts[key] = run, part
    rows = []
    for name in dict.fromkeys(chain.from_iterable(part.after.classes for _, part in parts.values())):
        for arm, seed in sorted(parts, key=lambda key: (key[0] == CONTROL, *key)):
            run, part = parts[arm, seed]  # all runs of a study cover the same classes
            gain = _gain(part, name)
            over = ""
            if arm != CONTROL and (CONTROL, seed) in parts:
                _, control = parts[CONTROL, seed]
                over = _bold(_over(gain, _gain(control, name)))
            rows.append([
                name, arm, str(seed), f"{run.content['steps']:,}", f"{part.shots} × {part.rollouts}",
                _both(part, name, "success", 100.0, " %"), _both(part, name, "mean_return"), _bold(gain), over,
            ])  # fmt: skip
    return table(_HEAD, rows)


def shots_table(*studies: Study) -> Iterator[str]:
    """Yield a row per arm and per line of a ladder.

    A row has the success after each shot, as mean over seeds (least to most), and the return before the first shot and
    after the last. The runs need a meta-test of ``Study.split`` or of a single split. One study has rows per class.
    With several studies each has one row per arm, the mean over the study's classes.
    """
    found = _by_shot(studies)
    most = max(len(seeds.shares[0]) for seeds in found.values())
    rows = []
    for (name, arm), seeds in found.items():
        shown = [mean_and_range(100.0 * np.array(each), ".3g", " %") for each in zip(*seeds.shares, strict=True)]
        shown += [""] * (most - len(shown))
        made = f"{int(np.mean(seeds.steps)):,}" if seeds.steps else "–"
        paid = " → ".join(f"{value:.3g}" for value in np.mean(seeds.returns, axis=0)) if seeds.returns else ""
        rows.append([name, arm, str(len(seeds.shares)), made, *shown, paid])
    first = "class" if len(studies) == 1 else "suite"
    return table([first, "arm", "seeds", "steps", "before", *(f"after {n}" for n in range(1, most)), "return"], rows)


def shots_figure(*studies: Study) -> "Figure":
    """Draw success against exploring episodes: a panel per class or suite, a line per arm.

    A policy that knows the goal has one value. Studies are as in ``shots_table``.
    """
    found = _by_shot(studies)
    panels: dict[str, list[plots.Group]] = {}
    most = max(len(seeds.shares[0]) for seeds in found.values())
    for (name, arm), seeds in found.items():
        shares = np.array([each * most if len(each) == 1 else each for each in seeds.shares])
        several = len(shares) > 1
        low, high = (shares.min(0), shares.max(0)) if several else (None, None)
        curve = plots.Curve(np.arange(shares.shape[1]), shares.mean(0), low, high)
        panels.setdefault(name, []).append((arm, {"success": curve}))
    figure = plots.draw_panels(panels, "success", "success", (1.0, "exploring episodes"))
    for axis in figure.axes:
        axis.set_xticks(range(most))
    return figure


@dataclass
class _Seeds:
    """Results of an arm's seeds, or of a ladder's line, on one class or suite."""

    shares: list[list[float]] = field(default_factory=list)  # Success before and after each shot.
    steps: list[int] = field(default_factory=list)
    returns: list[list[float]] = field(default_factory=list)  # Before, and after the last shot.


def _by_shot(studies: Sequence[Study]) -> dict[tuple[str, str], _Seeds]:
    """Group results by class (or by suite if there are several studies) and arm: best first, lines of ladders last."""
    found: dict[tuple[str, str], _Seeds] = {}

    def rows(study: Study, classes: dict[str, list[float]]) -> dict[str, list[float]]:
        return classes if len(studies) == 1 else {study.on: np.mean(list(classes.values()), axis=0).tolist()}

    for study in studies:
        for run in study.runs:
            splits = _splits(run)
            by_shot = splits[study.split or (next(iter(splits)) if len(splits) == 1 else "test")].by_shot
            success = {}
            mean_returns = {}
            for name in by_shot[0].classes:
                success[name] = [shot.classes[name].success for shot in by_shot]
                mean_returns[name] = [shot.classes[name].mean_return for shot in by_shot]
            shares = rows(study, success)
            returns = rows(study, mean_returns)
            for name in shares:
                seeds = found.setdefault((name, run.arm), _Seeds())
                seeds.shares.append(shares[name])
                seeds.returns.append([returns[name][0], returns[name][-1]])
                seeds.steps.append(run.content["steps"])
        for path in study.ladders:
            for line, classes in read_json(path, "a ladder").items():
                for name, shares in rows(study, classes).items():
                    found.setdefault((name, line), _Seeds()).shares.append(shares)

    def place(item: tuple[tuple[str, str], _Seeds]) -> tuple[str, bool, float]:
        (name, _), seeds = item
        of_ladder = not seeds.steps
        return name, of_ladder, 0.0 if of_ladder else -float(np.mean([shares[-1] for shares in seeds.shares]))

    return dict(sorted(found.items(), key=place))


def _splits(run: StoredRun) -> dict[str, SplitSummary]:
    """Return the splits of a run's meta-test; empty without one."""
    evaluation = run.evaluation()
    if isinstance(evaluation, MetaTestEvaluation):
        return evaluation.splits
    return {}


def _gain(part: SplitSummary, name: str) -> Estimate:
    """Return the gain of the return."""
    gain = None if part.gain is None else part.gain.classes[name]["return"]
    if gain is None:
        raise BidexError(f"The meta-test of {part.split} tasks has no gain in {name}. Evaluate again.")
    return gain


def _over(gain: Estimate, control: Estimate) -> Estimate:
    """Return the difference of two gains that were measured independently."""
    value = gain.value - control.value
    if gain.interval is None or control.interval is None:
        return Estimate(value, None)
    low = hypot(gain.value - gain.interval[0], control.interval[1] - control.value)
    high = hypot(gain.interval[1] - gain.value, control.value - control.interval[0])
    return Estimate(value, (value - low, value + high))


def _both(part: SplitSummary, name: str, measure: str, factor: float = 1.0, unit: str = "") -> str:
    before = factor * getattr(part.before.classes[name], measure)
    after = factor * getattr(part.after.classes[name], measure)
    return f"{before:.4g} → {after:.4g}{unit}"


def _bold(found: Estimate) -> str:
    """Format an estimate, in bold if its interval excludes zero."""
    value, space, ends = found.text(form="+.3g").partition(" ")
    return f"**{value}**{space}{ends}" if found.excludes_zero else value + space + ends
