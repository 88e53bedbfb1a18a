"""Domain randomisation: the way in which a scene's model depends on random factors, such as that of friction.

Every number that depends on a factor is multiplied by a power of the factor. This includes the numbers that
``mj_setConst`` would compute, because calling ``mj_setConst`` would take as long as a step.
"""

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np
import torch
from torch import Tensor

from bidex_meta.errors import BidexError
from bidex_meta.hands.hand import SIDES
from bidex_meta.tasks.scene import Scene

Exponents = dict[str, dict[str, Tensor]]
"""Exponents by field of the model, then by factor: each number of the field is multiplied by the factor to this
power."""


def object_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Return a mask (nbody,), bool, of the bodies of objects, which follow the bodies of the hands."""
    names = [model.body(i).name for i in range(model.nbody)]
    return np.array([i > 0 and name.partition("/")[0] not in SIDES for i, name in enumerate(names)])


def _free(model: mujoco.MjModel) -> np.ndarray:
    """Return a mask (nbody,), bool, of the objects' bodies with a single, free joint and without child bodies."""
    parents = np.isin(np.arange(model.nbody), model.body_parentid)
    free = np.array(
        [n == 1 and model.jnt_type[a] == 0 for n, a in zip(model.body_jntnum, model.body_jntadr, strict=True)]
    )
    return object_bodies(model) & free & ~parents


def heights(scene: Scene) -> dict[int, float]:
    """Return the height of each free object's origin above the object's lowest point, metres.

    ``_free`` defines free objects; they are in the pose of the nominal start. The key of an object is the ``qpos``
    column of its z coordinate.
    """
    model = scene.model
    data = mujoco.MjData(scene.model)
    mujoco.mj_kinematics(model, data)
    centre = model.geom_aabb[:, :3, None]
    half = model.geom_aabb[:, 3:, None]
    turned = data.geom_xmat.reshape(-1, 3, 3)
    lowest = (data.geom_xpos[:, :, None] + turned @ centre - np.abs(turned) @ half)[:, 2, 0]
    found = {}
    for body in _free(model).nonzero()[0]:
        column = int(model.jnt_qposadr[model.body_jntadr[body]]) + 2
        found[column] = float(data.xpos[body, 2] - lowest[model.geom_bodyid == body].min())
    return found


def exponents(scene: Scene, varied: Sequence[str], device: torch.device) -> Exponents:
    """Return the exponents by which the model's fields depend on the randomised factors.

    A field (n, k) is multiplied by a factor to the power of the exponents, (n, 1) or (n, k). ``varied`` names the
    factors. Raises BidexError if the size of objects varies and an object has a mesh.
    """
    found: Exponents = {}
    for factor, name, exponent in _laws(scene.model):
        if factor in varied:
            found.setdefault(name, {})[factor] = torch.tensor(exponent, dtype=torch.float64, device=device)
    if "object_size" in varied and getattr(scene.task, "held", None) is not None:
        raise BidexError(
            f"randomisation: object_size: expected the egg, got {scene.task.name} with another object. Its "
            "height depends on how it lies. Leave object_size out."
        )
    if "object_size" in varied and (scene.model.geom_type[_free(scene.model)[scene.model.geom_bodyid]] == _MESH).any():
        raise BidexError(
            f"randomisation: object_size: expected simple shapes, got a mesh in {scene.task.name}. Leave it out."
        )
    return found


_MESH = int(mujoco.mjtGeom.mjGEOM_MESH)


def _laws(model: mujoco.MjModel) -> Iterator[tuple[str, str, np.ndarray]]:
    """Yield a factor, a field of the model, and the exponents by which the field depends on the factor.

    Factor and field are names; the exponents have the shape (n, 1) or (n, k). Size factors do not change masses.
    Inverse inertias depend on both size and mass.
    """
    objects = object_bodies(model)
    free = _free(model)
    of_object = objects[model.dof_bodyid]
    of_free = free[model.dof_bodyid]
    turning = of_free & (np.arange(model.nv) - model.jnt_dofadr[model.dof_jntid] >= 3)
    hinge = model.jnt_type[model.dof_jntid] == mujoco.mjtJoint.mjJNT_HINGE
    yield "friction", "geom_friction", np.ones((model.ngeom, 1))
    yield "friction", "pair_friction", np.ones((model.npair, 1))
    for name in ("body_mass", "body_inertia", "body_subtreemass"):
        yield "object_mass", name, (1.0 * objects)[:, None]
    yield "object_mass", "body_invweight0", (-1.0 * objects)[:, None]
    for name in ("dof_armature", "dof_M0"):  # C MuJoCo stores the inertia of bodies with simple frames here
        yield "object_mass", name, (1.0 * of_object)[:, None]
    yield "object_mass", "dof_invweight0", (-1.0 * of_object)[:, None]
    for name in ("geom_size", "geom_pos", "geom_rbound", "geom_aabb"):
        yield "object_size", name, (1.0 * free[model.geom_bodyid])[:, None]
    yield "object_size", "site_pos", (1.0 * free[model.site_bodyid])[:, None]
    yield "object_size", "body_ipos", (1.0 * free)[:, None]
    yield "object_size", "body_inertia", (2.0 * free)[:, None]
    yield "object_size", "body_invweight0", free[:, None] * np.array((0.0, -2.0))
    yield "object_size", "dof_M0", (2.0 * turning)[:, None]
    yield "object_size", "dof_invweight0", (-2.0 * turning)[:, None]
    yield "object_size", "bvh_aabb", (1.0 * _volumes(model, free))[:, None]
    yield "actuator_gain", "actuator_gainprm", np.ones((len(model.actuator_gainprm), 1))
    yield "actuator_gain", "actuator_biasprm", np.ones((len(model.actuator_gainprm), 1))
    yield "joint_damping", "dof_damping", (1.0 * (hinge & ~of_object))[:, None]
    yield "gravity", "body_gravcomp", (1.0 * objects)[:, None]


def _volumes(model: mujoco.MjModel, bodies: np.ndarray) -> np.ndarray:
    """Return which of the bounding volumes belong to the given bodies, bool."""
    found = np.zeros(int(model.body_bvhnum.sum()), dtype=bool)
    for body in bodies.nonzero()[0]:
        found[model.body_bvhadr[body] :][: model.body_bvhnum[body]] = True
    return found
