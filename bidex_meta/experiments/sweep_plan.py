"""Plans of sweeps: runs with their configs, from a list or a study file (docs/sweeps.md)."""

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from bidex_meta.config import RunConfig, flat
from bidex_meta.errors import BidexError, known_name, shortened
from bidex_meta.experiments.evaluating import USUAL_EVALUATION, FinalEvaluation
from bidex_meta.runs.folder import AnyConfig, RunFolder
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.files import Json, JsonObject, absolute, expanded, read_toml
from bidex_meta.utils.plugins import short_name
from bidex_meta.utils.validation import Seed, Text, check_fields, parse

_OWN = ("suite", "task", "algo", "seed", "run_dir", "resume", "print_config", "evaluate", "threads", "learner")
"""Flags of a run that overrides must not set, because other entries of the file or the sweep set them."""
_NO_FLAGS = ("task_seed", "record_share", "processes")
"""Fields of a resolved config that ``bidex-meta run`` fills in itself."""
_LISTS = ("dataset", "demonstrations", "teacher")
"""Fields whose flag is given once for each value."""
_WHOLE = ("steps", "record")
"""Fields that may be written 2e7."""
_MOST_RUNS = 10_000
_IN_NAMES = r"\w.+ -"  # characters of a run folder's name, before spaces become hyphens

_Name = Annotated[str, Meta(pattern=rf"^(?![. ]*\Z)[{_IN_NAMES}]{{1,60}}\Z")]
_Texts = Annotated[tuple[Text, ...], Meta(min_length=1)]
_Seeds = Annotated[tuple[Seed, ...], Meta(min_length=1)]


@dataclass(frozen=True, kw_only=True)
class _Shared:
    name: _Name
    suites: _Texts | None = None
    tasks: _Texts | None = None
    overrides: JsonObject = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class _Arm(_Shared):
    algo: Text
    seeds: _Seeds | None = None
    start_from: Text | None = None


@dataclass(frozen=True, kw_only=True)
class _File(_Shared):
    seeds: _Seeds
    algos: _Texts = ()
    grid: JsonObject = field(default_factory=dict)
    arms: tuple[_Arm, ...] = ()
    slurm: JsonObject = field(default_factory=dict)


@dataclass(frozen=True)
class PlannedRun:
    """One run of a sweep.

    It trains in a separate process. ``begin`` and ``resume`` are the command-line arguments of ``bidex-meta`` that
    start this process.
    """

    path: Path
    """The run's folder, which need not exist yet."""
    given: AnyConfig
    """The values that were given. The rest is resolved on the machine that trains."""
    arm: str
    """The name, in tables, of this run together with the runs that differ only in the seed."""
    final: FinalEvaluation = USUAL_EVALUATION
    """The evaluation at the end of the run."""
    config: AnyConfig = field(default=None, compare=False)  # pyright: ignore[reportAssignmentType]
    """``given``, resolved and checked on this machine by ``bidex_meta.experiments.sweep_progress.states_of``."""

    @property
    def name(self) -> str:
        """Return the name of the run's folder."""
        return self.path.name

    @property
    def folder(self) -> RunFolder:
        """Return the run's folder."""
        return RunFolder(self.path)

    @property
    def seed(self) -> int:
        """Return the run's seed."""
        return self.given.seed

    @property
    def subject(self) -> str:
        """Return the suite or class that the run trains on, as it was given."""
        return self.given.suite or self.given.task or ""

    @property
    def after(self) -> Path | None:
        """Return the folder of the run whose policy the run starts from."""
        if self.given.start_from is None:
            return None
        return Path(self.given.start_from)

    @property
    def begin(self) -> list[str]:
        """Return the command-line arguments of ``bidex-meta`` that start the run."""
        return ["run", *self._words(), f"--run-dir={self.path}"]

    @property
    def resume(self) -> list[str]:
        """Return the command-line arguments of ``bidex-meta`` that resume the run."""
        return ["run", f"--resume={self.path}", *self._words(may_change=True)]

    def _words(self, may_change: bool = False) -> list[str]:
        """Return the command-line flags that set the values of this run.

        Values that equal their defaults have no flag, except the learner and the seed. With ``may_change``, values that
        a resumed run may change get a flag even if they equal their defaults.
        """
        content = self.given.to_json()
        learner = content.pop("learner")
        words = []
        for entry in fields(RunConfig):
            if entry.name not in content or entry.name in _NO_FLAGS:
                continue
            value = content[entry.name]
            is_given = value not in (entry.default, []) or entry.name in ("algo", "seed")
            # The file may have set a value earlier and no longer set it, so defaults are passed too. Only steps have
            # no flag for their default.
            if is_given or (may_change and "may_change" in entry.metadata and entry.name != "steps"):
                words += words_of(entry.name, value)
        for name, value in flat(learner).items():
            words += words_of(f"learner.{name}", value)
        for entry in fields(FinalEvaluation):
            value = getattr(self.final, entry.name)
            if value != entry.default:
                words += words_of(entry.name, value)
        return words


@dataclass(frozen=True)
class SweepPlan:
    """Runs to train, from a list or a study file."""

    folder: Path
    """The folder of the runs' folders."""
    runs: Sequence[PlannedRun]
    """The runs in their order; a run that starts from another run comes after that run."""
    slurm: JsonObject = field(default_factory=dict)
    """Parameters of submitit's executor."""
    source: str = "sweep"
    """The study file, for messages."""

    @classmethod
    @checked_arguments
    def of(cls, folder: str | Path, configs: Mapping[str, RunConfig]) -> "SweepPlan":
        """Plan a run for each config, with one thread by default.

        ``configs`` maps the name of each run's folder to its config. Raises BidexError for a name that no folder can
        have.
        """
        runs = []
        for name, config in configs.items():
            if re.fullmatch(rf"[{_IN_NAMES}]+", name) is None or not name.strip(". "):
                raise BidexError(f"Expected the name of a folder, got {shortened(name)}.")
            given = replace(config, threads=config.threads or 1)
            runs.append(PlannedRun(expanded(folder) / name, given, name))
        return cls(expanded(folder), runs)

    @classmethod
    @checked_arguments
    def read(cls, file: str | Path, root: str | Path = "runs") -> "SweepPlan":
        """Read a plan from a study file (docs/sweeps.md).

        The plan lists the runs of all arms (learners with settings) with the first seed, then those with the second
        seed, and so on.

        ``root`` is the folder that contains the study's folder. Raises BidexError if the file is wrong, or if two of
        its runs have the same name. ``bidex_meta.sweep`` later raises an error for
        values that ``bidex-meta run`` does not accept.
        """
        return _read(Path(file), expanded(root))


def _read(path: Path, root: Path) -> SweepPlan:
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
    folder = root / file.name.replace(" ", "-")
    runs: dict[str, PlannedRun] = {}
    for run in _runs(path, file, arms, folder):
        if run.name in runs:
            raise BidexError(
                f"{path}: two runs are called {run.name}. Give arms different names, and each seed and value once."
            )
        if len(runs) == _MOST_RUNS:
            raise BidexError(f"{path}: expected at most {_MOST_RUNS:,} runs, got more. Split it into several sweeps.")
        runs[run.name] = run
    return SweepPlan(folder, list(runs.values()), file.slurm, str(path))


def _check_flags(path: Path, place: str, flags: JsonObject) -> None:
    for flag in flat(flags):
        if flag.replace("-", "_") in _OWN:
            raise BidexError(f"{path}: {place}.{flag}: other entries of the file or the sweep itself set this.")


def _runs(path: Path, file: _File, arms: Sequence[_Arm], folder: Path) -> Iterator[PlannedRun]:
    for seed in file.seeds:
        above: list[tuple[str, str, PlannedRun]] = []
        for arm in arms:
            if seed not in (arm.seeds or file.seeds):
                continue
            on = arm if arm.suites or arm.tasks else file
            subjects = [("suite", suite) for suite in on.suites or ()] + [("task", task) for task in on.tasks or ()]
            for (values, flags), (kind, subject) in itertools.product(_combinations(file, arm), subjects):
                called = Path(short_name(subject)).stem
                label = arm.name + values
                if subject.endswith(".toml"):
                    subject = str(absolute(path.parent / expanded(subject)))
                given, final = _parsed(f"{path}: {label}", flags, called)
                given = replace(given, **{kind: subject}, algo=arm.algo, seed=seed, threads=1)
                name = f"{called}-{label}-seed{seed}".replace(" ", "-")
                if arm.start_from is not None:
                    same = [(v, run) for start, v, run in above if (start, run.subject) == (arm.start_from, subject)]
                    starts = [run for v, run in same if v == values] or [run for _, run in same]
                    if len(starts) != 1:
                        raise BidexError(
                            f"{path}: {name} is to start from the arm {arm.start_from!r}, of which there are "
                            f"{len(starts)} runs on {subject} above it. Give both the same suites, tasks and grid."
                        )
                    given = replace(given, start_from=str(starts[0].path))
                run = PlannedRun(folder / name, given, label, final)
                above.append((arm.name, values, run))
                yield run


def _combinations(file: _File, arm: _Arm) -> Iterator[tuple[str, JsonObject]]:
    """Yield all combinations of the values in the grid that apply to an arm.

    An arm is a learner with its settings. Each combination comes as a label and the values of all fields, including
    those that the file or the arm sets. Fields that the arm sets are left out of the grid.
    """
    shared = _by_field(file.overrides)
    own = _by_field(arm.overrides)
    grid = {name: values for name, values in _by_field(file.grid).items() if name not in own}
    for values in itertools.product(*grid.values()):
        chosen = dict(zip(grid, values, strict=True))
        label = "".join(f" {name.rpartition('.')[2]}={_named(value)}" for name, value in chosen.items())
        yield label, {**shared, **chosen, **own}


def _by_field(flags: JsonObject) -> JsonObject:
    """Flatten nested tables of settings into one dict whose keys are field names.

    A study file may write names with hyphens, like flags; these become underscores.
    """
    return {flag.replace("-", "_"): value for flag, value in flat(flags).items()}


def _parsed(where: str, values: JsonObject, called: str) -> tuple[RunConfig[JsonObject], FinalEvaluation]:
    """Return the run's config and its final evaluation, from values by field name.

    ``called`` is the short name of the suite or class; it replaces ``{subject}`` in texts. ``where`` begins the error
    messages.
    """
    parts: dict[str, JsonObject] = {"config": {}, "learner": {}, "final": {}}
    of_final = {entry.name for entry in fields(FinalEvaluation)}
    of_config = {entry.name for entry in fields(RunConfig)}.difference(_OWN, _NO_FLAGS, ["start_from"])
    for name, value in values.items():
        value = _filled(value, called)
        if name.startswith("learner."):
            parts["learner"][name.removeprefix("learner.")] = value
        elif name in of_final:
            parts["final"][name] = value
        else:
            known_name("override", name, sorted(of_config | of_final))
            if name in _LISTS and isinstance(value, str):
                value = [value]
            if name in _WHOLE and isinstance(value, float) and value.is_integer():
                value = int(value)
            parts["config"][name] = value
    config = parse(parts["config"] | {"learner": parts["learner"]}, RunConfig[JsonObject], where)
    return config, parse(parts["final"], FinalEvaluation, where)


def _filled(value: Json, called: str) -> Json:
    if isinstance(value, list):
        return [_filled(item, called) for item in value]
    if isinstance(value, str):
        return None if value == "None" else value.replace("{subject}", called)
    return value


def words_of(name: str, value: Json) -> list[str]:
    """Return the command-line arguments of ``bidex-meta run`` that set the field ``name`` to ``value``."""
    flag = name.replace("_", "-")
    if isinstance(value, bool):
        before, dot, last = flag.rpartition(".")
        return [f"--{flag}" if value else f"--{before}{dot}no-{last}"]
    if not isinstance(value, list):
        return [f"--{flag}={_text(value)}"]
    if name in _LISTS:
        return [f"--{flag}={_text(item)}" for item in value]
    return [f"--{flag}", *map(_text, value)]


def _text(value: Json) -> str:
    if isinstance(value, list):
        return "x".join(map(_text, value))
    return str(value)


def _named(value: Json) -> str:
    """Return a value as a part of a folder's name, with hyphens instead of slashes and other special characters."""
    return re.sub(rf"[^{_IN_NAMES}]+", "-", _text(value).strip("/"))
