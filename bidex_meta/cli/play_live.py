"""``bidex-meta play``: show a policy live."""

import contextlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from bidex_meta.cli.parsing import LookFlags, Switch, parse
from bidex_meta.errors import BidexError
from bidex_meta.utils import gl_backend, paths
from bidex_meta.utils.validation import NonNegative, Port, Positive
from bidex_meta.utils.waiting import note

if TYPE_CHECKING:
    from bidex_meta.viewer.playback import Screen, Stage


@dataclass(frozen=True)
class PlayFlags(LookFlags):
    """Watch a policy live in MuJoCo's viewer, or in the browser if there is no screen.

    Example: bidex-meta play runs/MT4/mtppo/2026-11-21_10-00-00_seed0 --task CatchAbreast

    Without arguments, bidex-meta play shows the policy that comes with bidex-meta, one episode of each class of
    MT20-v2. bidex-meta play --task SwingCup --policy random needs no run either.
    """

    speed: Positive = 1.0  # Playback speed relative to real time; 0.5 is slow motion.
    browser: Switch = False  # Show the policy in the browser, even if there is a screen.
    host: str = "127.0.0.1"  # Address at which the browser's page is served; 0.0.0.0 admits other machines.
    port: Port = 8080  # Port of the browser's page; if it is taken, the next free port is used.
    seconds: NonNegative | None = None
    """Stop after this number of seconds; None: when the window is closed or at Ctrl-C."""


def main(arguments: Sequence[str]) -> None:
    """Play a policy in a viewer until the viewer is closed."""
    flags = parse(PlayFlags, arguments, "play")
    tour = not (flags.run or flags.task or flags.suite) and flags.policy == PlayFlags.policy
    if tour:
        flags = replace(flags, run=paths.shipped_policy())
    from bidex_meta.cli.looking import acting, looked_at
    from bidex_meta.viewer.playback import Stage, play

    source, slots, task = looked_at(flags)
    world: Any = source.world("train", len(slots))
    agent = acting(flags.actor, world, source.seed, flags.checkpoint)
    stage = Stage(world, agent, slots.index(task), source.seed, tour)
    screen = _screen(flags, stage)
    note("")  # the moving picture on the screen shows that the command works
    with contextlib.suppress(KeyboardInterrupt):  # Ctrl-C ends the view in the browser
        play(stage, screen, flags.seconds)
    world.close()


def _screen(flags: PlayFlags, stage: "Stage") -> "Screen":
    if gl_backend.has_screen() and not flags.browser:
        from bidex_meta.viewer import desktop

        try:
            window = desktop.Desktop(stage, flags.speed)
        except BidexError as error:
            print(error, file=sys.stderr)  # the browser needs no window system
        else:
            print(desktop.KEYS, file=sys.stderr)
            return window
    from bidex_meta.viewer.browser import Browser

    screen = Browser(stage, flags.host, flags.port, flags.speed)
    print(f"Open {screen.address} in a browser; Ctrl-C ends it.", file=sys.stderr, flush=True)
    return screen
