"""``bidex-meta render``: draw a picture of a task, or a film of a policy."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidex_meta.cli.parsing import LookFlags, Switch, parse
from bidex_meta.config import Steps
from bidex_meta.errors import BidexError
from bidex_meta.rules import CONTROL_RATE
from bidex_meta.runs import video
from bidex_meta.runs.atomic import check_writable, refuse_links
from bidex_meta.runs.progress import counted
from bidex_meta.utils.plugins import short_name
from bidex_meta.utils.validation import Few, Pixels


@dataclass(frozen=True)
class RenderFlags(LookFlags):
    """A picture of a task's start, or a film of an episode; of a run all classes beside each other.

    Example: bidex-meta render --task CatchUnderarm --policy random --out catch.mp4

    bidex-meta render RUN --tiled puts a film of every class it was trained on into RUN/videos/.
    """

    out: Path | None = None
    """File: .png (picture), .mp4 (film) or .webp (film for web pages); None, of a run: a film in its videos/."""
    tiled: Switch = False
    """All classes of the suite beside each other; where an episode ends the next one begins. A name is green while
    the episode counts as a success: from its first success on; in version 2 while the goal is held."""
    large: Switch = False
    """With --tiled: one class at a time large beside all."""
    steps: Steps | None = None
    """Steps to take, 60 a second; None: none for a picture, one episode for a film, with --tiled the longest one."""
    every: Few | None = None  # Steps from one frame of a film to the next; None: 1, with --tiled 2.
    width: Pixels | None = None  # Pixels, of a tile with --tiled; None: 640, with --tiled 240.
    height: Pixels | None = None  # Pixels, likewise; None: three quarters of the width.
    camera: str | None = None  # front, side, top or back; None: front.
    points: Switch = False
    """Beside each picture the point cloud of the class's depth camera, seen from there and from the side; as many
    points as the run's observations have, else 768."""


def main(arguments: Sequence[str]) -> None:
    """Render and print the file's path."""
    flags = parse(RenderFlags, arguments, "render")
    out = flags.out
    if out is None:
        if flags.actor in ("zero", "random"):
            raise BidexError("Name the file to write: --out film.mp4, or --out picture.png.")
        if flags.tiled:
            name = "tiled"
        else:
            name = short_name(flags.task or "film")
        out = Path(flags.actor) / "videos" / (name + video.film_suffix())
    suffix = video.check_suffix(out)
    refuse_links(*([] if flags.out else [out.parent, out]))
    check_writable(out)
    width = flags.width or (240 if flags.tiled else 640)
    height = flags.height or width * 3 // 4
    if suffix == ".mp4":
        if width % 2 or height % 2:
            raise BidexError(f"A film needs an even width and height, not {width} x {height}.")
        video.check_films()
    every = flags.every or (2 if flags.tiled else 1)
    from bidex_meta.cli.looking import acting, looked_at
    from bidex_meta.evaluation.filming import film_row, film_tiles, with_clouds

    source, slots, task = looked_at(flags, all_slots=flags.tiled)
    # One environment per slot is enough, because each slot is shown once.
    world = source.world("train", len(slots))
    agent = acting(flags.actor, world, flags.seed, flags.checkpoint)
    if flags.points:
        world = with_clouds(world)
    if flags.tiled:
        rows = list(range(len(slots)))
    else:
        rows = [world.slot_env_ids[slots.index(task)].start]
    longest = int(world.max_episode_steps[rows].max())
    if flags.steps is not None:
        steps = flags.steps
    elif suffix == ".png":
        steps = 0
    else:
        steps = longest
    look = {"width": width, "height": height, "camera": flags.camera}
    if flags.tiled:
        if suffix == ".png":
            every = max(steps, 1)
        frames = film_tiles(agent, world, rows, steps, flags.seed, every, flags.large, **look)
        count = steps // every + 1
    elif suffix == ".png":  # only the last frame
        frames = film_row(agent, world, rows[0], steps, flags.seed, None, **look)
        count = 1
    else:
        frames = film_row(agent, world, rows[0], steps, flags.seed, every, **look)
        count = steps // every + 1
    frames = counted(frames, count, "frames")
    if suffix in video.FILMS:
        video.write_film(out, frames, CONTROL_RATE / every)
    else:
        for frame in frames:  # a tiled picture comes after the first frame
            video.write_image(out, frame)
    world.close()
    print(out)
