"""``bidex-meta demo``: show the policy that comes with bidex-meta."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidex_meta.cli import play_live, render
from bidex_meta.cli.parsing import parse
from bidex_meta.utils import gl_backend, paths
from bidex_meta.utils.waiting import tell

FILM = ["--tiled", "--steps", "160", "--every", "8", "--width", "160"]
"""Flags of ``render`` for a film of 2.5 seconds of every class, which one core draws in about 90 seconds."""


@dataclass(frozen=True)
class DemoFlags:
    """Show the policy that comes with bidex-meta in the twenty classes of MT20-v2.

    Example: bidex-meta demo --out demo.webp

    With a screen, this command is the same as bidex-meta play. Without one, or with --out, it writes a film.
    """

    out: Path | None = None
    """File to write: .webp, .mp4 or .png. None: show the policy on the screen, or write bidex-meta-demo.webp if there
    is no screen."""


def main(arguments: Sequence[str]) -> None:
    """Play the shipped policy, or film it if there is no screen."""
    flags = parse(DemoFlags, arguments, "demo")
    if flags.out is None and gl_backend.has_screen():
        play_live.main([])
        return
    out = flags.out or Path("bidex-meta-demo.webp")
    tell(f"Drawing the film {out}, which takes about two minutes without a GPU.")
    render.main([str(paths.shipped_policy()), *FILM, "--out", str(out.absolute())])
