"""Puts two hands into a scene: prefixes, contact bits, fixed or moving base."""

import mujoco
import numpy as np

from bidex_meta.hands.hand import ANGULAR_DAMPING, CENTRE_OF_MASS, LINEAR_DAMPING, hand_spec
from bidex_meta.hands.poses import HandPose

SIDES = ("right", "left")
"""Both hands are the same right-hand model; the order is that of every table."""

RIGHT, LEFT, OBJECT, FIXTURE, INNER = 1, 2, 4, 8, 16
"""Contact bits. Geoms of one hand never meet by bits (its 18 listed pairs do); every other two kinds do,
save fixtures among themselves. INNER is what an object's file calls a geom that no table can meet before another of the
object does, so that tables need not look for it."""
_COLLIDES = {
    RIGHT: 0,
    LEFT: RIGHT,
    OBJECT: RIGHT | LEFT | OBJECT,
    FIXTURE: RIGHT | LEFT | OBJECT,
    INNER: RIGHT | LEFT | OBJECT | INNER,
}
_TIP_COLOUR = {"right": (0.20, 0.45, 0.75, 1.0), "left": (0.80, 0.32, 0.22, 1.0)}


def set_contact_bits(geoms: "list[mujoco.MjsGeom]", kind: int) -> None:
    """Gives geoms the bits of RIGHT, LEFT, OBJECT or FIXTURE; INNER ones stay what they are."""
    for geom in geoms:
        if geom.contype == 0:  # there to be seen only
            continue
        own = INNER if geom.contype == INNER else kind
        geom.contype, geom.conaffinity = own, _COLLIDES[own]


def add_hands(scene: mujoco.MjSpec, right: HandPose, left: HandPose, moving: bool) -> None:
    """Adds both hands to a scene.

    Args:
        scene: The scene; bodies, joints and sensors get the prefixes ``right/`` and ``left/``.
        right: Start pose of the right hand's mount.
        left: Start pose of the left hand's mount.
        moving: Whether the base is a free joint at the centre of mass (damped by ``damp_bases``) or welded.
    """
    for side, pose, bit in zip(SIDES, (right, left), (RIGHT, LEFT), strict=True):
        part = hand_spec()
        part.material("tip").rgba = _TIP_COLOUR[side]
        set_contact_bits(part.geoms, bit)
        base = part.body("base")
        base.pos, base.quat = base_position(pose), pose.quaternion
        if moving:
            base.add_freejoint(name="free")
        scene.attach(part, prefix=f"{side}/", frame=scene.worldbody.add_frame())


def damp_bases(model: mujoco.MjModel) -> None:
    """Damps the free joints of moving bases: MJCF has one figure for all six axes, the hand needs three inertias'."""
    for side in SIDES:
        joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, f"{side}/free")
        if joint >= 0:
            first = model.jnt_dofadr[joint]
            model.dof_damping[first : first + 6] = LINEAR_DAMPING + ANGULAR_DAMPING


def base_position(pose: HandPose) -> np.ndarray:
    """World position of the base frame, which lies at the hand's centre of mass, metres, shape (3,)."""
    offset = np.zeros(3)
    mujoco.mju_rotVecQuat(offset, np.array(CENTRE_OF_MASS), np.array(pose.quaternion))
    return np.array(pose.position) + offset
