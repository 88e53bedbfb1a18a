"""Tables of groups of runs that differ only in the seed."""

from collections.abc import Sequence
from itertools import chain

import numpy as np

from bidex_meta.evaluation.comparison import Group, score_over, success_over
from bidex_meta.evaluation.statistics import NONE, iqm_over_seeds
from bidex_meta.runs.atomic import Json


def group_row(group: Group, first: Group) -> Json:
    """Return the results of a group of runs that differ only in the seed, ready for JSON.

    Success and score are also compared with those of the group ``first``.
    """
    row: Json = {
        "group": group.label, "seeds": group.seeds, "steps": group.steps, "steps_range": list(group.steps_range),
        "hours": round(group.hours, 3), "settings": group.settings,
    }  # fmt: skip
    measures = ("success", group.success, success_over(group, first)), ("score", group.scores, score_over(group, first))
    for name, own, over in measures:
        row[f"{name}_iqm"] = None if own is None else vars(iqm_over_seeds(own))
        row[f"{name}_over_first"] = None if over is None else vars(over)
    row["classes"] = {}
    for i, name in enumerate(group.classes):
        row["classes"][name] = {"success": group.success[:, i].tolist(), "return": group.returns[:, i].tolist()}
    return row


def group_table(groups: Sequence[Group]) -> tuple[list[str], list[list[str]]]:
    """Return columns and rows of a table with one row per group of runs, each compared with the first group."""
    columns = ["group", "seeds", "steps", "hours", "success, IQM (%)", "score, IQM"]
    rows = []
    for group in groups:
        if group.scores is None:
            score = None
        else:
            score = iqm_over_seeds(group.scores)
        measures = (iqm_over_seeds(group.success), 100.0, ".1f"), (score, 1.0, ".1f")
        over = (success_over(group, groups[0]), 100.0, "+.1f"), (score_over(group, groups[0]), 1.0, "+.1f")
        cells = [NONE if each is None else each.text(factor, form=form) for each, factor, form in (*measures, *over)]
        seeds = f"{len(group.seeds)} ({', '.join(map(str, group.seeds))})"
        rows.append([group.label, seeds, group.steps_text(), f"{group.hours:.2f}", *cells])
    return [*columns, "success over the first", "score over the first"], rows


def setting_lines(groups: Sequence[Group]) -> list[str]:
    """Return a line for each group whose evaluations have another split than ``train``, or were randomised."""
    return [f"Evaluation of {each.label}: {', '.join(each.settings)}." for each in groups if each.settings]


def class_table(groups: Sequence[Group]) -> tuple[list[str], list[list[str]]]:
    """Return the columns and rows of a table that has one row for each class and group of runs.

    A row gives success and return: the mean over the group's seeds, and the lowest and highest value of a seed.
    """
    rows = []
    for name in dict.fromkeys(chain.from_iterable(group.classes for group in groups)):
        for group in groups:
            if name not in group.classes:
                continue
            place = list(group.classes).index(name)
            success = 100.0 * group.success[:, place]
            returns = group.returns[:, place]
            rows.append([name, group.label, _spread(success, ".1f"), _spread(returns, ".4g")])
    return ["class", "group", "success, mean (%) [seeds]", "return, mean [seeds]"], rows


def _spread(values: np.ndarray, form: str) -> str:
    """Format the mean, the minimum and the maximum of the values as one text."""
    return f"{values.mean():{form}} [{values.min():{form}} to {values.max():{form}}]"
