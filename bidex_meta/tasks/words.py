"""Numbers of goals as text for instructions; rounding changes them by much less than any tolerance."""

import math


def centimetres(*metres: float) -> str:
    """Return a length, e.g. ``7.0 cm``, or a point in the world, e.g. ``(1.0, -79.0, 54.0) cm``."""
    numbers = ", ".join(f"{round(100.0 * each, 1) + 0.0:.1f}" for each in metres)  # + 0.0: no -0.0
    if len(metres) > 1:
        return f"({numbers}) cm"
    return f"{numbers} cm"


def degrees(radians: float) -> str:
    """Return an angle as a whole number of degrees, without the unit."""
    return str(round(math.degrees(radians)))
