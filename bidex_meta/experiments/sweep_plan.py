"""A sweep's file as the runs it asks for, each as the words of ``bidex-meta run``. docs/sweeps.md explains the file."""

import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, NamedTuple

from msgspec import Meta

from bidex_meta.config import RunConfig, flat
from bidex_meta.errors import BidexError, shortened
from bidex_meta.runs.atomic import Json
from bidex_meta.runs.folder import RunFolder
from bidex_meta.utils.files import absolute, expanded, read_toml
from bidex_meta.utils.plugins import short_name
from bidex_meta.utils.validation import Seed, Text, check_fields, parse

_OWN = ("suite", "task", "algo", "seed", "run_dir", "resume", "print_config", "evaluate", "threads", "learner")
"""Flags of a run that no override sets: other entries of the file do, or the sweep."""
_MOST_RUNS = 10_000
_IN_NAMES = r"\w.+ -"  # characters of a run folder's name, before blanks become hyphens

_Name = Annotated[str, Meta(pattern=rf"^[{_IN_NAMES}]{{1,60}}\Z")]
_Texts = Annotated[tuple[Text, ...], Meta(min_length=1)]
_Seeds = Annotated[tuple[Seed, ...], Meta(min_length=1)]


@dataclass(frozen=True, kw_only=True)
class _Shared:
    name: _Name
    suites: _Texts | None = None
    tasks: _Texts | None = None
    overrides: Json = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class _Arm(_Shared):
    algo: Text
    seeds: _Seeds | None = None
    start_from: Text | None = None


@dataclass(frozen=True, kw_only=True)
class _File(_Shared):
    seeds: _Seeds
    algos: _Texts = ()
    grid: Json = field(default_factory=dict)
    arms: tuple[_Arm, ...] = ()
    slurm: Json = field(default_factory=dict)


@dataclass(frozen=True)
class PlannedRun:
    """A run that a sweep's file asks for."""

    path: Path  # its folder, which need not be there yet
    arm: str  # what tables call it and its like on other seeds
    subject: str  # the suite or class, as the file names it
    seed: int
    words: tuple[str, ...]  # flags of ``bidex-meta run``, without seed and folder
    after: Path | None = None  # the folder of the run whose policy it starts from
    config: RunConfig = field(default=None, compare=False)  # pyright: ignore  # of the words; the command adds it

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
        if self.after is None:
            start = []
        else:
            start = [f"--start-from={self.after}"]
        return ["run", *self.words, *start, f"--seed={self.seed}", "--threads=1", f"--run-dir={self.path}"]


class Sweep(NamedTuple):
    """What a file asks for: its runs in order (all arms of the first seed, then of the second), and their folder."""

    out: Path
    runs: list[PlannedRun]
    slurm: Json  # parameters of submitit's executor


def read_sweep(path: Path, root: Path = Path("runs")) -> Sweep:
    """A sweep's file; ``root`` is where the sweep's folder lies.

    Raises BidexError where the file is wrong, or two of its runs have one name; what ``bidex-meta run`` would refuse is
    not checked here.
    """
    file = parse(read_toml(path, "a sweep"), _File, str(path), exact=True)
    arms = [*(_Arm(name=short_name(algo), algo=algo) for algo in file.algos), *file.arms]
    if not arms:
        raise BidexError(f'{path}: expected algos = ["mtppo"] or [[arms]], found neither.')
    _check_flags(path, "overrides", file.overrides)
    _check_flags(path, "grid", file.grid)
    for flag, value in flat(file.grid).items():
        if not (isinstance(value, list) and value):
            raise BidexError(f"{path}: grid.{flag}: expected a list of values to try, got {shortened(value)}.")
    for arm in arms:
        check_fields(arm, f"{path}: arm {arm.name}")
        _check_flags(path, f"arm {arm.name}: overrides", arm.overrides)
        if not set(arm.seeds or ()) <= set(file.seeds):
            raise BidexError(
                f"{path}: arm {arm.name}: seeds: expected seeds of the file's, got {list(arm.seeds or ())}."
            )
        if not (arm.suites or arm.tasks or file.suites or file.tasks):
            raise BidexError(f"{path}: expected suites or tasks, for all or for {arm.name!r}, found neither.")
    out = expanded(root) / file.name.replace(" ", "-")
    runs: dict[str, PlannedRun] = {}
    for run in _runs(path, file, arms, out):
        if run.name in runs:
            raise BidexError(f"{path}: two runs are called {run.name}. Name arms apart, each seed and value once.")
        if len(runs) == _MOST_RUNS:
            raise BidexError(f"{path}: expected at most {_MOST_RUNS:,} runs, got more. Make several sweeps of it.")
        runs[run.name] = run
    return Sweep(out, list(runs.values()), file.slurm)


def _check_flags(path: Path, place: str, flags: Json) -> None:
    for flag in flat(flags):
        if flag.replace("-", "_") in _OWN:
            raise BidexError(f"{path}: {place}.{flag}: the file's other entries or the sweep decide that.")


def _runs(path: Path, file: _File, arms: Sequence[_Arm], out: Path) -> Iterator[PlannedRun]:
    for seed in file.seeds:
        above: list[tuple[str, str, PlannedRun]] = []
        for arm in (arm for arm in arms if seed in (arm.seeds or file.seeds)):
            on = arm if arm.suites or arm.tasks else file
            subjects = [("suite", suite) for suite in on.suites or ()] + [("task", task) for task in on.tasks or ()]
            for (values, flags), (kind, subject) in itertools.product(_combinations(file, arm), subjects):
                if subject.endswith(".toml"):
                    given = absolute(path.parent / expanded(subject))
                else:
                    given = subject
                called = Path(short_name(subject)).stem
                label = arm.name + values
                words = (f"--{kind}={given}", f"--algo={arm.algo}", *(w.replace("{subject}", called) for w in flags))
                folder = out / f"{called}-{label}-seed{seed}".replace(" ", "-")
                after = None
                if arm.start_from is not None:
                    same = [(v, run) for name, v, run in above if (name, run.subject) == (arm.start_from, subject)]
                    found = [run for v, run in same if v == values] or [run for _, run in same]
                    if len(found) != 1:
                        raise BidexError(
                            f"{path}: {folder.name} is to start from the arm {arm.start_from!r}, of which there are "
                            f"{len(found)} runs on {subject} above it. Give both the same suites, tasks and grid."
                        )
                    after = found[0].path
                run = PlannedRun(folder, label, subject, seed, words, after)
                above.append((arm.name, values, run))
                yield run


def _combinations(file: _File, arm: _Arm) -> Iterator[tuple[str, list[str]]]:
    """Every combination of the grid for an arm, without what the arm sets itself: for the name, and as all flags."""
    shared = flat(file.overrides)
    own = flat(arm.overrides)
    fixed = {flag.replace("-", "_") for flag in own}
    grid = {flag: values for flag, values in flat(file.grid).items() if flag.replace("-", "_") not in fixed}
    for values in itertools.product(*grid.values()):
        chosen = dict(zip(grid, values, strict=True))
        label = "".join(f" {flag.rpartition('.')[2]}={_named(value)}" for flag, value in chosen.items())
        yield label, [word for flag, value in {**shared, **chosen, **own}.items() for word in words_of(flag, value)]


def words_of(flag: str, value: object) -> list[str]:
    """A flag of ``bidex-meta run`` with its value, as words of the command line."""
    flag = flag.replace("_", "-")
    if isinstance(value, bool):
        before, dot, last = flag.rpartition(".")
        return [f"--{flag}" if value else f"--{before}{dot}no-{last}"]
    if isinstance(value, list) and flag not in ("dataset", "demonstrations", "teacher"):
        return [f"--{flag}", *map(_text, value)]
    # Of these each value is given with the flag's name.
    return [f"--{flag}={_text(each)}" for each in (value if isinstance(value, list) else [value])]


def _text(value: object) -> str:
    if isinstance(value, list):
        return "x".join(map(_text, value))
    return str(value)


def _named(value: object) -> str:
    """A value as a part of a folder's name: data sets and paths have slashes."""
    return re.sub(rf"[^{_IN_NAMES}]+", "-", _text(value).strip("/"))
