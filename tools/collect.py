"""Evaluated runs as files of JSON, small enough for a repository."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from bidex_meta.commands.parsing import parse
from bidex_meta.errors import BidexError

if TYPE_CHECKING:
    from bidex_meta.record import RunFolder


@dataclass(frozen=True)
class CollectFlags:
    """Keep of each evaluated run a file of JSON: config, versions, thinned curves, evaluation, parameters.

    Example: python -m tools.collect runs/MT4/mtppo/* --into results/data/mystudy

    `bidex-meta compare`, `plot` and `report` take such files like run folders. A file is at most 40 kB.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN...")]
    """Run folders, or the files of sweeps, of which the runs that have ended are taken."""
    into: Path | None = None
    """Folder of the files; each is called as its run folder."""
    out: Path = Path("runs")
    """Where a sweep's folder lies, as `bidex-meta sweep` was told."""
    arm: str | None = None
    """What tables call these runs; None: of a sweep its arms, else the folder's name without suite and seed."""


def main(arguments: Sequence[str]) -> None:
    """Write the files and print their names; all of them or none.

    Raises:
        BidexError: No run is named, one is not evaluated or not of ours, or two would be the same file.
    """
    flags = parse(CollectFlags, arguments, "collect")
    if not flags.runs or flags.into is None:
        raise BidexError("Name runs and a folder: python -m tools.collect RUN RUN... --into results/data/STUDY")
    from bidex_meta.record import RunFolder
    from bidex_meta.record.atomic import check_writable, write_atomic
    from tools.condensing import arm_of, condensed, told

    made: dict[Path, bytes] = {}
    changed: list[Path] = []
    for path, arm in _named(flags):
        folder = RunFolder.open(path)
        name = folder.path.resolve().name
        out = flags.into / f"{name}.json"
        if out in made:
            raise BidexError(f"Two runs are called {name}, and so would be their files. Rename one's folder.")
        config = folder.config("learner", "num_envs", "steps")
        _refuse_another(out, config)
        content = condensed(folder, arm or arm_of(folder.path, config), _parameters(folder))
        check_writable(out)
        made[out] = told(content)
        if (content["versions"].get("git") or {}).get("dirty") is True:
            changed.append(folder.path)
    flags.into.mkdir(parents=True, exist_ok=True)
    for out, text in made.items():
        write_atomic(out, lambda file, text=text: file.write(text))
        print(out)
    for path in changed:
        print(f"{path} was made by changed code: its commit alone does not make it again.", file=sys.stderr)


def _named(flags: CollectFlags) -> list[tuple[Path, str | None]]:
    """Run folders, and what each is called: of a sweep by its arms."""
    from bidex_meta.sweep.plan import read_sweep

    found: list[tuple[Path, str | None]] = []
    for path in flags.runs:
        of_sweep = path.suffix == ".toml" and not path.is_dir()
        if not of_sweep:
            found.append((path, flags.arm))
            continue
        runs = read_sweep(path, flags.out).runs
        ended = [(run.path, flags.arm or run.arm) for run in runs if run.folder.evaluated]
        if not ended:
            raise BidexError(f"{path}: no run of it has ended under {flags.out}. Run it: bidex-meta sweep {path}")
        if len(ended) < len(runs):
            print(f"{path}: {len(runs) - len(ended)} of {len(runs)} runs have not ended: left out.", file=sys.stderr)
        found += ended
    return found


def _refuse_another(out: Path, config: dict[str, Any]) -> None:
    """Refuses to put a run in the place of another one of the same name."""
    from bidex_meta.reading import exists
    from bidex_meta.record.stored import StoredRun

    if not exists(out):
        return
    known = StoredRun.open(out).config()
    for name in ("task", "algo", "seed", "learner"):
        if known.get(name) != config[name]:
            raise BidexError(f"{out} is of another run: {name} differs. Rename the run's folder, or remove the file.")


def _parameters(folder: "RunFolder") -> int | None:
    """Numbers that the newest policy has learned, the critic not among them; None of what is no module of torch."""
    from torch import nn

    from bidex_meta.commands.policies import load_policy

    agent, _ = load_policy(folder, "cpu")
    module = agent if isinstance(agent, nn.Module) else getattr(agent, "policy", None)
    return sum(each.numel() for each in module.parameters()) if isinstance(module, nn.Module) else None


if __name__ == "__main__":
    main(sys.argv[1:])
