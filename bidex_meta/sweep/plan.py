"""A sweep's file as the runs it asks for, each as the words of ``bidex-meta run``. docs/sweeps.md explains the file."""

import itertools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bidex_meta.config import RunConfig, flat
from bidex_meta.errors import BidexError, shortened, unknown_name
from bidex_meta.runs.folder import RunFolder
from bidex_meta.utils.files import TABLE, TEXT, Rule, absolute, check, expanded, read_toml, whole
from bidex_meta.utils.plugins import short_name

_OWN = ("suite", "task", "algo", "seed", "run_dir", "resume", "print_config", "evaluate", "threads", "learner")
"""Flags of a run that no override sets: other entries of the file do, or the sweep."""
_MOST_RUNS = 10_000
_IN_NAMES = r"\w.+ -"
"""Characters of a run folder's name, before blanks become hyphens."""


def _list_of(rule: Rule) -> Rule:
    return Rule(f"a list, each {rule.told}", lambda x: isinstance(x, list) and len(x) > 0 and all(map(rule.fits, x)))


_NAMED = Rule(
    "letters, digits, blanks and . + - _ (60 at most)",
    lambda value: isinstance(value, str) and bool(re.fullmatch(f"[{_IN_NAMES}]{{1,60}}", value)),
)
_BOTH = {"name": _NAMED, "suites": _list_of(TEXT), "tasks": _list_of(TEXT), "seeds": _list_of(whole(0))}
_ARM = {**_BOTH, "overrides": TABLE, "algo": TEXT, "start_from": TEXT}
_FILE = {**_BOTH, "overrides": TABLE, "algos": _list_of(TEXT), "grid": TABLE, "arms": _list_of(TABLE), "slurm": TABLE}


@dataclass(frozen=True)
class PlannedRun:
    """A run that a sweep's file asks for.

    Args:
        path: Its folder, which need not be there yet.
        arm: What tables call it and its like on other seeds.
        subject: The suite or class, as the file names it.
        seed: Its seed.
        words: Flags of ``bidex-meta run``, without seed and folder.
        after: The folder of the run whose policy it starts from.
        config: What the words resolve to; added by the command, which checks them.
    """

    path: Path
    arm: str
    subject: str
    seed: int
    words: tuple[str, ...]
    after: Path | None = None
    config: RunConfig[Any] = field(default=None, compare=False)  # pyright: ignore

    @property
    def name(self) -> str:
        """Its folder's name."""
        return self.path.name

    @property
    def folder(self) -> RunFolder:
        """Its folder."""
        return RunFolder(self.path)

    @property
    def begin(self) -> list[str]:
        """The words that begin it."""
        start = [] if self.after is None else [f"--start-from={self.after}"]
        return ["run", *self.words, *start, f"--seed={self.seed}", "--threads=1", f"--run-dir={self.path}"]


@dataclass(frozen=True)
class Sweep:
    """What a file asks for: its runs in order (all arms of the first seed, then of the second), and their folder."""

    out: Path
    runs: list[PlannedRun]
    slurm: dict[str, Any]  # parameters of submitit's executor


def read_sweep(path: Path, root: Path = Path("runs")) -> Sweep:
    """A sweep's file; ``root`` is where the sweep's folder lies.

    Raises:
        BidexError: The file cannot be read or is wrong, or two of its runs have one name. What ``bidex-meta run``
            would refuse is not checked here.
    """
    content = read_toml(path, "a sweep")
    _check(content, _FILE, path, ("name", "seeds"))
    out = expanded(root) / content["name"].replace(" ", "-")
    runs: dict[str, PlannedRun] = {}
    for run in _runs(path, content, out):
        if run.name in runs:
            raise BidexError(f"{path}: two runs are called {run.name}. Name arms apart, each seed and value once.")
        if len(runs) == _MOST_RUNS:
            raise BidexError(f"{path}: expected at most {_MOST_RUNS:,} runs, got more. Make several sweeps of it.")
        runs[run.name] = run
    return Sweep(out, list(runs.values()), content.get("slurm", {}))


def _runs(path: Path, content: Mapping[str, Any], out: Path) -> Iterator[PlannedRun]:
    arms = [{"name": short_name(algo), "algo": algo} for algo in content.get("algos", [])] + content.get("arms", [])
    if not arms:
        raise BidexError(f'{path}: expected algos = ["mtppo"] or [[arms]], found neither.')
    for place, arm in enumerate(arms):
        _check(arm, _ARM, path, ("name", "algo"), f"arms[{place}].")
        if not set(arm.get("seeds", [])) <= set(content["seeds"]):
            raise BidexError(f"{path}: arms[{place}].seeds: expected seeds of the file's, got {arm['seeds']}.")
    for seed in content["seeds"]:
        above: list[tuple[str, str, PlannedRun]] = []
        for arm in arms:
            subjects = arm if arm.keys() & {"suites", "tasks"} else content
            named = [(kind, each) for kind in ("suite", "task") for each in subjects.get(f"{kind}s", [])]
            if not named:
                raise BidexError(f"{path}: expected suites or tasks, for all or for {arm['name']!r}, found neither.")
            if seed not in arm.get("seeds", content["seeds"]):
                continue
            for (values, flags), (kind, subject) in ((c, n) for c in _combinations(content, arm) for n in named):
                given = absolute(path.parent / expanded(subject)) if subject.endswith(".toml") else subject
                called, label = Path(short_name(subject)).stem, arm["name"] + values
                words = (f"--{kind}={given}", f"--algo={arm['algo']}", *(w.replace("{subject}", called) for w in flags))
                folder, after = out / f"{called}-{label}-seed{seed}".replace(" ", "-"), None
                if "start_from" in arm:
                    same = [(v, run) for name, v, run in above if (name, run.subject) == (arm["start_from"], subject)]
                    found = [run for v, run in same if v == values] or [run for _, run in same]
                    if len(found) != 1:
                        raise BidexError(
                            f"{path}: {folder.name} is to start from the arm {arm['start_from']!r}, of which there are "
                            f"{len(found)} runs on {subject} above it. Give both the same suites, tasks and grid."
                        )
                    after = found[0].path
                run = PlannedRun(folder, label, subject, seed, words, after)
                above.append((arm["name"], values, run))
                yield run


def _combinations(content: Mapping[str, Any], arm: Mapping[str, Any]) -> Iterator[tuple[str, list[str]]]:
    """Every combination of the grid for an arm, without what the arm sets itself: for the name, and as all flags."""
    shared, own = flat(content.get("overrides", {})), flat(arm.get("overrides", {}))
    fixed = {flag.replace("-", "_") for flag in own}
    grid = {flag: each for flag, each in flat(content.get("grid", {})).items() if flag.replace("-", "_") not in fixed}
    for values in itertools.product(*grid.values()):
        chosen = dict(zip(grid, values, strict=True))
        label = "".join(f" {flag.rpartition('.')[2]}={_named(value)}" for flag, value in chosen.items())
        yield label, [word for flag, value in {**shared, **chosen, **own}.items() for word in _words(flag, value)]


def _check(
    content: Mapping[str, Any], rules: Mapping[str, Rule], path: Path, needed: tuple[str, ...], place: str = ""
) -> None:
    for name in content:
        if name not in rules:
            raise BidexError(f"{path}: {place}{name}: {unknown_name('entry', name, rules)}")
    check(content, rules, path, needed, place)
    for table in ("overrides", "grid"):
        for flag, value in flat(content.get(table, {})).items():
            if flag.replace("-", "_") in _OWN:
                raise BidexError(f"{path}: {place}{table}.{flag}: the file's other entries or the sweep decide that.")
            if table == "grid" and not (isinstance(value, list) and value):
                raise BidexError(f"{path}: grid.{flag}: expected a list of values to try, got {shortened(value)}.")


def _words(flag: str, value: Any) -> list[str]:
    """A value as words of the command line."""
    flag = flag.replace("_", "-")
    if isinstance(value, bool):
        before, dot, last = flag.rpartition(".")
        return [f"--{flag}" if value else f"--{before}{dot}no-{last}"]
    if isinstance(value, list) and flag not in ("dataset", "demonstrations"):
        return [f"--{flag}", *map(_text, value)]
    # Of these two each value is given with the flag's name.
    return [f"--{flag}={_text(each)}" for each in (value if isinstance(value, list) else [value])]


def _text(value: Any) -> str:
    return "x".join(map(_text, value)) if isinstance(value, list) else str(value)


def _named(value: Any) -> str:
    """A value as a part of a folder's name: data sets and paths have slashes."""
    return re.sub(rf"[^{_IN_NAMES}]+", "-", _text(value).strip("/"))
