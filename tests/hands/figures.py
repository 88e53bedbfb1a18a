"""Tables of the original's hand and start poses (docs/figures.md), typed apart: what the model is held against."""

import numpy as np
from scipy.spatial.transform import Rotation

# joint, low, high (rad), damping, armature, actuated, kp, effort limit (N m); the order of Table 7.
JOINTS = [
    ("WRJ1", -0.489, 0.14, 0.5, 0.005, True, 5.0, 4.785),
    ("WRJ0", -0.698, 0.489, 0.5, 0.005, True, 5.0, 2.175),
    *(
        (f"{finger}J{i}", *figures)
        for finger in ("FF", "MF", "RF", "LF")
        for i, figures in (
            (4, (0.0, 0.785, 0.1, 0.001, True, 1.0, 0.9)),
            (3, (-0.349, 0.349, 0.1, 0.001, True, 1.0, 0.9)),
            (2, (0.0, 1.571, 0.1, 0.001, True, 1.0, 0.9)),
            (1, (0.0, 1.571, 0.1, 0.001, True, 1.0, 0.7245)),
            (0, (0.0, 1.571, 0.1, 0.001, False, 0.0, 0.0)),
        )
        if i < 4 or finger == "LF"
    ),
    ("THJ4", -1.047, 1.047, 0.1, 0.001, True, 1.0, 2.3722),
    ("THJ3", 0.0, 1.222, 0.1, 0.001, True, 1.0, 1.45),
    ("THJ2", -0.209, 0.209, 0.1, 0.001, True, 1.0, 0.99),
    ("THJ1", -0.524, 0.524, 0.1, 0.001, True, 1.0, 0.99),
    ("THJ0", -1.571, 0.0, 0.1, 0.001, True, 1.0, 0.81),
]
NAMES = [joint[0] for joint in JOINTS]
LOW = np.array([joint[1] for joint in JOINTS])
HIGH = np.array([joint[2] for joint in JOINTS])
ACTUATED = [0, 1, 2, 3, 4, 6, 7, 8, 10, 11, 12, 14, 15, 16, 17, 19, 20, 21, 22, 23]

# Geoms of one hand that may meet; all others of the same hand pass through each other.
_PAIRS = """
thdistal-ffdistal thdistal-ffmiddle thdistal-ffproximal thdistal-mfproximal thdistal-mfdistal thdistal-rfdistal
thdistal-lfdistal thdistal-palm0 mfdistal-ffdistal rfdistal-mfdistal lfdistal-rfdistal mfproximal-ffproximal
rfproximal-mfproximal lfproximal-rfproximal lfdistal-mfdistal lfdistal-rfmiddle lfmiddle-rfdistal lfmiddle-rfmiddle
"""
PAIRS = {frozenset(pair.split("-")) for pair in _PAIRS.split()}

# Collision geoms but the forearm's, a mesh there: position in the body, size, condim; capsules (radius, half length)
# along the body's z (the wrist's along its y), boxes by half sizes.
GEOMS = {
    "wrist": ((0, 0, 0), (0.015, 0.01), 3),
    "palm0": ((0.011, 0, 0.038), (0.032, 0.0111, 0.049), 3),
    "palm1": ((-0.032, 0, 0.014), (0.011, 0.0111, 0.025), 3),
    "lfmetacarpal": ((-0.0165, 0, 0.01), (0.0095, 0.0111, 0.025), 3),
    "thproximal": ((0, 0, 0.019), (0.013, 0.019), 3),
    "thmiddle": ((0, 0, 0.016), (0.011, 0.016), 3),
    "thdistal": ((0, 0, 0.013), (0.00918, 0.013), 4),
} | {
    f"{finger}{link}": ((0, 0, height), (radius, height), condim)
    for finger in ("ff", "mf", "rf", "lf")
    for link, height, radius, condim in (
        ("proximal", 0.0225, 0.01, 3),
        ("middle", 0.0125, 0.00805, 3),
        ("distal", 0.012, 0.00705, 4),
    )
}

TIPS = ("ffdistal", "mfdistal", "rfdistal", "lfdistal", "thdistal")

# Actor at the origin, unrotated; metres, world.
ZERO_POSE = {
    "forearm": (0.0, 0.0, -0.01),
    "wrist": (0.0, -0.256, -0.01),
    "palm": (0.0, -0.29, -0.01),
    "hand_point": (0.0, -0.37, 0.01),
    "ffdistal": (-0.033, -0.475, -0.01),
    "mfdistal": (-0.011, -0.479, -0.01),
    "rfdistal": (0.011, -0.475, -0.01),
    "lfdistal": (0.034, -0.468, -0.01),
    "thdistal": (-0.0976, -0.3827, -0.001),
}
"""Fingers: reward fingertip points, the distal origin and 2 cm along its z."""

# Start poses: actor roll, pitch, yaw and the mount's world quaternion (w, x, y, z); then per class.
MOUNTS = {
    "A": ((0, 0, 0), (0, 0, -0.7071, 0.7071)),
    "B": ((0, 0, np.pi), (0.7071, -0.7071, 0, 0)),
    "C": ((np.pi, 1.57, 1.57), (0.7071, 0, -0.7071, -0.0006)),
    "D": ((np.pi, -1.57, 1.57), (0, 0.7071, -0.0006, -0.7071)),
    "E": ((np.pi, 0, 1.57), (0.4998, 0.4998, -0.5002, -0.5002)),
    "F": ((np.pi, 0, 3.14), (0.7071, 0.7071, -0.0006, -0.0006)),
    "G": ((np.pi, 0, 0), (0, 0, -0.7071, -0.7071)),
}
_A, _B, _C, _D, _E, _F, _G = (MOUNTS[pose][1] for pose in "ABCDEFG")
_DOORS = (((0.55, 0.2, 0.6), _C), ((0.55, -0.2, 0.6), _D))
_PALMS_DOWN = (((0.55, 0.2, 0.8), _E), ((0.55, -0.2, 0.8), _E))
# class: mount position and quaternion (w, x, y, z), right then left.
CLASS_MOUNTS = {
    "HandOver": (((0, 0, 0.5), _A), ((0, -1, 0.5), _B)),
    "CatchUnderarm": (((0, 0, 0.5), _A), ((0, -1.15, 0.5), _B)),
    "CatchOver2Underarm": (((0, 0, 0.5), (0.9988, -0.0496, -0.0008, 0)), ((0, -0.8, 0.5), _B)),
    "TwoCatchUnderarm": (((0, 0, 0.5), _A), ((0, -1.15, 0.5), _B)),
    "CatchAbreast": (
        ((0, -0.55, 0.5), (0.5877, -0.3927, -0.5881, 0.3931)),
        ((0, -1.15, 0.5), (0.3927, -0.5877, -0.3931, 0.5881)),
    ),
    "LiftUnderarm": (((0, 0.05, 0.45), _A), ((0, -1.25, 0.45), _B)),
    "DoorOpenOutward": _DOORS,
    "DoorOpenInward": _DOORS,
    "DoorCloseOutward": _DOORS,
    "DoorCloseInward": (((0.9, 0.5, 0.6), _C), ((0.9, -0.5, 0.6), _D)),
    # The original's two poses, exchanged (docs/figures.md, decisions): the left hand is the one over the cap.
    "BottleCap": (
        ((0, -0.25, 0.45), (0.298, 0.298, -0.6413, 0.6413)),
        ((0, -1.05, 0.5), (0, 0, 0.5102, 0.8601)),
    ),
    "PushBlock": _PALMS_DOWN,
    "SwingCup": (((0.35, 0.2, 0.8), _C), ((0.35, -0.2, 0.8), _D)),
    "OpenScissors": _PALMS_DOWN,
    "ReOrientation": (((0, 0, 0.5), _A), ((0, -1.15, 0.5), _B)),
    "OpenPenCap": _PALMS_DOWN,
    "Switch": _PALMS_DOWN,
    "StackBlock": (((0, 0.6, 0.7), _F), ((0, -0.6, 0.7), _G)),
    "PourWater": (((0.55, 0.2, 0.6), _C), ((0.55, -0.2, 0.6), _D)),
    "GraspAndPlace": _PALMS_DOWN,
}
# class: transition and orientation scale.
SCALES = dict.fromkeys(CLASS_MOUNTS, (0.5, 0.1)) | {
    **dict.fromkeys(("HandOver", "CatchUnderarm", "TwoCatchUnderarm", "ReOrientation"), (0.05, 0.5)),
    **dict.fromkeys((name for name in CLASS_MOUNTS if name.startswith("Door")), (0.5, 0.5)),
    **{"CatchOver2Underarm": (0.1, 2.0), "CatchAbreast": (0.5, 1.0), "LiftUnderarm": (0.25, 1.0)},
    **{"BottleCap": (0.1, 0.1), "SwingCup": (0.1, 0.1), "StackBlock": (0.2, 0.02)},
}
# class: start angles of the joints that do not start at zero, both hands.
DEFAULT_JOINTS = {"BottleCap": {"THJ4": -1.04, "THJ3": 1.2, "THJ0": -1.57}}


def rotation(wxyz: np.ndarray | tuple[float, ...]) -> Rotation:
    """A rotation from MuJoCo's (w, x, y, z)."""
    return Rotation.from_quat(np.asarray(wxyz, dtype=float), scalar_first=True)


def same_orientation(a: np.ndarray | tuple[float, ...], b: np.ndarray | tuple[float, ...], tolerance: float) -> bool:
    """Whether two quaternions agree entry by entry, up to their common sign."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    return bool(min(np.abs(a - b).max(), np.abs(a + b).max()) <= tolerance)
