"""Tables of studies in Markdown: arms, classes, the best runs, references."""

from collections.abc import Iterator, Sequence
from itertools import chain, product

import numpy as np

from bidex_meta.evaluation.comparison import Group, scored_classes
from bidex_meta.evaluation.references import Kind, load
from bidex_meta.evaluation.statistics import Estimate, iqm_over_seeds
from bidex_meta.rules import versioned_name
from bidex_meta.runs.evaluations import ClassSummary
from bidex_meta.runs.stored import StoredRun
from bidex_meta.tasks import registry
from bidex_meta.worlds import open_worlds
from tools.pages.studies import Study, classes_of_others, classes_of_random, shows_means

_FEW = 4
"""The table of arms shows returns per class for at most this many classes."""
_MANY = 10
"""If there are more classes than this, the table of classes has a row instead of a column per class."""
_PLAYED: dict[Kind, str] = {
    "random": "uniform actions",
    "zero": "zero actions",
    "witness": "open-loop replay",
    "script": "scripted policy",
}
_BEST = (
    "success [95 %]",
    "other tasks",
    "return [95 %]",
    "score",
    "uniform actions: return",
    "open-loop replay: success",
    "scripted policy: success",
)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield the Markdown lines of a table."""
    yield _row(head)
    yield "|" + "---|" * len(head)
    yield from map(_row, rows)


def mean_and_range(values: np.ndarray, form: str = ".4g", unit: str = "") -> str:
    """Format values (seeds,) as their mean, followed by ``(minimum to maximum)`` if there are several seeds."""
    form = f"z{form}"  # a small negative value is 0, not -0
    ends = f" ({values.min():{form}} to {values.max():{form}})" if len(values) > 1 else ""
    return f"{values.mean():{form}}{unit}{ends}"


def random_rows(study: Study) -> dict[str, list[ClassSummary]]:
    """Collect the results of uniform actions by class, from each evaluation that has such results."""
    found: dict[str, list[ClassSummary]] = {}
    for run in study.runs:
        for name, row in classes_of_random(run).items():
            found.setdefault(name, []).append(row)
    return found


def arms_table(study: Study) -> Iterator[str]:
    """Yield a table with a row per arm, and a row for uniform actions.

    Success is the interquartile mean. If an arm was also evaluated on other tasks, all success rates are means instead.
    """
    classes = study.classes if len(study.classes) <= _FEW else []
    means_only = shows_means(study.arms)
    measures = ["success, mean", "other tasks, mean"] if means_only else ["success, IQM", "score, IQM"]
    head = ["arm", "seeds", "steps", *measures, *classes, "parameters", "hours"]
    rows = []
    for arm in study.arms:
        group = arm.group
        means = dict(zip(group.classes, group.returns.mean(axis=0), strict=True))
        measured = [_over_seeds(group.success), _over_seeds(arm.others)]
        if not means_only:
            score = "–" if group.scores is None else iqm_over_seeds(group.scores).text()
            measured = [arm.success.text(100.0, " %"), score]
        returns = [f"{means[name]:.4g}" if name in means else "–" for name in classes]
        parameters = "–" if arm.parameters is None else f"{arm.parameters:,}"
        start = [group.label, str(len(group.seeds)), group.steps_text()]
        rows.append([*start, *measured, *returns, parameters, f"{group.hours:.2f}"])
    random = random_rows(study)
    if random.keys() == set(study.classes):
        success = np.array([[np.mean([row.success for row in random[name]]) for name in study.classes]])
        returns = [f"{np.mean([row.mean_return for row in random[name]]):.4g}" for name in classes]
        value = success.mean() if means_only else iqm_over_seeds(success).value
        rows.append(["uniform actions", "", "", f"{100 * value:.1f} %", "–", *returns, "", ""])
    return table(head, rows)


def _over_seeds(success: np.ndarray | None) -> str:
    """Format success (seeds, classes) as the mean over seeds and classes, and the range over seeds."""
    return "–" if success is None else mean_and_range(100.0 * success.mean(axis=1), ".1f", " %")


def classes_table(study: Study) -> Iterator[str]:
    """Yield a table of success and return per class.

    A cell shows the mean over seeds, followed in brackets by the lowest and the highest value of a seed. The classes
    are the table's columns, or its rows if there are more than ``_MANY`` classes.
    """
    if len(study.classes) > _MANY:
        return _classes_as_rows(study)

    def cells(group: Group, values: np.ndarray, unit: str = "") -> list[str]:
        by_class = dict(zip(group.classes, values.T, strict=True))
        return [mean_and_range(by_class[n], unit=unit) if n in by_class else "–" for n in study.classes]

    rows = []
    for group in (arm.group for arm in study.arms):
        rows.append([group.label, "success", *cells(group, 100.0 * group.success, " %")])
        rows.append([group.label, "return", *cells(group, group.returns)])
    return table(["arm", "", *study.classes], rows)


def _classes_as_rows(study: Study) -> Iterator[str]:
    """Yield a table with a row per class and a row for the mean.

    Each arm has columns for success on the tasks that it was trained on, success on other tasks, return and score.
    """
    columns: dict[str, list[str]] = {"class": [*study.classes, "mean"]}
    for arm in study.arms:
        group = arm.group
        before = f"{group.label}: " if len(study.arms) > 1 else ""
        measured = {"success": (group.success, 100.0, ".1f", " %"), "other tasks": (arm.others, 100.0, ".1f", " %")}
        measured |= {"return": (group.returns, 1.0, ".4g", ""), "score": (group.scores, 1.0, ".0f", "")}
        for title, (values, factor, form, unit) in measured.items():
            if values is None:
                continue
            by_class = dict(zip(group.classes, factor * values.T, strict=True))
            cells = [mean_and_range(by_class[name], form, unit) if name in by_class else "–" for name in study.classes]
            mean = "" if title == "return" else mean_and_range(factor * values.mean(axis=1), form, unit)
            columns[before + title] = [*cells, mean]
    return table([*columns], [*zip(*columns.values(), strict=True)])


def best_table(studies: Sequence[Study]) -> Iterator[str]:
    """Yield a table with a row per class, in MT20's order, for the run with the highest success in the class.

    Ties are broken by return. If there is only one run, the rows do not name it. Columns without any number are left
    out.
    """
    found: dict[str, list[tuple[StoredRun, ClassSummary]]] = {}
    for run in chain.from_iterable(study.runs for study in studies):
        for name, row in scored_classes(run).items():
            found.setdefault(name, []).append((run, row))
    several = sum(len(study.runs) for study in studies) > 1
    order = registry.names()
    references = [load("witness"), load("script")]
    experts = {name: row["return"] for name, row in load("expert").items()}  # an expert has no score relative to itself
    rows = []
    for name in sorted(found, key=lambda name: order.index(name) if name in order else len(order)):
        run, best = max(found[name], key=lambda pair: (pair[1].success, pair[1].mean_return))
        random = classes_of_random(run).get(name)
        others = classes_of_others(run).get(name)
        cells = [_success(best), "–" if others is None else _success(others)]
        cells.append(Estimate(best.mean_return, best.return_interval).text(form=".4g"))
        cells.append("–" if best.score is None or best.mean_return == experts.get(name) else f"{best.score:.0f}")
        cells.append("–" if random is None else f"{random.mean_return:.4g}")
        rules = open_worlds(run.config().to_json()).rules
        stored = versioned_name(name, rules) if rules else name
        for known in references:
            cells.append(f"{100 * known[stored]['success']:.4g} %" if stored in known else "–")
        if several:
            content = run.content
            which = [run.arm, str(run.config().seed), f"{content['steps']:,}", f"{content['seconds'] / 3600:.2f}"]
            cells = [*which, *cells, str(len(found[name]))]
        rows.append([name, *cells])
    head = ["class", "arm", "seed", "steps", "hours", *_BEST, "runs"] if several else ["class", *_BEST]
    kept = [i for i in range(len(head)) if any(row[i] != "–" for row in rows)]
    return table([head[i] for i in kept], [[row[i] for i in kept] for row in rows])


def _success(row: ClassSummary) -> str:
    return Estimate(row.success, row.success_interval).text(100.0, " %", ".4g")


def references_table(version: str) -> Iterator[str]:
    """Yield a table with a row per class of a version (``v2``, else 1): untrained policies and known solutions.

    Version 1 has returns, success, and the return and source of the expert. Version 2 has scores and success.
    """
    if version == "v2":
        return _references_of_version_2()
    played = [load(kind) for kind in _PLAYED]
    expert = load("expert")
    measures = [f"{who}: {what}" for who, what in product(_PLAYED.values(), ("return", "success"))]
    rows = []
    for name in registry.names():
        cells = [name]
        for known in played:
            row = known.get(name)
            cells += ["–", "–"] if row is None else [f"{row['return']:.4g}", f"{100 * row['success']:.1f} %"]
        best = expert.get(name)
        cells += ["–", "–"] if best is None else [f"{best['return']:.4g}", best["source"]]
        rows.append(cells)
    return table(["class", *measures, "expert: return", "expert"], rows)


def _references_of_version_2() -> Iterator[str]:
    kinds: tuple[Kind, ...] = ("random", "zero", "script")
    measures = [f"{_PLAYED[kind]}: {what}" for kind, what in product(kinds, ("score", "success"))]
    rows = []
    for name in registry.names():
        cells = [name]
        steps = registry.get(f"{name}-v2").episode_steps
        for kind in kinds:
            row = load(kind).get(f"{name}-v2")
            if row is None:
                cells += ["–", "–"]
            else:
                cells += [f"{100 * row['return'] / steps:.3g}", f"{100 * row['success']:.1f} %"]
        rows.append(cells)
    return table(["class", *measures], rows)


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"
