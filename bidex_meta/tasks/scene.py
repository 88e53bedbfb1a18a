"""The compiled model of a task class, and the addresses that the world reads and writes."""

from copy import copy
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np

from bidex_meta.hands.hand import FIXTURE, OBJECT, SIDES, add_hands, damp_bases, hand, set_contact_bits
from bidex_meta.hands.looks import dress
from bidex_meta.tasks.state import unknown_sensor
from bidex_meta.utils import paths
from bidex_meta.utils.arguments import checked_arguments
from bidex_meta.utils.maths import quaternion_from_rpy
from bidex_meta.utils.validation import Fraction, NonNegative, Point, Text

if TYPE_CHECKING:
    from bidex_meta.tasks.base import TaskClass

Colour = tuple[Fraction, Fraction, Fraction, Fraction]
_STATED_TIME_STEP, _STATED_SOLREF = 1.0 / 240.0, 0.0084
"""Time step and contact time constant of the files under assets/, seconds."""
_FALL = 1.0 + 1e6
"""Gravity compensation that makes an object fall at 9.81 m/s², although the scene's gravity is a millionth of this and
points up."""


@checked_arguments
@dataclass(frozen=True)
class SceneObject:
    """An object of a scene: a free body, or a fixture whose place differs from task to task (a mocap body).

    Attributes:
        name: Prefix of the object's sensors and joints in the scene.
        asset: Name of a file under assets/objects/, or an absolute path, without the ending. The file's body is called
            ``object``; if the body is free, its joint is called ``free``.
        position: Nominal start position in the world, metres.
        rpy: Nominal roll, pitch and yaw, radians; R = Rz(yaw) Ry(pitch) Rx(roll).
        colour: Red, green, blue and alpha of the object's materials, or None to keep the colours in the file.
    """

    name: Text
    asset: Text
    position: Point
    rpy: Point = (0.0, 0.0, 0.0)
    colour: Colour | None = None

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """Return the nominal orientation (w, x, y, z)."""
        return quaternion_from_rpy(self.rpy)

    def add_to(self, scene: mujoco.MjSpec) -> None:
        """Add the object to a scene at its nominal start."""
        self.attach(scene, mujoco.MjSpec.from_file(str(paths.assets_dir() / "objects" / f"{self.asset}.xml")))

    def attach(self, scene: mujoco.MjSpec, part: mujoco.MjSpec) -> None:
        """Add ``part``, which has a body called ``object``, to a scene at the nominal start."""
        set_contact_bits(part.geoms, OBJECT)
        if self.colour is not None:
            for material in part.materials:
                material.rgba = self.colour
        part.body("object").pos = self.position
        part.body("object").quat = self.quaternion
        scene.attach(part, prefix=f"{self.name}/", frame=scene.worldbody.add_frame())


class Table(NamedTuple):
    """The table of a task.

    Attributes:
        size: Full edge lengths, metres.
        centre: The table's centre in the world, metres.
        friction: Sliding friction.
        priority: If above 0, the table's friction applies to its contacts; otherwise the larger friction of the pair.
    """

    size: Point
    centre: Point
    friction: float = 1.0
    priority: int = 0


@checked_arguments
def add_table(scene: mujoco.MjSpec, size: Point, centre: Point, friction: NonNegative = 1.0, priority: int = 0) -> None:
    """Add a fixed box, the table of a task; see ``Table``."""
    floor = scene.geom("floor")
    scene.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.5 * edge for edge in size],
        pos=centre,
        material="table",
        friction=[friction, 0.005, 0.001],
        priority=priority,
        **{"contype": floor.contype, "conaffinity": floor.conaffinity},
        **{"margin": floor.margin, "solref": floor.solref, "solimp": floor.solimp},
    )


@dataclass(frozen=True)
class Scene:
    """The compiled MuJoCo scene of a task class, with the positions of its quantities in MuJoCo's arrays.

    Attributes:
        task: The task class.
        model: The compiled model.
        sensors: Slice of each sensor in ``sensordata``, by the sensor's name.
        qpos: Slice of each part in a start position, by the part's name. A start position is MuJoCo's ``qpos`` followed
            by the poses of movable fixtures. Parts are ``right/base`` (7 numbers, moving bases only), ``right/joints``
            (24), the same for ``left``, each free object or movable fixture (7), and each joint of an object (1), e.g.
            ``bottle/slide``.
        base_bodies: Body ids of the right and the left base.
    """

    task: "TaskClass"
    model: mujoco.MjModel = field(repr=False)

    @cached_property
    def sensors(self) -> dict[str, slice]:
        m = self.model
        return {m.sensor(i).name: slice(a := m.sensor_adr[i], a + m.sensor_dim[i]) for i in range(m.nsensor)}

    def sensor(self, name: str) -> slice:
        """Return the slice of a sensor in ``sensordata``; raises BidexError if the scene has no such sensor."""
        if name not in self.sensors:
            raise unknown_sensor(name, self.sensors)
        return self.sensors[name]

    @cached_property
    def qpos(self) -> dict[str, slice]:
        found: dict[str, slice] = {}
        for side in SIDES:
            first = self.model.joint(f"{side}/{hand().joints[0]}").qposadr[0]
            found[f"{side}/joints"] = slice(first, first + len(hand().joints))
        for i in range(self.model.njnt):
            joint = self.model.joint(i)
            if joint.type[0] == mujoco.mjtJoint.mjJNT_FREE:
                part = joint.name.removesuffix("/free")
                if part in SIDES:
                    name = f"{part}/base"
                else:
                    name = part
                found[name] = slice(joint.qposadr[0], joint.qposadr[0] + 7)
            elif joint.name.partition("/")[0] not in SIDES:
                found[joint.name] = slice(joint.qposadr[0], joint.qposadr[0] + 1)
        for i, body in enumerate(self._mocap_bodies):
            first = self.model.nq + 7 * i
            found[self.model.body(body).name.removesuffix("/object")] = slice(first, first + 7)
        return found

    @cached_property
    def _mocap_bodies(self) -> list[int]:
        """Return the body ids of the movable fixtures, in the order of ``mocap_pos``."""
        place = self.model.body_mocapid
        return sorted((i for i in range(self.model.nbody) if place[i] >= 0), key=lambda i: place[i])

    @cached_property
    def dressed(self) -> mujoco.MjModel:
        """Return the model for pictures, in which skins cover the hands' colliding geoms.

        Its bodies and joints are those of ``model``.
        """
        return dressed_spec(self.task).compile()

    @cached_property
    def base_bodies(self) -> tuple[int, int]:
        right, left = (self.model.body(f"{side}/base").id for side in SIDES)
        return right, left

    @cached_property
    def start_qpos(self) -> np.ndarray:
        """Return the nominal start, with all hand joints at zero. Shape (nq + 7 nmocap,)."""
        fixtures = [np.concatenate((self.model.body_pos[i], self.model.body_quat[i])) for i in self._mocap_bodies]
        return np.concatenate((self.model.qpos0, *fixtures))


def build_spec(task: "TaskClass") -> mujoco.MjSpec:
    """Build the editable scene of a task class, with floor, hands and objects.

    As in the original, gravity acts on the objects but not on the hands.
    """
    spec = mujoco.MjSpec.from_file(str(paths.assets_dir() / "scene" / "scene.xml"))
    spec.modelname = task.name
    spec.option.iterations = task.solver.iterations
    spec.option.ls_iterations = task.solver.line_search
    spec.option.integrator = task.solver.integrator
    spec.option.timestep = task.solver.time_step
    spec.option.cone = task.solver.cone
    spec.option.impratio = task.solver.impratio
    set_contact_bits(spec.geoms, FIXTURE)
    add_hands(spec, task.right, task.left, task.moving_base, task.touch)
    task.add_objects(spec)
    # Compensating gravity on the hands' 52 bodies costs 8 % of a step. Instead, gravity is a millionth, and a few
    # objects have a compensation that is a million times as large; this costs nothing.
    for body in spec.bodies:
        if body.name != "world" and not body.name.startswith(("right/", "left/")):
            body.gravcomp = _FALL
    for geom in spec.geoms:
        geom.condim = min(geom.condim, task.solver.most_condim)
    return spec


def dressed_spec(task: "TaskClass") -> mujoco.MjSpec:
    """Build the editable scene of a task class for pictures, in which skins cover the hands' colliding geoms."""
    spec = build_spec(task)
    dress(spec)
    return spec


def compile_scene(task: "TaskClass") -> Scene:
    """Compile the scene of a task class."""
    model = build_spec(task).compile()
    damp_bases(model)
    # The assets have the stiffest contacts and limits that are stable at 1/240 s. A longer step needs softer ones.
    factor = model.opt.timestep / _STATED_TIME_STEP
    for solref in (model.geom_solref, model.pair_solref, model.jnt_solref, model.dof_solref, model.tendon_solref_lim):
        solref[np.isclose(solref[:, 0], _STATED_SOLREF), 0] *= factor
    return Scene(task, model)


def compile_without_touch(task: "TaskClass") -> mujoco.MjModel:
    """Compile the scene of a task class without touch sensors, which do not change the physics."""
    bare = copy(task)
    bare.touch = False
    return compile_scene(bare).model
