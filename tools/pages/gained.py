"""Meta-tests by class: success after each shot, and each run's gain compared with a control without meta-training."""

from collections.abc import Iterator
from itertools import chain
from math import hypot

import numpy as np

from bidex_meta.errors import BidexError
from bidex_meta.evaluation.statistics import Estimate
from bidex_meta.runs.evaluations import MetaTestEvaluation, SplitSummary
from bidex_meta.runs.stored import StoredRun
from tools.pages.studies import Study, refuse_differing
from tools.pages.tables import mean_and_range, table
from tools.pages.validity import read_validity

CONTROL = "control"
"""Name of the arm with which the other arms are compared. Its runs adapt the same initial policy without
meta-training."""
_HEAD = ("class", "arm", "seed", "steps", "shots × rollouts", "success", "return", "gain [95 %]", "over control [95 %]")


def gains_table(study: Study) -> Iterator[str]:
    """Yield a table of gains, with one row for each class and run; a gain whose interval excludes zero is bold.

    A gain is the meta-test's gain in return, with an interval over adaptations and their episodes. "Over control" is
    the gain minus the gain of the control's run with the same seed, if both adapted with the same budget. The half
    width of its interval is the root of the sum of both gains' squared half widths (independent errors). The split is
    the study's split, by default ``test``. Raises BidexError if a run has no meta-test of the split, or if an arm has
    several runs with the same seed.
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
                if _budget(control) == _budget(part):
                    over = _bold(_over(gain, _gain(control, name)))
            rows.append([
                name, arm, str(seed), f"{run.content['steps']:,}", f"{part.shots} × {part.rollouts}",
                _both(part, name, "success", 100.0, " %"), _both(part, name, "mean_return"), _bold(gain), over,
            ])  # fmt: skip
    return table(_HEAD, rows)


def adaptation_table(study: Study) -> Iterator[str]:
    """Yield a table of success after 0, 1, ... shots, with a row for each class and one for the mean.

    A cell shows the mean over the study's runs, which are seeds of one arm, and the lowest and highest value of a run.
    "Above blind" is the success after the last shot, minus what is possible without knowing the goal according to
    ``validity/SUITE.json``. The split is the study's split, by default ``test``. Raises BidexError if a run has no
    meta-test of the split, or if the runs are not seeds of one arm.
    """
    split = study.split or "test"
    refuse_differing(study.name, study.runs)
    parts = []
    for run in study.runs:
        if split not in _splits(run):
            raise BidexError(f"Study {study.name}: {run.path} has no meta-test of {split} tasks. Leave it out.")
        parts.append(_splits(run)[split].by_shot)
    suite = str(study.runs[0].content["suite"]["name"])
    possible = read_validity(study.runs[0].path.parent.parent, suite)
    names = list(parts[0][0].classes)
    blind = {name: 100.0 * possible[name]["blind"] for name in names}
    blind["mean"] = float(np.mean([*blind.values()]))
    success = {
        name: 100.0 * np.array([[shot.classes[name].success for shot in shots] for shots in parts]) for name in names
    }
    success["mean"] = np.mean([*success.values()], axis=0)
    rows = []
    for name, found in success.items():
        shares = [mean_and_range(each, ".3g", " %") for each in found.T]
        rows.append([name, f"{blind[name]:.1f} %", *shares, f"{found[:, -1].mean() - blind[name]:+z.0f}"])
    shots = ["before", *(f"after {number + 1}" for number in range(len(parts[0]) - 1))]
    return table(("class", "blind at best", *shots, "above blind"), rows)


def _splits(run: StoredRun) -> dict[str, SplitSummary]:
    """Return the splits of a run's meta-test by name; without a meta-test return an empty dict."""
    evaluation = run.evaluation()
    if isinstance(evaluation, MetaTestEvaluation):
        return evaluation.splits
    return {}


def _budget(part: SplitSummary) -> tuple[int, int, int | None]:
    """Return the shots of a meta-test, its rollouts per shot, and the limit on a rollout's steps."""
    return part.shots, part.rollouts, part.max_adapt_steps


def _gain(part: SplitSummary, name: str) -> Estimate:
    """Return the meta-test's gain in return in the class ``name``; raise BidexError if it was not measured."""
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
