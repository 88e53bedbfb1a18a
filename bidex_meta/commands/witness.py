"""``bidex-meta witness``: actions that prove that a task can be solved."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bidex_meta.commands.parsing import Switch, parse
from bidex_meta.errors import BidexError, known_name
from bidex_meta.memory import ROW_BYTES, check_memory
from bidex_meta.witness.config import PlannerConfig

if TYPE_CHECKING:
    import numpy as np

    from bidex_meta.witness.simulator import Trace
    from bidex_meta.witness.store import Witness


_FOUND = Path("witnesses")
"""Folder, in the working folder, of what a search finds. The installation's own are data of a release."""


@dataclass(frozen=True)
class WitnessFlags:
    """Replay the recorded actions that solve a task, from its start and from ten slightly shifted ones, or search some.

    Example: bidex-meta witness --task CatchUnderarm
    """

    task: str | None = None
    """Task class."""
    all: Switch = False
    """Every class there is, instead of one."""
    find: Switch = False
    """Search with a sampling planner on the printed reward, and keep the episode found if it holds: as --file says, or
    in witnesses/TASK.npz of the working folder."""
    tries: int = 1
    """Searches with other seeds before giving up."""
    file: Path | None = None
    """Replay this file, not the stored witness; with --find keep the best episode here, whether it holds or not."""
    improve: Path | None = None
    """With --find: start from the episode in this file."""
    steady: int = 0
    """With --find and --improve: no search, but so many rounds of small changes that shall stand shifted starts."""
    whole: int = 0
    """With --find and --improve: so many rounds of whole episodes instead of plans that look some steps ahead."""
    exchange: int = 0
    """With --whole: the episode is of a throw from right to left. Both hands throw for so many steps, then catch."""
    script: Switch = False
    """With --find: play the class's script (bidex_meta/witness/scripts.py) instead of searching."""
    out: Path | None = None
    """Also write a film (.mp4) of the witness, or a picture (.png) of its last step."""
    camera: str | None = None
    """front, side, top or back."""
    threads: int | None = None
    """Threads of the physics; None: one per core."""
    json: Switch = False
    """Print JSON."""
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    """The search."""


def main(arguments: Sequence[str]) -> None:
    """Search or replay, and print what was found."""
    flags = parse(WitnessFlags, arguments, "witness")
    names = _names(flags)
    _check_files(flags)
    find = _play_script if flags.script else _steady if flags.steady else _whole if flags.whole else _find
    files = {name: find(name, flags) if flags.find else flags.file for name in names}
    rows = [_replay(name, file, flags.threads) for name, file in files.items()]
    if flags.out is not None:
        _film(names[0], files[names[0]], flags)
    if flags.json:
        print(json.dumps(rows, indent=2))
        return
    from bidex_meta.commands.tables import plain_table, print_table

    print_table(plain_table(list(rows[0]), [list(row.values()) for row in rows]))


def _names(flags: WitnessFlags) -> list[str]:
    from bidex_meta.tasks import registry

    if flags.all == (flags.task is not None):
        raise BidexError("witness: expected --task T or --all, got " + ("both." if flags.all else "neither."))
    how = ("improve", "script", "steady", "whole", "exchange")
    if not flags.find and (given := next((name for name in how if getattr(flags, name)), None)):
        raise BidexError(f"witness: --{given} says how to find an episode; give it with --find.")
    if flags.exchange and not flags.whole:
        raise BidexError("witness: --exchange says what --whole begins with; give it with --whole ROUNDS.")
    if flags.all and (flags.out is not None or flags.file is not None or flags.improve is not None):
        raise BidexError("witness: films and files are of one class; give --task T with --out or --file.")
    return registry.names() if flags.task is None else [known_name("task", flags.task, registry.names())]


def _check_files(flags: WitnessFlags) -> None:
    """Refuses, before a search or a replay, what could not be written after it, and too many samples."""
    from bidex_meta.record import video
    from bidex_meta.record.atomic import check_writable

    if flags.out is not None:
        video.check_suffix(flags.out)
        check_writable(flags.out)
    if flags.find:
        check_memory(flags.planner.samples * ROW_BYTES, f"{flags.planner.samples:,} samples", "Lower them.")
        check_writable(flags.file or _FOUND / f"{flags.task or 'x'}.npz")


def _replay(name: str, file: Path | None, threads: int | None) -> dict[str, Any]:
    """A row of the table: of the witness in a file, or the installation's."""
    from bidex_meta.witness.replay import replay
    from bidex_meta.witness.store import load_witness, witness_path

    keys = ("found", "return", "first_success", "shifted", "steps", "deepest_mm", "rival")
    if file is None and not witness_path(name).is_file():
        return {"task": name, **dict.fromkeys(keys), "found": False}
    witness = load_witness(name, file)
    result, rival = replay(name, witness, threads), witness.made.get("rival")
    values = (
        result.found,
        round(result.total, 3),
        result.first_success,
        result.succeeded,
        len(witness.actions),
        round(1000.0 * result.deepest, 1),
        None if rival is None else round(rival, 3),
    )
    return {"task": name, **dict(zip(keys, values, strict=True))}


def _find(name: str, flags: WitnessFlags) -> Path | None:
    """Searches with one seed after another until an episode holds; where it is kept."""
    from dataclasses import asdict, replace

    from bidex_meta.record.versions import collect_versions
    from bidex_meta.witness.planner import Planner
    from bidex_meta.witness.replay import replay
    from bidex_meta.witness.store import Witness, load_witness

    earlier = None if flags.improve is None else load_witness(name, flags.improve)
    rivals: list[float] = []
    best, kept = -float("inf"), flags.file
    for attempt in range(flags.tries):
        config = replace(flags.planner, seed=flags.planner.seed + attempt)
        plan = Planner(name, config, flags.threads).search(
            _reporter(name), None if earlier is None else earlier.actions
        )
        lost = plan.total if plan.first_success is None else None
        rivals += [total for total in (plan.rival, lost) if total is not None]
        made = {"return": plan.total, "first_success": plan.first_success, "planner": asdict(config)}
        made |= {"rival": max(rivals, default=None), "versions": collect_versions()}
        if earlier is not None:
            made["improved"] = earlier.made
        witness = Witness(plan.actions, made)
        holds = plan.first_success is not None and replay(name, witness, flags.threads).found
        if holds or (flags.file is not None and plan.total > best):
            best = plan.total
            kept = _keep(name, witness, flags)
        if holds:
            break
        print(f"{name}: seed {config.seed} gave a return of {plan.total:.3f}, first success {plan.first_success}.")
    return kept


def _play_script(name: str, flags: WitnessFlags) -> Path | None:
    """Plays a class's script; where the episode is kept if it holds."""
    import numpy as np

    from bidex_meta.record.versions import collect_versions
    from bidex_meta.witness.puppets import shifted_puppets
    from bidex_meta.witness.replay import replay
    from bidex_meta.witness.scripts import script_of
    from bidex_meta.witness.store import Witness

    play = script_of(name)
    hands = shifted_puppets(name, flags.threads)
    play(hands)
    first = hands.success.index(True) if any(hands.success) else None
    made = {"return": sum(hands.rewards), "first_success": first, "script": play.__name__, "rival": None}
    witness = Witness(np.stack([a.numpy() for a in hands.actions]), made | {"versions": collect_versions()})
    holds = flags.file is not None or replay(name, witness, flags.threads).found
    return _keep(name, witness, flags) if holds else None


def _steady(name: str, flags: WitnessFlags) -> Path | None:
    """Makes an episode safer against shifted starts; where it is kept if it holds."""
    from bidex_meta.witness.steady import steadied
    from bidex_meta.witness.store import load_witness

    if flags.improve is None:
        raise BidexError("witness: --steady makes an episode safer; give it with --improve FILE.")
    earlier, seed = load_witness(name, flags.improve), flags.planner.seed

    def report(solved: int, total: float, deep: float) -> None:
        print(f"{name}: {solved} of 10 shifted starts, mean return {total:.3f}, deep states {deep:.1f}", flush=True)

    actions = steadied(name, earlier.actions, flags.steady, seed, flags.threads, report)
    made = earlier.made | {"steadied": {"rounds": flags.steady, "seed": seed}}
    return _keep_if_it_holds(name, actions, made, flags)


def _whole(name: str, flags: WitnessFlags) -> Path | None:
    """Searches whole episodes, from an earlier one; where the last round's best is kept if it holds."""
    from bidex_meta.witness.store import load_witness
    from bidex_meta.witness.whole import exchanged, searched

    if flags.improve is None:
        raise BidexError("witness: --whole goes on from an episode; give it with --improve FILE.")
    earlier, seed = load_witness(name, flags.improve), flags.planner.seed
    began = exchanged(earlier.actions, flags.exchange) if flags.exchange else earlier.actions

    def report(number: int, trace: "Trace", best: int) -> None:
        total, least = (float(x[:, best].sum()) for x in (trace.rewards, trace.least))
        solved = int(trace.success.any(0).sum())
        print(f"{name}: round {number}, return {total:.3f}, least term {least:.3f}, {solved} succeed", flush=True)

    actions = searched(name, began, flags.whole, seed, flags.threads, report)
    how = {"rounds": flags.whole, "exchange": flags.exchange, "seed": seed, "began_with": earlier.made}
    return _keep_if_it_holds(name, actions, {"rival": None, "whole": how}, flags)


def _keep_if_it_holds(name: str, actions: "np.ndarray", made: dict[str, Any], flags: WitnessFlags) -> Path | None:
    """Where an episode is kept: if it stands shifted starts, or a file was named for it."""
    import torch

    from bidex_meta.record.versions import collect_versions
    from bidex_meta.witness.replay import replay
    from bidex_meta.witness.simulator import Simulator
    from bidex_meta.witness.store import Witness

    trace = Simulator(name, 1, flags.threads).play(torch.from_numpy(actions)[:, None])
    won = trace.success[:, 0].nonzero().flatten().tolist()
    made = made | {"return": float(trace.rewards.sum()), "first_success": won[0] if won else None}
    witness = Witness(actions, made | {"versions": collect_versions()})
    holds = flags.file is not None or replay(name, witness, flags.threads).found
    return _keep(name, witness, flags) if holds else None


def _keep(name: str, witness: "Witness", flags: WitnessFlags) -> Path:
    from bidex_meta.witness.store import save_witness

    path = save_witness(flags.file or _FOUND / f"{name}.npz", witness.actions, witness.made)
    print(f"{name}: stored {path}")
    return path


def _reporter(name: str) -> Any:
    def report(steps: int, total: float, success: bool) -> None:
        print(f"{name}: step {steps}, return {total:.3f}{', success' if success else ''}", flush=True)

    return report


def _film(name: str, file: Path | None, flags: WitnessFlags) -> None:
    from bidex_meta.record import video
    from bidex_meta.tasks.base import CONTROL_RATE
    from bidex_meta.witness.replay import frames
    from bidex_meta.witness.store import load_witness

    assert flags.out is not None
    pictures = frames(name, load_witness(name, file), camera=flags.camera)
    if video.check_suffix(flags.out) == ".mp4":
        video.write_video(flags.out, pictures, CONTROL_RATE)
        return
    *_, last = pictures
    video.write_image(flags.out, last)
