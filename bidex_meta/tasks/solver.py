"""Settings of the contact solver that a task class may choose."""

from dataclasses import dataclass, replace
from typing import Literal

import mujoco

from bidex_meta.errors import BidexError
from bidex_meta.rules import CONTROL_RATE
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.validation import Count, Positive


@checked_arguments
@dataclass(frozen=True)
class Solver:
    """Settings of MuJoCo's contact solver for one task class.

    bidex_meta/hands/README.md describes the settings that are the same for all classes.

    Attributes:
        iterations: Maximum number of Newton iterations.
        line_search: Maximum number of steps of each line search.
        integrator: MuJoCo's integration method.
        cone: Shape of the friction cones. An elliptic cone is exact. A pyramid takes 25 to 33 % less time and lets
            objects slip a little.
        impratio: Stiffness of friction relative to the normal force; a higher ratio makes held objects creep less.
        time_step: Length of a physics step, seconds; a whole number of physics steps must make a control step. Contacts
            and joint limits are as stiff as this time step allows.
        most_condim: Largest dimension of a contact. 4 includes torsional friction, which eggs and fingertips have; 3
            does not.
    """

    iterations: Count = 10
    line_search: Count = 20
    integrator: mujoco.mjtIntegrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    cone: mujoco.mjtCone = mujoco.mjtCone.mjCONE_ELLIPTIC
    impratio: Positive = 10.0
    time_step: Positive = 1.0 / 120.0
    most_condim: Literal[1, 3, 4, 6] = 4

    def __post_init__(self) -> None:
        steps = 1.0 / (CONTROL_RATE * self.time_step)
        if abs(steps - max(round(steps), 1)) > 1e-6:
            raise BidexError(
                f"Solver: time_step: expected a whole number of them to a control step of 1/{CONTROL_RATE} s, got "
                f"{self.time_step}. Write 1 / 120, 1 / 180 or 1 / 240."
            )


LIGHT = Solver(cone=mujoco.mjtCone.mjCONE_PYRAMIDAL, impratio=3.0, time_step=1.0 / 180.0, most_condim=3)
"""For eggs. Hands hold an egg for only a second, so that it may creep by a millimetre per second."""
GENTLE = replace(LIGHT, time_step=1.0 / 120.0)
"""For an egg that is thrown across a narrow gap, where nothing moves fast."""
FIRM = Solver(100, 50)
"""For light bodies between hands and table. With the default iterations the solver would stop early and kick them."""
FAST = Solver(100, 50, time_step=1.0 / 180.0)
"""For fast bases near rigid objects. In a time step of 1/120 s a hand at full speed sinks 24 mm into a table."""
THIN = Solver(100, 50, time_step=1.0 / 240.0)
"""For fast bases that press objects as thin as a finger against a table."""
