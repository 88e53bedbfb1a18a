"""Numbers of goals in the words of an instruction, rounded to much less than any tolerance."""

import math


def centimetres(*metres: float) -> str:
    """Return a length, or a point in the world as ``(1.0, -79.0, 54.0) cm``."""
    numbers = ", ".join(f"{round(100.0 * each, 1) + 0.0:.1f}" for each in metres)  # adding 0.0 turns -0.0 into 0.0
    if len(metres) > 1:
        return f"({numbers}) cm"
    return f"{numbers} cm"


def degrees(radians: float) -> str:
    """Return an angle as a whole number of degrees, without the unit."""
    return str(round(math.degrees(radians)))
