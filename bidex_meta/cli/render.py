"""``bidex-meta render``: draw a picture of a task, or a film of a policy."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

from bidex_meta.cli.parsing import LookFlags, Switch, parse
from bidex_meta.config import Steps
from bidex_meta.errors import BidexError
from bidex_meta.runs import video
from bidex_meta.runs.atomic import check_writable, refuse_links
from bidex_meta.utils.plugins import short_name
from bidex_meta.utils.validation import Few, Pixels, refuse_unused


@dataclass(frozen=True)
class RenderFlags(LookFlags):
    """Draw a picture of a task's start, or a film of an episode; with --tiled, show all classes side by side.

    Example: bidex-meta render --task CatchUnderarm --policy random --out catch.mp4

    bidex-meta render RUN --tiled writes a film of all classes that the run was trained on into RUN/videos/.
    """

    out: Path | None = None
    """File to write: .png (picture), .mp4 (film) or .webp (film for web pages). None: a film in videos/ of the run's
    folder; without a run, --out is needed."""
    tiled: Switch = False
    """Show all classes of the suite side by side; when an episode ends, the next one begins. A class's name is green
    while the episode counts as a success: from the first success on, or in version 2 only while the goal is held."""
    large: Switch = False
    """With --tiled: show one class at a time large next to all tiles."""
    steps: Steps | None = None
    """Environment steps to film, 60 per second. None: 0 for a picture, and for a film one episode, or with --tiled the
    longest episode."""
    every: Few | None = None  # Environment steps between two frames of a film; None: 1, with --tiled 2.
    width: Pixels | None = None  # Width of the picture, or of one tile, in pixels; None: 640, or 240 for tiles.
    height: Pixels | None = None  # Height of the picture, or of one tile, in pixels; None: three quarters of the width.
    camera: str | None = None  # Camera: front, side, top or back; None: front.
    points: Switch = False
    """Next to each picture, draw the point cloud of the class's depth camera, from the camera and from the side. The
    cloud has the same number of points as the run's observations, otherwise 768."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.tiled:
            refuse_unused(self, ("large",), "without --tiled")
        elif self.suite or self.actor not in ("zero", "random"):
            refuse_unused(self, ("task",), "with --tiled, which shows all classes")


def main(arguments: Sequence[str]) -> None:
    """Render a picture or a film, and print the path of the file."""
    flags = parse(RenderFlags, arguments, "render")
    out = flags.out or _film_of_run(flags)
    video.check_suffix(out)
    refuse_links(*([] if flags.out else [out.parent, out]))
    check_writable(out)
    from bidex_meta.cli.looking import acting, looked_at
    from bidex_meta.experiments.films import Film

    names = (field.name for field in fields(Film) if field.name not in ("out", "seed"))
    film = Film(out, **{name: getattr(flags, name) for name in names})
    film.check()
    source, slots, task = looked_at(flags, all_slots=flags.tiled)
    # One environment per slot is enough, because each slot is shown once.
    world = source.world("train", len(slots))
    agent = acting(flags.actor, world, source.seed, flags.checkpoint)
    if flags.tiled:
        rows = list(range(len(slots)))
    else:
        rows = [world.slot_env_ids[slots.index(task)].start]
    replace(film, seed=source.seed).write(agent, world, rows)
    world.close()
    print(out)


def _film_of_run(flags: RenderFlags) -> Path:
    if flags.actor in ("zero", "random"):
        raise BidexError("Name the file to write: --out film.mp4, or --out picture.png.")
    if flags.tiled:
        name = "tiled"
    else:
        name = short_name(flags.task or "film")
    return Path(flags.actor) / "videos" / (name + video.film_suffix())
