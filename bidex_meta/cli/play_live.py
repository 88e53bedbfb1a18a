"""``bidex-meta play``: a policy at work, live."""

import contextlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from bidex_meta.cli.parsing import CheckpointName, ObjectName, PolicyName, Switch, parse
from bidex_meta.errors import known_name
from bidex_meta.utils import gl_backend
from bidex_meta.utils.plugins import name_with_object
from bidex_meta.utils.validation import NonNegative, Port, Positive, Seed

if TYPE_CHECKING:
    from bidex_meta.viewer.playback import Screen, Stage


@dataclass(frozen=True)
class PlayFlags:
    """Look at a policy live: in MuJoCo's viewer, or in the browser where there is no screen.

    Example: bidex-meta play runs/MT4/mtppo/2026-11-21_10-00-00_seed0 --task CatchAbreast

    bidex-meta play --task SwingCup --policy random needs no run.
    """

    run: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")] = None
    """Run folder; the same as --policy RUN."""
    task: str | None = None
    """Class to look at; None: the first one. In the browser it can be changed."""
    object: ObjectName = None
    policy: PolicyName = "zero"
    checkpoint: CheckpointName = "last"
    suite: str | None = None
    """Show the classes of this suite; None: the run's."""
    seed: Seed = 0
    """Seed of tasks and starts."""
    speed: Positive = 1.0
    """Of the clock; 0.5 is slow motion."""
    browser: Switch = False
    """In the browser, also where there is a screen."""
    host: str = "127.0.0.1"
    """Address the browser's page is served at; 0.0.0.0 lets other machines in."""
    port: Port = 8080
    """Port of that page; where it is taken, the next free one."""
    seconds: NonNegative | None = None
    """End after so many seconds; None: when the window is closed, or Ctrl-C."""


def main(arguments: Sequence[str]) -> None:
    """Play until it is closed.

    Raises:
        BidexError: Bad flags, a policy that does not fit, or no window and no viser.
    """
    flags = parse(PlayFlags, arguments, "play")
    from bidex_meta.cli.policies import acting, looked_at, slots_of
    from bidex_meta.viewer.playback import Stage, play

    policy = flags.policy if flags.run is None else str(flags.run)
    source = looked_at(policy, flags.suite, flags.task, flags.seed, flags.object)
    slots, named = slots_of(source), flags.task and name_with_object(flags.task, flags.object)
    task = known_name(f"task of {source.name}", named or slots[0], source.task_classes())
    world: Any = source.world("train", len(slots))
    stage = Stage(world, acting(policy, world, flags.seed, flags.checkpoint), slots.index(task), flags.seed)
    screen = _screen(flags, stage)
    with contextlib.suppress(KeyboardInterrupt):  # how the view in the browser is ended
        play(stage, screen, flags.seconds)
    world.close()


def _screen(flags: PlayFlags, stage: "Stage") -> "Screen":
    if gl_backend.has_screen() and not flags.browser:
        from bidex_meta.viewer import desktop

        print(desktop.KEYS, file=sys.stderr)
        return desktop.Desktop(stage, flags.speed)
    from bidex_meta.viewer.browser import Browser

    screen = Browser(stage, flags.host, flags.port, flags.speed)
    print(f"Open {screen.address} in a browser; Ctrl-C ends it.", file=sys.stderr, flush=True)
    return screen
