"""Objects that replace the egg in the throwing classes, from a user's MJCF file or from the shelf.

The shelf is the folder assets/objects/shelf of the package.
"""

import math
import os
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np
import torch
from torch import Tensor

from bidex_meta.engine.capacity import Capacity
from bidex_meta.errors import BidexError, known_name, shortened
from bidex_meta.hands.poses import PALM_UP_AWAY, HandPose
from bidex_meta.hands.starts import make_room_for
from bidex_meta.tasks.objects.mjcf import (
    check_centres,
    check_collisions,
    check_pose,
    compiled,
    extents,
    outline,
    read_own,
    set_contacts,
)
from bidex_meta.tasks.scene import Colour, Point, SceneObject
from bidex_meta.utils import paths
from bidex_meta.utils.files import expanded
from bidex_meta.utils.maths import conjugate, constant, multiply, rotate, wxyz, xyzw

EGG = "egg"
_LONGEST, _SHORTEST = 0.25, 0.01
"""Bounds of the longest edge of the box around an object, metres. A hand is 20 cm long from the wrist to the middle
fingertip."""
_PALM_UP = HandPose((0.0, 0.0, 0.0), PALM_UP_AWAY)


@dataclass(frozen=True)
class HeldObject:
    """An object that can lie on a hand instead of an egg.

    The mass is in kg. Lengths are in metres, in the object's frame.

    Attributes:
        low: Lower corner of the box around the object's colliding geoms; ``high``: upper corner of the box.
        geoms: Number of colliding geoms.
        centres: Centres (k, 3) of balls whose convex hull contains the colliding geoms.
        radii: Radii (k,) of these balls.
    """

    name: str
    file: Path
    mass: float
    low: Point
    high: Point
    geoms: int
    centres: np.ndarray = field(repr=False, compare=False)
    radii: np.ndarray = field(repr=False, compare=False)

    @property
    def half_extents(self) -> Point:
        """Return how far the object extends from its origin along each axis, in the farther direction, metres."""
        x, y, z = (max(-low, high) for low, high in zip(self.low, self.high, strict=True))
        return x, y, z

    def add_to(self, scene: mujoco.MjSpec, name: str, position: Point, colour: Colour | None = None) -> None:
        """Add the object to a scene as a free body.

        ``name``, ``position`` (the nominal start in the world, metres) and ``colour`` are the fields of
        ``SceneObject``.
        """
        part = read_own(self.file)
        body = part.worldbody.first_body()
        body.name = "object"
        for joint in body.joints:
            part.delete(joint)
        body.add_freejoint(name="free")
        set_contacts(part)
        for geom in part.geoms:
            geom.condim = 3
        kinds = {"position": "POS", "quaternion": "QUAT", "linear_velocity": "LINVEL", "angular_velocity": "ANGVEL"}
        for sensor, kind in kinds.items():
            of = mujoco.mjtSensor.__members__[f"mjSENS_FRAME{kind}"]
            part.add_sensor(name=sensor, type=of, objtype=mujoco.mjtObj.mjOBJ_XBODY, objname="object")
        SceneObject(name, self.name, position, colour=colour).attach(scene, part)

    def needs(self, egg: Capacity, count: int = 1) -> Capacity:
        """Return the contact buffer sizes that a class needs if it has ``count`` of these objects instead of eggs.

        ``egg`` holds the sizes that the class needs with eggs.
        """
        # A flat face meets its support in four points, and each geom may meet palm and fingers at the same time.
        more = count * (8 + 4 * self.geoms)
        return Capacity(egg.contacts + 2 * more, egg.convex + more, egg.rows + 6 * more)

    def turn(self, place: Tensor, draws: Tensor, pose: HandPose | None = None) -> None:
        """Lay the object on a broad side, and turn it about the palm's normal at random.

        The object's shortest side is then along the palm's normal. The orientations in the object's poses ``place``
        (n, 7), quaternion (w, x, y, z), are changed in place. ``draws`` (n, 2) in [-1, 1] select the angle, and which
        of the two broad sides faces down. ``pose`` is the hand's start pose; without it the palm is assumed to be
        level.
        """
        palm = xyzw(constant((pose or _PALM_UP).quaternion, place))
        half = 0.5 * math.pi * draws[:, 0]
        zero = torch.zeros_like(draws[:, 0])
        about_normal = torch.stack((zero, half.sin(), zero, half.cos()), dim=1)
        over = (draws[:, 1] < 0.0).to(place)
        turned_over = torch.stack((zero, zero, over, 1.0 - over), dim=1)
        laid = multiply(turned_over, constant(self._laid, place).expand(len(place), 4))
        place[:, 3:] = wxyz(multiply(palm.expand(len(place), 4), multiply(about_normal, laid)))

    @property
    def _laid(self) -> tuple[float, float, float, float]:
        """Return the rotation (x, y, z, w) that lays the object on a broad side in the hand's frame.

        It turns the longest side to the z axis, and the shortest side to the y axis, which is the palm's normal.
        """
        shortest, middle, longest = np.argsort(np.subtract(self.high, self.low), kind="stable")
        turn = np.zeros((3, 3))
        turn[0, middle] = turn[1, shortest] = turn[2, longest] = 1.0
        turn[0] *= np.linalg.det(turn)
        found = np.zeros(4)
        mujoco.mju_mat2Quat(found, turn.ravel())
        w, x, y, z = map(float, found)
        return x, y, z, w

    def lay_on_hand(self, place: Tensor, joints: Tensor, pose: HandPose) -> None:
        """Lift the object off the palm, open the fingers that would penetrate it and lay the thumb flat.

        The object's poses (n, 7) and the joint angles (n, 24) of the hand, which starts at ``pose``, are written in
        place.
        """
        quaternion = xyzw(constant(pose.quaternion, place))
        inverse = conjugate(quaternion)
        position = rotate(inverse, place[:, :3] - constant(pose.position, place))
        orientation = multiply(inverse.expand(len(place), 4), xyzw(place[:, 3:]))
        centres, radii = self._balls(place)
        points = rotate(orientation[:, None], centres[None])
        opened, shift = make_room_for(joints, position, points, radii)
        joints.copy_(opened.float())
        place[:, :3] += rotate(quaternion, shift).float()

    def depth_below(self, place: Tensor) -> Tensor:
        """Return the object's extent below its origin, metres, for poses (n, 7). Shape (n,)."""
        centres, radii = self._balls(place)
        points = rotate(xyzw(place[:, 3:])[:, None], centres[None])
        return (radii - points[..., 2]).amax(dim=1)

    def _balls(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Return ``centres`` and ``radii`` as tensors, which are copied to the device of ``like`` only once."""
        return constant(tuple(map(tuple, self.centres.tolist())), like), constant(tuple(self.radii.tolist()), like)


def shelf() -> list[str]:
    """Return the sorted names of the objects on the shelf, without the egg."""
    return sorted(path.stem for path in (paths.assets_dir() / "objects" / "shelf").glob("*.xml"))


def held_object(name: object) -> HeldObject | None:
    """Return the object that replaces the egg, or None if ``name`` is ``"egg"``.

    ``name`` is the name of an object in the package, in any case, or the path of an MJCF file, which ends in ``.xml``.
    Raises BidexError for an unknown name, or for a file without an object that a hand can hold.
    """
    if not isinstance(name, str) or not name.isprintable():
        raise BidexError(f"object: expected a name or the path of an .xml file, got {shortened(name)}.")
    if name.endswith(".xml"):
        file = expanded(name)
    else:
        found = known_name("object", name, [EGG, *shelf()])
        if found == EGG:
            return None
        file = paths.assets_dir() / "objects" / "shelf" / f"{found}.xml"
    try:
        state = os.stat(file)
    except (OSError, ValueError):
        return _loaded(file, (0, 0))  # raises BidexError with the reason
    return _loaded(file.resolve(), (state.st_mtime_ns, state.st_size))


@lru_cache(maxsize=64)
def _loaded(file: Path, _state: tuple[int, int]) -> HeldObject:
    spec = read_own(file)
    bodies = [body for body in spec.bodies if body.name != "world"]
    if len(bodies) != 1:
        raise BidexError(f"{file}: expected one <body> with geoms, got {len(bodies)}. Put all geoms into one body.")
    joints = [joint for joint in spec.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE]
    if joints:
        raise BidexError(
            f"{file}: expected a body without joints, got {joints[0].name or 'one'}. Remove joints; the object "
            "moves freely without them."
        )
    if list(spec.worldbody.geoms):
        raise BidexError(f"{file}: expected geoms inside the body, got some outside. Move them into the body.")
    if (spec.body("object") or bodies[0]) is not bodies[0] or not list(bodies[0].geoms):
        raise BidexError(f"{file}: expected a <body> with geoms, got none. Add its shape.")
    model = compiled(file, spec)
    check_pose(file, model, 1)
    collide = check_collisions(file, model, 32)
    centres, radii = outline(model, 1)
    low, high = extents(model, 1)
    _check_figures(file, model, low, high)
    corners = tuple(map(float, low)), tuple(map(float, high))
    return HeldObject(file.stem, file, float(model.body_mass[1]), *corners, collide, centres, radii)  # type: ignore[arg-type]


def _check_figures(file: Path, model: mujoco.MjModel, low: np.ndarray, high: np.ndarray) -> None:
    # The mass is limited to 2 kg, because a hand weighs 5 kg.
    mass = float(model.body_mass[1])
    longest = float((high - low).max())
    least = 0.002
    most = 2.0
    if not least <= mass <= most:
        raise BidexError(f"{file}: expected a mass of {least:g} to {most:g} kg, got {mass:.4g}. Fix mass or density.")
    if not _SHORTEST <= longest <= _LONGEST:
        raise BidexError(
            f"{file}: expected an object of {100 * _SHORTEST:g} to {100 * _LONGEST:g} cm on its longest side, which "
            f"fits a hand, got {100 * longest:.4g} cm. Scale it (MJCF is in metres)."
        )
    if (low > 0.0).any() or (high < 0.0).any():
        raise BidexError(f"{file}: expected the body's origin inside its shape, got it outside. Shift the geoms.")
    check_centres(file, model.body_ipos[1:], low, high)
    if (far := max(-low.min(), high.max())) > 0.5 * _LONGEST:
        raise BidexError(
            f"{file}: expected the body's origin at most {50 * _LONGEST:g} cm from its ends, got {100 * far:.4g}. "
            "Shift the geoms."
        )
