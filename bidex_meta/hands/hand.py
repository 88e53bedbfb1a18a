"""Facts about one hand, read from its MJCF so that no figure stands twice."""

from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np

from bidex_meta import paths

FINGERS = ("ff", "mf", "rf", "lf", "th")
"""Fingers in the order of Table 7."""
CENTRE_OF_MASS = (0.0016, 0.0081, 0.2917)
"""The hand's centre of mass in the mount frame at zero pose, metres: where a moving base is driven
(docs/figures.md, base)."""
LINEAR_DAMPING = (501.0, 501.0, 501.0)
"""Damping of a moving base, N s/m: 5.011 kg times the original's 100 per second."""
ANGULAR_DAMPING = (2.60, 2.65, 1.12)
"""Damping of a moving base about its own axes, N m s/rad: the hand's inertia times 100 per second
(docs/figures.md, base)."""
FORCE_PER_SCALE = 100_000.0 / 60.0
"""Newton per unit of action and of a class's translation scale (docs/figures.md, base)."""
TORQUE_PER_SCALE = 1_000.0 / 60.0
"""Newton metre per unit of action and of a class's orientation scale."""
DISTAL_PER_MIDDLE = 0.00805 / 0.00705
"""Distal over middle joint angle when the coupling tendon is at rest (docs/figures.md, hand joints)."""


@dataclass(frozen=True)
class Hand:
    """Joint tables of the hand, each in the order of Table 7 (24 joints) or of the actions (20 actuated ones).

    Attributes:
        joints: Joint names, 24.
        low: Lower joint limits, rad, shape (24,).
        high: Upper joint limits, rad, shape (24,).
        actuated: Indices of the 20 actuated joints.
        control_low: Lower end of the position targets, rad, shape (20,).
        control_high: Upper end of the position targets, rad, shape (20,).
    """

    joints: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray
    actuated: np.ndarray
    control_low: np.ndarray
    control_high: np.ndarray

    def index(self, *names: str) -> list[int]:
        """Positions of the named joints among the 24."""
        return [self.joints.index(name) for name in names]


def hand_spec() -> mujoco.MjSpec:
    """A fresh, editable copy of the hand's MJCF."""
    return mujoco.MjSpec.from_file(str(paths.assets_dir() / "hands" / "shadow_hand.xml"))


@lru_cache(maxsize=1)
def hand() -> Hand:
    """The hand's joint tables, read once."""
    model = hand_spec().compile()
    low, high = model.jnt_range.T
    return Hand(
        joints=tuple(model.joint(j).name for j in range(model.njnt)),
        low=low.copy(),
        high=high.copy(),
        actuated=model.actuator_trnid[:, 0].copy(),
        control_low=model.actuator_ctrlrange[:, 0].copy(),
        control_high=model.actuator_ctrlrange[:, 1].copy(),
    )
