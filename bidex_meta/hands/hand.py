"""The hand's joint tables, read from its MJCF, and the pair of hands in a scene."""

from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np

from bidex_meta.hands.poses import HandPose
from bidex_meta.utils import paths

FINGERS = ("ff", "mf", "rf", "lf", "th")
"""Fingers in the order of Table 7."""
CENTRE_OF_MASS = (0.0016, 0.0081, 0.2917)
"""The hand's centre of mass in the mount frame at zero pose, metres: the point at which a moving base is driven
(docs/figures.md, base)."""
LINEAR_DAMPING, ANGULAR_DAMPING = (501.0, 501.0, 501.0), (2.60, 2.65, 1.12)
"""Linear damping of a moving base, N s/m, and angular damping about the base's axes, N m s/rad: the hand's mass of
5.011 kg and its inertia, times the original's 100 per second (docs/figures.md, base)."""
FORCE_PER_SCALE, TORQUE_PER_SCALE = 100_000.0 / 60.0, 1_000.0 / 60.0
"""Force (N) of an action of 1 at a translation scale of 1, and torque (N m) of an action of 1 at an orientation scale
of 1 (docs/figures.md, base)."""
TOUCHED = (*(f"{finger}distal" for finger in FINGERS), "palm", "lfmetacarpal")
"""Bodies with touch sensors: fingertips, palm, and the little finger's metacarpal, which is the palm's outer edge."""
DISTAL_PER_MIDDLE = 0.00805 / 0.00705
"""Ratio of the distal to the middle joint angle when the coupling tendon is at rest (docs/figures.md, hand joints)."""


@dataclass(frozen=True)
class Hand:
    """Names and limits (rad) of the hand's 24 joints, in the order of the observation (the paper's Table 7).

    The object also has the indices of the 20 actuated joints, and the limits of their position targets, rad.
    """

    joints: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray
    actuated: np.ndarray
    control_low: np.ndarray
    control_high: np.ndarray

    def index(self, *names: str) -> list[int]:
        """Return the positions of the named joints among the 24."""
        return [self.joints.index(name) for name in names]


def hand_spec() -> mujoco.MjSpec:
    """Return a new, editable copy of the hand's MJCF."""
    return mujoco.MjSpec.from_file(str(paths.assets_dir() / "hands" / "shadow_hand.xml"))


@lru_cache(maxsize=1)
def hand() -> Hand:
    """Return the hand's joint tables, read once."""
    model = hand_spec().compile()
    low, high = model.jnt_range.T
    return Hand(
        tuple(model.joint(j).name for j in range(model.njnt)),
        low.copy(),
        high.copy(),
        model.actuator_trnid[:, 0].copy(),
        *model.actuator_ctrlrange.T.copy(),
    )


SIDES = ("right", "left")
"""The hands, in the order that every table has. Both hands use the same model of a right hand."""

RIGHT, LEFT, OBJECT, FIXTURE, INNER = 1, 2, 4, 8, 16
"""Contact bits. Geoms of one hand never collide by bits, but only in the 18 listed pairs. Fixtures do not collide with
each other. All other kinds collide. An object's file marks a geom INNER if a table always touches another geom of the
object first, so that tables need not test it."""
_ALL = RIGHT | LEFT | OBJECT
_COLLIDES = {RIGHT: 0, LEFT: RIGHT, OBJECT: _ALL, FIXTURE: _ALL, INNER: _ALL | INNER}
_TOUCH_RADIUS = 0.12
"""Radius of a touch sensor's site, which is centred at the body's origin, metres; the palm reaches 0.1 m."""
_TIP_COLOUR = {"right": (0.20, 0.45, 0.75, 1.0), "left": (0.80, 0.32, 0.22, 1.0)}


def set_contact_bits(geoms: "list[mujoco.MjsGeom]", kind: int) -> None:
    """Set MuJoCo's contact bits of geoms, which decide what collides, to those of RIGHT, LEFT, OBJECT or FIXTURE.

    Geoms that are marked INNER keep their bits, and geoms without ``contype`` remain visual.
    """
    for geom in geoms:
        if geom.contype:  # geoms without a contype are only visual
            own = INNER if geom.contype == INNER else kind
            geom.contype = own
            geom.conaffinity = _COLLIDES[own]


def add_hands(scene: mujoco.MjSpec, right: HandPose, left: HandPose, moving: bool, touch: bool = False) -> None:
    """Add both hands with the start poses of their mounts; names get the prefixes ``right/`` and ``left/``.

    Moving bases are free joints at the centre of mass (damped by ``damp_bases``); fixed bases are welded. With
    ``touch`` the bodies of ``TOUCHED`` get sensors, e.g. ``right/palm_touch``.
    """
    for side, pose, bit in zip(SIDES, (right, left), (RIGHT, LEFT), strict=True):
        part = hand_spec()
        part.material("tip").rgba = _TIP_COLOUR[side]
        set_contact_bits(part.geoms, bit)
        base = part.body("base")
        base.pos = base_position(pose)
        base.quat = pose.quaternion
        if moving:
            base.add_freejoint(name="free")
        if touch:
            _add_touch(part)
        scene.attach(part, prefix=f"{side}/", frame=scene.worldbody.add_frame())


def _add_touch(part: mujoco.MjSpec) -> None:
    for body in TOUCHED:
        # A touch sensor reads only contacts of its own body within its site, so the site encloses the whole body.
        site = part.body(body).add_site(name=f"{body}_touch", size=[_TOUCH_RADIUS] * 3, group=4)
        part.add_sensor(
            name=site.name, type=mujoco.mjtSensor.mjSENS_TOUCH, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site.name
        )


def damp_bases(model: mujoco.MjModel) -> None:
    """Damp the free joints of moving bases: MJCF has one value for all six axes, but the inertias differ."""
    for side in SIDES:
        joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, f"{side}/free")
        if joint >= 0:
            first = model.jnt_dofadr[joint]
            model.dof_damping[first : first + 6] = LINEAR_DAMPING + ANGULAR_DAMPING


def base_position(pose: HandPose) -> np.ndarray:
    """Return the world position of the base frame, which lies at the hand's centre of mass, metres, shape (3,)."""
    offset = np.zeros(3)
    mujoco.mju_rotVecQuat(offset, np.array(CENTRE_OF_MASS), np.array(pose.quaternion))
    return np.array(pose.position) + offset
