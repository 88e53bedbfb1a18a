"""From a task class to a compiled model, and the addresses in it that the world reads and writes."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from bidex_meta import paths
from bidex_meta.hands.hand import hand
from bidex_meta.hands.pair import FIXTURE, OBJECT, SIDES, add_hands, damp_bases, set_contact_bits

if TYPE_CHECKING:
    from bidex_meta.tasks.base import TaskClass


@dataclass(frozen=True)
class FreeObject:
    """A free body of a scene.

    Attributes:
        name: Prefix of its sensors and joints in the scene.
        asset: File under assets/objects/ without its ending; its body is called ``object``, its joint ``free``.
        position: Nominal start in the world, metres.
        colour: Red, green, blue, alpha of its material, or None to keep the asset's.
    """

    name: str
    asset: str
    position: tuple[float, float, float]
    colour: tuple[float, float, float, float] | None = None

    def add_to(self, scene: mujoco.MjSpec) -> None:
        """Puts the object into a scene at its nominal start."""
        part = mujoco.MjSpec.from_file(str(paths.assets_dir() / "objects" / f"{self.asset}.xml"))
        set_contact_bits(part.geoms, OBJECT)
        if self.colour is not None:
            for material in part.materials:
                material.rgba = self.colour
        part.body("object").pos = self.position
        scene.attach(part, prefix=f"{self.name}/", frame=scene.worldbody.add_frame())


@dataclass(frozen=True)
class Scene:
    """A compiled scene with its addresses.

    Attributes:
        task: The class whose scene it is.
        model: The compiled model.
        sensors: Sensor name to its slice of ``sensordata``.
        qpos: ``right/base`` (7, moving only), ``right/joints`` (24), ``left/...`` and each object (7) to its slice.
        base_bodies: Body ids of the two bases, right and left.
    """

    task: "TaskClass"
    model: mujoco.MjModel = field(repr=False)

    @cached_property
    def sensors(self) -> dict[str, slice]:
        """Sensor name to its slice of ``sensordata``."""
        m = self.model
        return {
            m.sensor(i).name: slice(a, a + n) for i, (a, n) in enumerate(zip(m.sensor_adr, m.sensor_dim, strict=True))
        }

    @cached_property
    def qpos(self) -> dict[str, slice]:
        """Name of a part to its slice of ``qpos``."""
        found: dict[str, slice] = {}
        for side in SIDES:
            first = self.model.joint(f"{side}/{hand().joints[0]}").qposadr[0]
            found[f"{side}/joints"] = slice(first, first + len(hand().joints))
        for i in range(self.model.njnt):
            joint = self.model.joint(i)
            if joint.type[0] == mujoco.mjtJoint.mjJNT_FREE:
                part = joint.name.removesuffix("/free")
                name = f"{part}/base" if part in SIDES else part
                found[name] = slice(joint.qposadr[0], joint.qposadr[0] + 7)
        return found

    @cached_property
    def base_bodies(self) -> tuple[int, int]:
        """Body ids of the two bases, right and left."""
        right, left = (self.model.body(f"{side}/base").id for side in SIDES)
        return right, left

    @cached_property
    def start_qpos(self) -> np.ndarray:
        """Positions at the nominal start, all hand joints zero. Shape (nq,)."""
        return self.model.qpos0.copy()


def build_spec(task: "TaskClass") -> mujoco.MjSpec:
    """The editable scene of a task class: floor, hands, objects."""
    spec = mujoco.MjSpec.from_file(str(paths.assets_dir() / "scene" / "scene.xml"))
    spec.modelname = task.name
    set_contact_bits(spec.geoms, FIXTURE)
    add_hands(spec, task.right, task.left, task.moving_base)
    task.add_objects(spec)
    return spec


def compile_scene(task: "TaskClass") -> Scene:
    """The compiled scene of a task class."""
    model = build_spec(task).compile()
    damp_bases(model)
    return Scene(task, model)
