"""Report of runs as one HTML page, which contains all pictures and films and so needs no network."""

import base64
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path
from statistics import median
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from bidex_meta.config import RunConfig, flat
from bidex_meta.errors import BidexError
from bidex_meta.evaluation.comparison import History, estimates, read_groups, read_histories
from bidex_meta.evaluation.statistics import NONE
from bidex_meta.experiments.comparing import class_table, group_table, setting_lines
from bidex_meta.experiments.plotting import is_offline, steps_of
from bidex_meta.runs import plots, training_seconds
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.evaluations import MetaTestEvaluation
from bidex_meta.runs.stored import Run
from bidex_meta.runs.video import FILMS
from bidex_meta.utils.files import is_file, portable

FILM_BYTES = 40_000_000  # maximum number of bytes of all films of a page; further films are only named


def render(runs: Sequence[Run]) -> str:
    """Render the page of some runs; raise BidexError if no run has logged anything."""
    histories = read_histories(runs)
    short = [f"{_letter(place)} {history.label.partition(',')[0]}" for place, history in enumerate(histories)]
    named = list(zip(short, histories, strict=True))
    curves = [(name, history.curves) for name, history in named]
    names = _names(named)
    configs = [run.config() for run in runs]
    steps = steps_of(runs)
    speed = {"Perf/steps_per_second": f"{steps} / s", "Perf/training_time": "training time (s)"}
    algos = ", ".join(dict.fromkeys(config.algo for config in configs))
    subjects = ", ".join(dict.fromkeys(Path(config.suite or config.task or "").stem for config in configs))
    short_names = {}
    for name, history in named:
        short_names |= {run.path: name for run in history.runs}
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    return environment.get_template("report.html").render(
        title=f"{algos} on {subjects}",
        groups=[(name, history.label, len(history.runs)) for name, history in named],
        runs=[_run(run, names[run.path]) for run in runs],
        final=_final(runs, short_names),
        learning=_picture(lambda: plots.draw_learning(curves, steps)),
        speed=_picture(lambda: plots.draw_metrics(curves, speed, steps)),
        adaptation=list(_adaptation(runs, names)),
        differences=_differences(runs, names),
        configs=[(names[run.path], _json(config)) for run, config in zip(runs, configs, strict=True)],
        films=list(_films(runs, names)),
    )


def _json(config: RunConfig) -> str:
    return json.dumps(portable(config.to_json()), indent=2)


def _letter(place: int) -> str:
    """Return the letters A, B, ..., Z, AA, ... for the places 0, 1, ... of groups.

    A legend needs such short names, because labels list every difference.
    """
    return ("" if place < 26 else _letter(place // 26 - 1)) + chr(ord("A") + place % 26)


def _names(histories: Sequence[tuple[str, History]]) -> dict[Path, str]:
    """Return the name of each run on the page."""
    names: dict[Path, str] = {}
    for group, history in histories:
        for run in history.runs:
            config = run.config()
            names[run.path] = f"{group}{f', {config.task}' if config.task else ''}, seed {config.seed}"
    return names


def _run(run: Run, name: str) -> Json:
    config = run.config()
    rows = run.metrics()
    versions = run.versions()
    speeds = [row["Perf/steps_per_second"] for row in rows if row.get("Perf/steps_per_second") is not None]
    hardware = ", ".join(versions.get("gpus") or []) or f"{versions.get('cpus', '?')} processors"
    git = versions.get("git") or {}
    unit = " updates" if is_offline(run) else ""
    speed = f"{median(speeds):,.0f}{unit}" if speeds else NONE
    dirty = "+" if git.get("dirty") else ""
    return {
        "name": name, "path": portable(str(run.path)), "on": portable(config.suite or config.task),
        "steps": f"{max((row['step'] for row in rows), default=0):,}{unit}",
        "hours": f"{training_seconds(rows) / 3600.0:.2f}",
        "speed": speed,
        "environments": f"{config.num_envs:,}",
        "device": f"{config.device} ({hardware})",
        "commit": (git.get("commit") or NONE)[:10] + dirty,
    }  # fmt: skip


def _final(runs: Sequence[Run], short: dict[Path, str]) -> Json:
    """Return the final evaluations for the page: tables, a picture, and the number of runs that have none.

    If the evaluations cannot be compared, the result has no tables but the reason. ``short`` maps the path of each run
    to the short name of its group.
    """
    evaluated = [run for run in runs if run.evaluated]
    found: Json = {"missing": len(runs) - len(evaluated), "reason": "", "picture": None, "tables": [], "settings": []}
    try:
        groups = [replace(group, label=short[group.paths[0]]) for group in read_groups(evaluated)]
        found["settings"] = setting_lines(groups)
    except BidexError as error:
        reason = str(error)
        for run in runs:
            reason = reason.replace(str(run.path), portable(str(run.path)))
        return {**found, "reason": reason}
    if not groups:
        return found
    if len(groups) > 1:
        picture = _picture(lambda: plots.draw_comparison(estimates(groups)))
    else:
        picture = None
    return {**found, "tables": [group_table(groups), class_table(groups)], "picture": picture}


def _adaptation(runs: Sequence[Run], names: dict[Path, str]) -> Iterator[tuple[str, str]]:
    """Yield, for each run that ended with a meta-test, the run's name and a picture of its adaptation.

    The picture is a data URL.
    """
    for run in filter(lambda run: run.evaluated, runs):
        with suppress(BidexError):  # the final table reports the error
            found = run.evaluation()
            if isinstance(found, MetaTestEvaluation):
                goal = run.goal
                picture = _picture(lambda found=found, goal=goal: plots.draw_adaptation(found, "", goal))
                if picture is not None:
                    yield names[run.path], picture


def _differences(runs: Sequence[Run], names: dict[Path, str]) -> Json:
    """Return the entries of config and versions that are not the same in all runs."""
    columns = [flat(portable(run.config().to_json())) | flat({"versions": run.versions()}) for run in runs]
    keys = dict.fromkeys(chain.from_iterable(columns))
    differing = [key for key in keys if len({json.dumps(column.get(key)) for column in columns}) > 1]
    cells = [[key, *map(_cell, (column.get(key) for column in columns))] for key in differing]
    return {"names": [names[run.path] for run in runs], "rows": cells}


def _cell(value: object) -> str:
    if value is None:
        return NONE
    if isinstance(value, str):
        return value
    return json.dumps(value)


def _films(runs: Sequence[Run], names: dict[Path, str]) -> Iterator[tuple[str, str, str | None]]:
    """Yield, for the newest film of each kind in each run, the run's name, the file's name and the content.

    Films are of one kind if their file names before ``_<step>`` are equal. The content is a data URL of a video (of an
    image for WebP), or None if the film is too large for the page.
    """
    room = FILM_BYTES
    for run in runs:
        newest: dict[str, Path] = {}
        named = (path for path in run.videos_path.glob("*") if path.suffix.lower() in FILMS)
        films = filter(is_file, named)  # reading a pipe with such a name would never end
        for path in sorted(films, key=_film_step):
            kind, _, step = path.stem.rpartition("_")
            newest[kind if step.isdigit() and kind else path.stem] = path
        for path in newest.values():
            fits = path.stat().st_size <= room
            room -= path.stat().st_size if fits else 0
            yield names[run.path], path.name, _data(path.read_bytes(), FILMS[path.suffix.lower()]) if fits else None


def _film_step(path: Path) -> tuple[int, str]:
    """Return the number at the end of a film's name, which is the step of a training film, and the name."""
    step = path.stem.rpartition("_")[2]
    return int(step) if step.isdecimal() else -1, path.name


def _picture(draw: Callable[[], Any]) -> str | None:
    """Return a figure as the data URL of an image; None if there is nothing to draw."""
    try:
        return _data(plots.svg(draw()), "image/svg+xml")
    except BidexError:
        return None


def _data(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
