"""``bidex-meta witness``: replay stored reference solutions."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidex_meta.cli.parsing import JsonSwitch, Switch, parse
from bidex_meta.cli.tables import Json, print_rows
from bidex_meta.errors import BidexError, known_name
from bidex_meta.rules import CONTROL_RATE
from bidex_meta.runs import video
from bidex_meta.runs.atomic import check_writable
from bidex_meta.tasks import registry
from bidex_meta.utils.validation import Threads
from bidex_meta.witness.store import load_witness, witness_path


@dataclass(frozen=True)
class WitnessFlags:
    """Replay a task's witness (recorded actions that solve the task) from its start and from ten shifted starts.

    Example: bidex-meta witness --task CatchUnderarm
    """

    task: str | None = None  # Task class whose witness is replayed.
    all: Switch = False  # Replay the witnesses of all classes.
    file: Path | None = None  # Replay this file instead of the stored witness.
    out: Path | None = None  # Also write a film (.mp4, .webp) of the witness, or a picture (.png) of its last step.
    camera: str | None = None  # Camera of the film or picture: front, side, top or back.
    threads: Threads | None = None  # CPU threads for the physics; None: one per core.
    json: JsonSwitch = False


def main(arguments: Sequence[str]) -> None:
    """Replay the witnesses of one class or of all classes, and print the results."""
    flags = parse(WitnessFlags, arguments, "witness")
    if flags.all == (flags.task is not None):
        raise BidexError("witness: expected --task T or --all, got " + ("both." if flags.all else "neither."))
    if flags.all and (flags.out is not None or flags.file is not None):
        raise BidexError("witness: films and files are of one class; give --task T with --out or --file.")
    if flags.task is None:
        names = registry.names()
    else:
        names = [known_name("task", flags.task, registry.names())]
    if flags.out is not None:
        video.check_suffix(flags.out)
        check_writable(flags.out)
    rows = [_replay(name, flags) for name in names]
    if flags.out is not None:
        from bidex_meta.witness.replay import frames

        pictures = frames(names[0], load_witness(names[0], flags.file), camera=flags.camera)
        if video.check_suffix(flags.out) in video.FILMS:
            video.write_film(flags.out, pictures, CONTROL_RATE)
        else:
            *_, last = pictures
            video.write_image(flags.out, last)
    print_rows(rows, flags.json)


def _replay(name: str, flags: WitnessFlags) -> Json:
    if flags.file is None and not witness_path(name).is_file():
        keys = ("return", "first_success", "shifted", "steps", "deepest_mm", "rival")
        return {"task": name, "found": False, **dict.fromkeys(keys)}
    from bidex_meta.witness.replay import replay

    witness = load_witness(name, flags.file)
    result = replay(name, witness, flags.threads)
    rival = witness.made.get("rival")
    return {
        "task": name, "found": result.found, "return": round(result.total, 3), "first_success": result.first_success,
        "shifted": result.succeeded, "steps": len(witness.actions), "deepest_mm": round(1000.0 * result.deepest, 1),
        "rival": None if rival is None else round(rival, 3),
    }  # fmt: skip
