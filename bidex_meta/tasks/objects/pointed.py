"""Own objects for classes that reach for points of theirs, handles or a cap: the file names them as the usual one."""

from collections.abc import Hashable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import mujoco
import numpy as np

from bidex_meta import paths
from bidex_meta.errors import BidexError, shortened
from bidex_meta.reading import expanded
from bidex_meta.tasks.base import TaskClass
from bidex_meta.tasks.objects.outline import outline
from bidex_meta.tasks.objects.own_file import compiled, read_own, set_contacts
from bidex_meta.tasks.scene import SceneObject, attach

_MOST_MASS, _LARGEST = 10.0, 0.6
"""kg, and metres of the box around it: what stands on a table between two hands."""
_LEVEL = 0.003
"""How far its foot may lie from the usual one's, metres: it starts at rest on the table."""


@dataclass(frozen=True)
class PointedObject(SceneObject):
    """An object of the user's in the place of a usual one; ``asset`` is the path of its file."""

    def add_to(self, scene: mujoco.MjSpec) -> None:
        """As in ``SceneObject``."""
        part = read_own(Path(self.asset), points=True)
        set_contacts(part)
        attach(scene, part, self.name, self.position, self.quaternion, self.colour)


class OwnObjectClass(TaskClass):
    """A class whose object may be the user's.

    Attributes:
        usual: Its own object, whose sensors and joints, by name, the reward and the observation read.
    """

    usual: ClassVar[SceneObject]

    def __init__(self, moving_base: bool | None = None, object: str | None = None) -> None:
        """Chooses base and object.

        Args:
            moving_base: Drive the bases or fix them; None takes the class's own.
            object: Path of an MJCF file (docs/objects.md); None takes the class's own.

        Raises:
            BidexError: The file holds no such object.
        """
        super().__init__(moving_base)
        self.own = self.usual if object is None else _checked(self.usual, object)

    @property
    def scene_key(self) -> tuple[Hashable, ...]:
        """As in ``TaskClass``, and the object."""
        return (*super().scene_key, self.own)


def _checked(usual: SceneObject, given: object) -> PointedObject:
    if not isinstance(given, str) or not given.endswith(".xml"):
        told = f"the path of an MJCF file that takes the place of the {usual.asset}"
        raise BidexError(f"object: expected {told}, which ends in .xml; got {shortened(given)}.")
    file = expanded(given).resolve()
    spec = read_own(file, points=True)
    like = mujoco.MjModel.from_xml_path(str(paths.assets_dir() / "objects" / f"{usual.asset}.xml"))
    if spec.body("object") is None:
        raise BidexError(f'{file}: expected a body called "object", got none. Name the outermost one so.')
    model = compiled(file, spec)
    for kind, wanted, found in (
        ("joint", _joints(like), _joints(model)),
        ("sensor", _sensors(like), _sensors(model)),
    ):
        if wanted != found:
            missing = sorted(set(wanted) - set(found)) or sorted(set(found) - set(wanted)) or list(wanted)
            told = f"the {kind}s of assets/objects/{usual.asset}.xml in their order ({', '.join(wanted)})"
            raise BidexError(f"{file}: expected {told}; look at {', '.join(missing)}. See docs/objects.md.")
    mass, (low, high) = float(model.body_mass.sum()), _box(model)
    if not 0.0 < mass <= _MOST_MASS:
        raise BidexError(f"{file}: expected at most {_MOST_MASS:g} kg, got {mass:.4g}. Mend mass or density.")
    if (high - low).max() > _LARGEST:
        raise BidexError(f"{file}: expected at most {_LARGEST:g} m, got {(high - low).max():.4g}. Scale it.")
    foot = _box(like)[0][2]
    if abs(low[2] - foot) > _LEVEL:
        told = (
            f"its lowest point {-foot:.4f} m below its origin, as the {usual.asset}'s, so that it stands at the start"
        )
        raise BidexError(f"{file}: expected {told}; got {-low[2]:.4f}. Shift what is in the body.")
    plain = replace(usual, asset=str(file))
    return PointedObject(plain.name, plain.asset, plain.position, plain.rpy, plain.colour)


def _joints(model: mujoco.MjModel) -> dict[str, int]:
    """Names and kinds."""
    return {model.joint(i).name: int(model.jnt_type[i]) for i in range(model.njnt)}


def _sensors(model: mujoco.MjModel) -> dict[str, int]:
    """Names and sizes."""
    return {model.sensor(i).name: int(model.sensor_dim[i]) for i in range(model.nsensor)}


def _box(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box around all that collides, from the origin of the body ``object``, metres."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    lows, highs = [], []
    for body in range(1, model.nbody):
        centres, radii = outline(model, body)
        if len(centres):
            centres = centres @ data.xmat[body].reshape(3, 3).T + data.xpos[body] - data.body("object").xpos
            lows.append((centres - radii[:, None]).min(axis=0))
            highs.append((centres + radii[:, None]).max(axis=0))
    if not lows:
        raise BidexError("object: expected geoms that collide, got none. Leave contype out.")
    return np.min(lows, axis=0), np.max(highs, axis=0)
