"""Comparison of compiled models: whether they may share a batch, and whether their trajectories are comparable."""

import hashlib
import inspect
from collections.abc import Mapping

import mujoco
import numpy as np

_PARTS = ("qpos", "body_", "jnt_", "dof_", "geom_", "site_", "actuator_", "eq_", "tendon_", "pair_")
_PARTS += ("exclude_", "sensor_")
_LOOKS = ("rgba", "matid", "group", "user", "plugin", "castshadow")


def model_identity(model: mujoco.MjModel) -> str:
    """Return a digest (12 hexadecimal digits) of a model's solver options and physical parameters.

    The digest covers bodies, joints, geoms, sites, actuators, equalities, tendons, contact pairs and sensors. Names,
    appearance and MuJoCo's version do not matter. Numbers are rounded to six digits, because MuJoCo's compiler may
    round slightly differently on different processors.
    """
    digest = hashlib.sha256()
    numbers = {name: value for name, value in _members(model).items() if name.startswith(_PARTS)}
    for owner in (_members(model.opt), {n: value for n, value in numbers.items() if not n.endswith(_LOOKS)}):
        for name, value in owner.items():
            if isinstance(value, int | float | np.ndarray | np.number):
                digest.update(name.encode() + _rounded(np.atleast_1d(np.asarray(value, np.float64))))
    return digest.hexdigest()[:12]


def common_identity(models: Mapping[str, mujoco.MjModel]) -> str:
    """Return one digest, 12 hexadecimal digits, of the names and the ``model_identity`` of several models."""
    texts = [f"{name} {model_identity(models[name])}" for name in sorted(models)]
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:12]


def _members(owner: object) -> dict[str, object]:
    """Return the attributes of an object by name, sorted."""
    return {name: value for name, value in inspect.getmembers(owner) if not name.startswith("_")}


def _rounded(values: np.ndarray) -> bytes:
    """Return the numbers rounded to six digits; numbers below 1e-12 become zero."""
    size = np.floor(np.log10(np.maximum(np.abs(values), 1e-12)))
    unit = 10.0 ** (size - 5)
    return (np.where(np.abs(values) < 1e-12, 0.0, np.round(values / unit)) + 0.0).tobytes() + size.tobytes()


# mujoco_warp 4.0 keeps these numbers per world (arrays of its Model with a first dimension "*"). The C engine takes a
# whole model per simulation and could vary more, but both engines must group models in the same way.
_PER_WORLD_FIELDS = """
    qpos0 qpos_spring
    body_pos body_quat body_ipos body_iquat body_mass body_subtreemass body_inertia body_invweight0 body_gravcomp
    jnt_solref jnt_solimp jnt_pos jnt_axis jnt_stiffness jnt_range jnt_actfrcrange jnt_margin
    dof_solref dof_solimp dof_frictionloss dof_armature dof_damping dof_invweight0
    geom_matid geom_solmix geom_solref geom_solimp geom_size geom_aabb geom_rbound geom_pos geom_quat geom_friction
    geom_margin geom_gap geom_rgba site_pos site_quat
    pair_solref pair_solreffriction pair_solimp pair_margin pair_gap pair_friction
    eq_solref eq_solimp eq_data
    tendon_solref_lim tendon_solimp_lim tendon_solref_fri tendon_solimp_fri tendon_range tendon_margin tendon_stiffness
    tendon_damping tendon_armature tendon_frictionloss tendon_lengthspring tendon_length0 tendon_invweight0
    actuator_gainprm actuator_biasprm actuator_dynprm actuator_forcerange actuator_ctrlrange actuator_gear actuator_acc0
    actuator_lengthrange
"""
_PER_WORLD = frozenset(_PER_WORLD_FIELDS.split())
# These fields are names, pictures, or numbers derived from the fields above.
_FREE_PREFIXES = ("name", "light_", "cam_", "mat_", "tex_", "vis", "bvh_", "site_rgba")
_FREE = frozenset(["names", "paths", "dof_M0", "dof_length", "stat"])


def differing_fields(a: mujoco.MjModel, b: mujoco.MjModel) -> list[str]:
    """Return the names of the array fields in which two models differ."""
    ours = _arrays(a)
    theirs = _arrays(b)
    return [n for n, x in ours.items() if not np.array_equal(x, theirs[n], equal_nan=x.dtype.kind == "f")]


def same_structure(a: mujoco.MjModel, b: mujoco.MjModel) -> bool:
    """Return whether two models can be simulated in one batch.

    They can if they differ only in fields that a batch keeps per simulation, numbers derived from these fields, names
    or appearance.
    """
    if _sizes(a) != _sizes(b):
        return False
    differing = differing_fields(a, b)
    return all(name in _PER_WORLD or name in _FREE or name.startswith(_FREE_PREFIXES) for name in differing)


def _arrays(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    return {name: value for name, value in _members(model).items() if isinstance(value, np.ndarray)}


def _sizes(model: mujoco.MjModel) -> Mapping[str, object]:
    # Lengths of texts and of picture assets do not affect the dynamics.
    free = ("nname", "ntex", "npath", "nmat", "nlight", "ncam", "nbuffer")
    sizes = {name: value for name, value in _members(model).items() if name.startswith("n") and isinstance(value, int)}
    counts = {name: value for name, value in sizes.items() if not name.startswith(free)}
    options = {n: v.tolist() if isinstance(v, np.ndarray) else v for n, v in _members(model.opt).items()}
    return counts | {name: value for name, value in options.items() if not callable(value)}
