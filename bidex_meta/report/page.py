"""The page: what it shows, found in run folders, and how it is written.

Everything stands in the file, pictures and films too, so that it can be sent and read without a network. Needs the
extra ``plot``.
"""

import base64
import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

from bidex_meta.config import flat, printed
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.comparison import Group, estimates, iqm, iqm_difference, read_groups
from bidex_meta.evaluation.histories import History, read_histories
from bidex_meta.reading import is_file
from bidex_meta.record import plots, training_seconds
from bidex_meta.record.stored import Run

FILM_BYTES = 40_000_000
"""Films of a page together at most; what is above is named alone."""
_SPEED = {"Perf/steps_per_second": "environment steps / s", "Perf/training_time": "training time (s)"}


def render(folders: Sequence[Run]) -> str:
    """The page of some runs.

    Raises:
        BidexError: None of them has logged anything, or matplotlib or jinja2 is missing.
    """
    try:
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
    except ImportError:
        raise BidexError("Reports need jinja2 and matplotlib: pip install 'bidex-meta[plot]'.") from None
    histories = read_histories(folders)
    short = [f"{_letter(place)} {history.label.partition(',')[0]}" for place, history in enumerate(histories)]
    curves = [(name, history.curves) for name, history in zip(short, histories, strict=True)]
    names = _names(histories, short)
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    return environment.get_template("page.html").render(
        title=_title(folders),
        groups=[(name, history.label, len(history.folders)) for name, history in zip(short, histories, strict=True)],
        runs=[_run(folder, names[folder.path]) for folder in folders],
        final=_final(
            folders, {run.path: name for name, history in zip(short, histories, strict=True) for run in history.folders}
        ),
        learning=_picture(lambda: plots.draw_learning(curves)),
        speed=_picture(lambda: plots.draw_metrics(curves, _SPEED)),
        adaptation=list(_adaptation(folders, names)),
        differences=_differences(folders, names),
        configs=[(names[folder.path], printed(folder.config())) for folder in folders],
        films=list(_films(folders, names)),
    )


def _title(folders: Sequence[Run]) -> str:
    configs = [folder.config() for folder in folders]
    algos = ", ".join(dict.fromkeys(config.algo for config in configs))
    subjects = ", ".join(dict.fromkeys(Path(config.suite or config.task or "").stem for config in configs))
    return f"{algos} on {subjects}"


def _letter(place: int) -> str:
    """A, B, ..., Z, AA, ...: labels tell all that differs, which is too much for a legend."""
    return ("" if place < 26 else _letter(place // 26 - 1)) + chr(ord("A") + place % 26)


def _names(histories: Sequence[History], short: Sequence[str]) -> dict[Path, str]:
    """What each run is called on the page."""
    names: dict[Path, str] = {}
    for group, history in zip(short, histories, strict=True):
        for folder in history.folders:
            config = folder.config()
            of_task = f", {config.task}" if config.task else ""
            name = f"{group}{of_task}, seed {config.seed}"
            twice = sum(known.split(" (")[0] == name for known in names.values())
            names[folder.path] = f"{name} ({twice + 1})" if twice else name
    return names


def _run(folder: Run, name: str) -> dict[str, Any]:
    config, rows = folder.config(), folder.metrics()
    versions = folder.versions()
    speeds = [row["Perf/steps_per_second"] for row in rows if row.get("Perf/steps_per_second") is not None]
    hardware = ", ".join(versions.get("gpus") or []) or f"{versions.get('cpus', '?')} processors"
    git = versions.get("git") or {}
    return {
        "name": name,
        "path": str(folder.path),
        "on": config.suite or config.task or "",
        "steps": f"{max((row['step'] for row in rows), default=0):,}",
        "hours": f"{training_seconds(rows) / 3600.0:.2f}",
        "speed": f"{median(speeds):,.0f}" if speeds else "–",
        "rows": f"{config.num_envs:,}",
        "device": f"{config.device} ({hardware})",
        "commit": (git.get("commit") or "–")[:10] + ("+" if git.get("dirty") else ""),
    }


def _final(folders: Sequence[Run], short: dict[Path, str]) -> dict[str, Any]:
    """The groups' final evaluations as rows, and why runs are missing; groups are called as ``short`` says."""
    evaluated = [folder for folder in folders if folder.evaluated]
    found: dict[str, Any] = {"missing": len(folders) - len(evaluated), "reason": "", "rows": [], "classes": []}
    found |= {"names": [], "picture": None}
    try:
        groups = [replace(group, label=short[group.paths[0]]) for group in read_groups(evaluated)]
    except BidexError as error:
        return {**found, "reason": str(error)}
    if not groups:
        return found
    names = list(dict.fromkeys(name for group in groups for name in group.classes))
    return {
        **found,
        "rows": [_final_row(group, groups[0]) for group in groups],
        "names": names,
        "classes": [row for group in groups for row in _class_rows(group, names)],
        "picture": _picture(lambda: plots.draw_comparison(estimates(groups))) if len(groups) > 1 else None,
    }


def _final_row(group: Group, first: Group) -> list[str]:
    over = "–"
    if group is not first and set(group.classes) == set(first.classes):
        over = iqm_difference(group.success, first.success).text(100.0, form="+.1f")
    score = "–" if group.scores is None else iqm(group.scores).text()
    seeds = ", ".join(map(str, group.seeds))
    return [
        group.label,
        seeds,
        group.steps_text(),
        f"{group.hours:.2f}",
        iqm(group.success).text(100.0),
        score,
        over,
    ]


def _class_rows(group: Group, names: Sequence[str]) -> Iterator[list[str]]:
    for measure, values, factor in (("success (%)", group.success, 100.0), ("return", group.returns, 1.0)):
        means = {name: f"{factor * column.mean():.4g}" for name, column in zip(group.classes, values.T, strict=True)}
        yield [group.label, measure, *(means.get(name, "–") for name in names)]


def _adaptation(folders: Sequence[Run], names: dict[Path, str]) -> Iterator[tuple[str, str]]:
    """Name and picture of each run that ended with a meta-test."""
    for folder in filter(lambda folder: folder.evaluated, folders):
        with suppress(BidexError):  # of a damaged one the final table has told
            found = folder.evaluation()
            if found.get("splits"):
                picture = _picture(lambda found=found, path=folder.path: plots.draw_adaptation(found, path))
                if picture is not None:
                    yield names[folder.path], picture


def _differences(folders: Sequence[Run], names: dict[Path, str]) -> dict[str, Any]:
    """What of config and versions is not the same in all runs."""
    columns = []
    for folder in folders:
        versions = folder.versions()
        columns.append(folder.config().flat() | flat({"versions": versions}))
    keys = dict.fromkeys(key for column in columns for key in column)
    differing = [key for key in keys if len({json.dumps(column.get(key)) for column in columns}) > 1]
    cells = [[key, *(_cell(column.get(key)) for column in columns)] for key in differing]
    return {"names": [names[folder.path] for folder in folders], "rows": cells}


def _cell(value: Any) -> str:
    return "–" if value is None else value if isinstance(value, str) else json.dumps(value)


def _films(folders: Sequence[Run], names: dict[Path, str]) -> Iterator[tuple[str, str, str | None]]:
    """Run, file and content of the newest film of each kind (its name before ``_<step>``); None where it is large."""
    room = FILM_BYTES
    for folder in folders:
        newest: dict[str, Path] = {}
        films = filter(is_file, folder.videos_path.glob("*.mp4"))  # a pipe of that name would never end
        for path in sorted(films, key=lambda path: path.stat().st_mtime):
            kind, _, step = path.stem.rpartition("_")
            newest[kind if step.isdigit() and kind else path.stem] = path
        for path in newest.values():
            fits = path.stat().st_size <= room
            room -= path.stat().st_size if fits else 0
            yield names[folder.path], path.name, _data(path.read_bytes(), "video/mp4") if fits else None


def _picture(draw: Any) -> str | None:
    """A figure as the address of an image; None where there is nothing to draw."""
    told = plots.missing()
    if told is not None:
        raise BidexError(told)
    try:
        return _data(plots.svg(draw()), "image/svg+xml")
    except BidexError:
        return None


def _data(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
