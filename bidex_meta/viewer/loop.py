"""The clock of a live view."""

import time
from typing import Protocol

from bidex_meta.tasks.base import CONTROL_RATE
from bidex_meta.viewer.playback import Stage

_PICTURES = 30
"""A second at most: more would only delay the browser."""


class Screen(Protocol):
    """Where it is shown.

    Attributes:
        paused: Whether time stands still.
        speed: Of the clock, 1 as in the world.
    """

    paused: bool
    speed: float

    def is_open(self) -> bool:
        """Whether somebody may still look."""
        ...

    def obey(self, stage: Stage) -> None:
        """Does to the stage what was asked for since the last time."""
        ...

    def show(self, stage: Stage) -> None:
        """Shows its present state."""
        ...

    def close(self) -> None:
        """Ends the view."""
        ...


def play(stage: Stage, screen: Screen, seconds: float | None = None) -> None:
    """Plays until the view is closed, or for so many seconds; control steps as fast as in the world, or slower."""
    began = shown = due = time.monotonic()
    screen.show(stage)
    try:
        while screen.is_open() and (seconds is None or time.monotonic() - began < seconds):
            screen.obey(stage)
            if not screen.paused:
                stage.step()
            now = time.monotonic()
            if now - shown >= 0.9 / _PICTURES:  # a step that comes a little early counts
                shown = now
                screen.show(stage)
            # What is late is not made up for: the view would race after each pause.
            due = max(due + 1.0 / (CONTROL_RATE * screen.speed), now)
            time.sleep(due - now)
    finally:
        screen.close()
