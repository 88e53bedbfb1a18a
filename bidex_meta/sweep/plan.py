"""A sweep's file as the runs it asks for, each as the words of ``bidex-meta run``. docs/sweeps.md explains the file."""

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bidex_meta.errors import BidexError, shortened, unknown_name
from bidex_meta.outside import short_name
from bidex_meta.reading import TABLE, TEXT, Rule, absolute, check, expanded, read_toml, whole
from bidex_meta.record.folder import RunFolder, flat

_OWN = ("suite", "task", "algo", "seed", "run_dir", "resume", "print_config", "evaluate", "threads", "learner")
"""Flags of a run that the file says otherwise, or that a sweep decides."""
_CHANGING = frozenset((
    *("--steps", "--minutes", "--evaluate-every", "--video-every", "--logger"),
    *("--episodes", "--split", "--shots", "--rollouts", "--tasks"),
))  # fmt: skip
"""Flags that a resumed run may be given anew."""
_MOST_RUNS = 10_000


def _list_of(rule: Rule) -> Rule:
    return Rule(
        f"a list, each entry {rule.told}",
        lambda value: isinstance(value, list) and 0 < len(value) <= 1000 and all(map(rule.fits, value)),
    )


_SUBJECT = "{subject}"
"""In a flag's value: the run's suite or class."""
_IN_NAMES = r"\w.+ -"
_NAMED = Rule(
    "letters, digits, blanks and . + - _ (60 at most)",
    lambda value: isinstance(value, str) and bool(re.fullmatch(rf"[{_IN_NAMES}]{{1,60}}", value)),
)
_SUBJECTS = {"suites": _list_of(TEXT), "tasks": _list_of(TEXT)}
_FILE = {
    **_SUBJECTS,
    "name": _NAMED,
    "algos": _list_of(TEXT),
    "seeds": _list_of(whole(0)),
    "overrides": TABLE,
    "grid": TABLE,
    "arms": Rule("a list of tables", lambda value: isinstance(value, list) and all(map(TABLE.fits, value))),
    "slurm": TABLE,
}
_ARM = {**_SUBJECTS, "name": _NAMED, "algo": TEXT, "seeds": _FILE["seeds"], "overrides": TABLE, "start_from": TEXT}


@dataclass(frozen=True)
class PlannedRun:
    """A run that a sweep's file asks for."""

    path: Path
    """Its folder."""
    arm: str
    """What tables call it and its like on other seeds."""
    subject: str
    """The suite or class, as the file names it."""
    seed: int
    """Its seed."""
    words: tuple[str, ...]
    """Flags of ``bidex-meta run``, without seed and folder."""
    after: Path | None = None
    """The folder of the run whose policy it starts from."""

    @property
    def name(self) -> str:
        """Its folder's name."""
        return self.path.name

    @property
    def folder(self) -> RunFolder:
        """Its folder, which need not be there yet."""
        return RunFolder(self.path)

    @property
    def begin(self) -> list[str]:
        """The words that begin it."""
        started = [] if self.after is None else [f"--start-from={self.after}"]
        return ["run", *self.words, *started, f"--seed={self.seed}", "--threads=1", f"--run-dir={self.path}"]

    @property
    def go_on(self) -> list[str]:
        """The words that continue it: those alone that a resumed run may be given anew."""
        return ["run", f"--resume={self.path}", *(word for word in self.words if word.split("=")[0] in _CHANGING)]


@dataclass(frozen=True)
class Sweep:
    """All that a file asks for."""

    name: str
    """Its runs lie in a folder of this name."""
    out: Path
    """That folder."""
    runs: list[PlannedRun]
    """In the order they are run: all arms of the first seed, then of the second."""
    slurm: dict[str, Any]
    """Parameters of submitit's executor."""


def read_sweep(path: Path, root: Path = Path("runs")) -> Sweep:
    """A sweep's file.

    Args:
        path: The file.
        root: Where the sweep's folder lies.

    Raises:
        BidexError: The file cannot be read, has an entry that there is not or of a kind that it cannot be, or two of
            its runs would be one. What ``bidex-meta run`` would refuse is not looked at here.
    """
    content = read_toml(path, "a sweep")
    _check(content, _FILE, path, ("name", "seeds"), "")
    overrides, grid = flat(content.get("overrides", {})), flat(content.get("grid", {}))
    _refuse_own(overrides, path, "overrides")
    _refuse_own(grid, path, "grid")
    for flag, values in grid.items():
        if not isinstance(values, list) or not values:
            raise BidexError(f"{path}: grid.{flag}: expected a list of values to try, got {shortened(values)}.")
    arms = [{"name": short_name(algo), "algo": algo} for algo in content.get("algos", [])] + content.get("arms", [])
    if not arms:
        raise BidexError(f'{path}: expected algos = ["mtppo"] or [[arms]], found neither.')
    out, runs = expanded(root) / content["name"].replace(" ", "-"), []
    for seed in content["seeds"]:
        of_seed: dict[int, list[PlannedRun]] = {}
        for place, arm in enumerate(arms):
            of_seed[place] = list(_runs(path, content, arm, place, seed, (overrides, grid), out))
            if len(runs) + sum(map(len, of_seed.values())) > _MOST_RUNS:
                raise BidexError(f"{path}: expected at most {_MOST_RUNS:,} runs, got more. Make several sweeps of it.")
        runs += [run for place, arm in enumerate(arms) for run in _following(path, arms, place, of_seed)]
    names = [run.name for run in runs]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise BidexError(f"{path}: two runs are called {twice}. Name arms apart, and each seed and value once.")
    return Sweep(content["name"], out, runs, content.get("slurm", {}))


def _runs(
    path: Path,
    content: Mapping[str, Any],
    arm: Mapping[str, Any],
    place: int,
    seed: int,
    shared: tuple[Mapping[str, Any], Mapping[str, Sequence[Any]]],
    out: Path,
) -> Iterator[PlannedRun]:
    """The runs of an arm on one seed: all its subjects with every combination of the grid; none on a seed it leaves."""
    _check(arm, _ARM, path, ("name", "algo"), f"arms[{place}].")
    seeds = arm.get("seeds", content["seeds"])
    if not set(seeds) <= set(content["seeds"]):
        raise BidexError(f"{path}: arms[{place}].seeds: expected seeds of the file's {content['seeds']}, got {seeds}.")
    if seed not in seeds:
        return
    own = flat(arm.get("overrides", {}))
    _refuse_own(own, path, f"arms[{place}].overrides")
    overrides, grid = shared[0], _varied(shared[1], own)
    subjects = arm if arm.keys() & _SUBJECTS.keys() else content
    named = [(kind[:-1], each) for kind in _SUBJECTS for each in subjects.get(kind, [])]
    if not named:
        raise BidexError(f"{path}: expected suites or tasks, for all or for the arm {arm['name']!r}, found neither.")
    for values in itertools.product(*grid.values()):
        chosen = dict(zip(grid, values, strict=True))
        label = " ".join([arm["name"], *(f"{_last(flag)}={_named(value)}" for flag, value in chosen.items())])
        flags = [word for flag, value in {**overrides, **chosen, **own}.items() for word in _words(flag, value, path)]
        for kind, subject in named:
            given = str(absolute(path.parent / expanded(subject))) if subject.endswith(".toml") else subject
            called = Path(short_name(subject)).stem
            name = f"{called}-{label}-seed{seed}".replace(" ", "-")
            words = (f"--{kind}={given}", f"--algo={arm['algo']}", *(word.replace(_SUBJECT, called) for word in flags))
            yield PlannedRun(out / name, label, subject, seed, words)


def _following(
    path: Path, arms: Sequence[Mapping[str, Any]], place: int, of_seed: Mapping[int, Sequence[PlannedRun]]
) -> Iterator[PlannedRun]:
    """The runs of an arm on one seed, each with the run on the same subject that it starts from, where it says so."""
    name = arms[place].get("start_from")
    if name is None:
        yield from of_seed[place]
        return
    earlier = [other["name"] for other in arms[:place]]
    if name not in earlier:
        above = ", ".join(earlier) or "none there"
        raise BidexError(
            f"{path}: arms[{place}].start_from: expected the name of an arm above it ({above}), got {name!r}."
        )
    for run in of_seed[place]:
        found = [other for other in of_seed[earlier.index(name)] if other.subject == run.subject]
        values = run.arm.removeprefix(arms[place]["name"])
        alike = [other for other in found if other.arm == name + values] or found
        if len(alike) != 1:
            raise BidexError(
                f"{path}: {run.name} is to start from the arm {name!r}, of which there are {len(alike)} runs on "
                f"{run.subject}. Give both the same suites and tasks, and the same values of the grid."
            )
        yield replace(run, after=alike[0].path)


def _check(
    content: Mapping[str, Any], rules: Mapping[str, Rule], path: Path, needed: tuple[str, ...], place: str
) -> None:
    unknown = [name for name in content if name not in rules]
    if unknown:
        raise BidexError(f"{path}: {place}{unknown[0]}: {unknown_name('entry', unknown[0], rules)}")
    check(content, rules, path, needed, place)


def _refuse_own(overrides: Mapping[str, Any], path: Path, place: str) -> None:
    for flag in overrides:
        if flag.replace("-", "_") in _OWN:
            raise BidexError(
                f"{path}: {place}.{flag}: the file's suites, tasks, algos and seeds say that, and each run has one "
                "thread and is evaluated. Leave it out."
            )


def _varied(grid: Mapping[str, Sequence[Any]], own: Mapping[str, Any]) -> dict[str, Sequence[Any]]:
    """The grid of an arm: without what it sets itself, or it would be run once a value and be the same each time."""
    fixed = {flag.replace("-", "_") for flag in own}
    return {flag: values for flag, values in grid.items() if flag.replace("-", "_") not in fixed}


def _words(flag: str, value: Any, path: Path) -> list[str]:
    """A value as words of the command line."""
    if not re.fullmatch(r"[A-Za-z][\w.-]*", flag):
        raise BidexError(f"{path}: expected a flag of bidex-meta run such as learner.gamma, got {shortened(flag)}.")
    flag = flag.replace("_", "-")
    if isinstance(value, bool):
        before, dot, last = flag.rpartition(".")
        return [f"--{flag}" if value else f"--{before}{dot}no-{last}"]
    if isinstance(value, list):
        # Of these flags alone each value is given with its name: see RunFlags.
        many = flag in ("dataset", "demonstrations")
        return [f"--{flag}={_told(each)}" for each in value] if many else [f"--{flag}", *map(_told, value)]
    return [f"--{flag}={_told(value)}"]


def _told(value: Any) -> str:
    return "x".join(map(_told, value)) if isinstance(value, list) else str(value)


def _named(value: Any) -> str:
    """A value as a part of a folder's name: data sets and paths have slashes."""
    return re.sub(rf"[^{_IN_NAMES}]+", "-", _told(value).strip("/"))


def _last(flag: str) -> str:
    return flag.rpartition(".")[2]
