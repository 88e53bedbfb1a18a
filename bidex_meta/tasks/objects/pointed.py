"""Users' objects for classes whose hands must reach points such as handles.

The user's file gives these points the names that they have in the file of the class's usual object.
"""

import hashlib
from collections.abc import Hashable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

import mujoco
import numpy as np
import torch

from bidex_meta.engine.capacity import Capacity
from bidex_meta.errors import BidexError, shortened
from bidex_meta.tasks.objects.mjcf import (
    check_centres,
    check_collisions,
    check_pose,
    colliding,
    compiled,
    outline,
    read_own,
    set_contacts,
)
from bidex_meta.tasks.reach import ReachTask
from bidex_meta.tasks.scene import SceneObject, compile_scene
from bidex_meta.utils import paths
from bidex_meta.utils.files import absolute

_MOST_MASS, _LARGEST, _MOST_GEOMS = 10.0, 0.6, 64
"""Limits of an object: mass, kg; size of the box around it, metres; number of colliding geoms."""
_LEVEL = 0.003
"""Largest height difference between the feet of an object and of the usual object, metres: the object must start at
rest on the table."""
_DEEPEST = 0.005
"""Deepest penetration of hands or table at the start, metres, as for every class (docs/figures.md)."""


@dataclass(frozen=True)
class PointedObject(SceneObject):
    """An object from a user's MJCF file.

    ``asset`` is the path of the file. ``digest`` is a hash of the compiled model, so it changes when the model changes.
    """

    digest: str = ""

    def add_to(self, scene: mujoco.MjSpec) -> None:
        part = read_own(Path(self.asset), points=True)
        set_contacts(part)
        self.attach(scene, part)


class OwnObjectClass(ReachTask):
    """A class whose object may be replaced by a user's object with the same sensors and joints.

    ``usual_stands`` says whether the class's own object stands on its foot at the start.
    """

    usual_stands: ClassVar[bool] = True

    def __init__(self, moving_base: bool | None = None, object: str | None = None) -> None:
        """Create the class with its usual object, or with an object from a user's MJCF file.

        ``object`` is the path of the file (docs/objects.md); None takes the usual object. ``moving_base`` says whether
        the hands' bases move; None takes the class's default. Raises BidexError if the file does not meet the rules of
        docs/objects.md, or if the object starts inside the hands or the table.
        """
        super().__init__(moving_base)
        (usual,) = self.objects
        self.own = usual
        if object is None:
            return
        if not isinstance(object, str) or not object.endswith(".xml") or not object.isprintable():
            raise BidexError(
                f"object: expected the path of an MJCF file (.xml) that takes the place of the {usual.asset}, "
                f"got {shortened(object)}."
            )
        file = absolute(object)
        model = _checked(usual, file, self.usual_stands)
        buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        digest = hashlib.blake2b(buffer.tobytes(), digest_size=16).hexdigest()
        self.own = PointedObject(usual.name, str(file), usual.position, usual.rpy, usual.colour, digest)
        self.objects = (self.own,)
        more = 4 * max(0, colliding(model) - colliding(_usual_model(usual)))
        self.needs = Capacity(self.needs.contacts + more, self.needs.convex + more, self.needs.rows + 3 * more)
        depth, other = _depth_at_start(self)
        if depth > _DEEPEST:
            raise BidexError(
                f"{file}: expected an object that starts clear of hands and table, got one {1000 * depth:.0f} mm deep "
                f"in {other}. Make it smaller, or shift the geoms."
            )

    @property
    def scene_key(self) -> tuple[Hashable, ...]:
        return (*super().scene_key, self.own)


def _checked(usual: SceneObject, file: Path, stands: bool) -> mujoco.MjModel:
    spec = read_own(file, points=True)
    like = _usual_model(usual)
    if spec.body("object") is None:
        raise BidexError(f'{file}: expected a body called "object", got none. Name the outermost one so.')
    model = compiled(file, spec)
    for kind in ("joint", "sensor"):
        wanted = _named(like, kind)
        found = _named(model, kind)
        if wanted != found:
            missing = sorted(set(wanted) ^ set(found)) or list(wanted)
            raise BidexError(
                f"{file}: expected the {kind}s of assets/objects/{usual.asset}.xml in their order "
                f"({', '.join(wanted)}); look at {', '.join(missing)}. See docs/objects.md."
            )
    check_pose(file, model, model.body("object").id)
    check_collisions(file, model, _MOST_GEOMS)
    mass = float(model.body_mass.sum())
    low, high = _box(model)
    if not 0.0 < mass <= _MOST_MASS:
        raise BidexError(f"{file}: expected at most {_MOST_MASS:g} kg, got {mass:.4g}. Fix mass or density.")
    if (high - low).max() > _LARGEST:
        raise BidexError(f"{file}: expected at most {_LARGEST:g} m, got {(high - low).max():.4g}. Scale it.")
    check_centres(file, _centres_of_mass(model), low, high)
    foot = _box(like)[0][2]
    if stands and abs(low[2] - foot) > _LEVEL:
        raise BidexError(
            f"{file}: expected its lowest point {-foot:.4f} m below its origin, as the {usual.asset}'s, so that it "
            f"stands at the start; got {-low[2]:.4f}. Shift the geoms."
        )
    return model


def _depth_at_start(task: OwnObjectClass) -> tuple[float, str]:
    """Return the object's deepest penetration at the nominal start, metres, and the name of the penetrated body."""
    scene = compile_scene(task)
    start = torch.from_numpy(scene.start_qpos)[None].clone()
    space = task.variation_space
    middle = 0.5 * (torch.tensor([space.low]) + torch.tensor([space.high]))
    views = {name: start[:, columns] for name, columns in scene.qpos.items()}
    task.start(torch.zeros(1, task.start_draws, dtype=start.dtype), task.frozen(middle.to(start)), views)
    model = scene.model
    data = mujoco.MjData(scene.model)
    data.qpos[:] = start[0, : model.nq].numpy()
    mujoco.mj_forward(model, data)
    deepest = 0.0
    met = ""
    for contact in data.contact:
        owners = [model.body(int(model.geom_bodyid[geom])) for geom in contact.geom]
        own = [body.name.startswith(f"{task.own.name}/") for body in owners]
        if own[0] != own[1] and -contact.dist > deepest:
            deepest = -float(contact.dist)
            met = owners[own[0]].name
    return deepest, "the table" if met == "world" else met


@lru_cache(maxsize=8)
def _usual_model(usual: SceneObject) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(paths.assets_dir() / "objects" / f"{usual.asset}.xml"))


def _named(model: mujoco.MjModel, kind: str) -> dict[str, int]:
    """Return the types of all joints by name, or the sizes of all sensors by name.

    ``kind`` is ``"joint"`` or ``"sensor"``.
    """
    if kind == "joint":
        return {model.joint(i).name: int(model.jnt_type[i]) for i in range(model.njnt)}
    return {model.sensor(i).name: int(model.sensor_dim[i]) for i in range(model.nsensor)}


def _centres_of_mass(model: mujoco.MjModel) -> np.ndarray:
    """Return the centres of mass (n, 3) of the bodies that have mass, relative to ``object``'s origin, metres."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data.xipos[model.body_mass > 0.0] - data.body("object").xpos


def _box(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the box around all colliding geoms, relative to the body ``object``'s origin, metres."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    lows = []
    highs = []
    for body in range(1, model.nbody):
        centres, radii = outline(model, body)
        if len(centres):
            centres = centres @ data.xmat[body].reshape(3, 3).T + data.xpos[body] - data.body("object").xpos
            lows.append((centres - radii[:, None]).min(axis=0))
            highs.append((centres + radii[:, None]).max(axis=0))
    return np.min(lows, axis=0), np.max(highs, axis=0)
