"""A physics profile in twelve letters: what two models must have in common for their trajectories to be comparable."""

import hashlib
from collections.abc import Mapping

import mujoco
import numpy as np

_PARTS = (
    "qpos",
    "body_",
    "jnt_",
    "dof_",
    "geom_",
    "site_",
    "actuator_",
    "eq_",
    "tendon_",
    "pair_",
    "exclude_",
    "sensor_",
)
_LOOKS = ("rgba", "matid", "group", "user", "plugin", "castshadow")
_DIGITS = 6


def model_identity(model: mujoco.MjModel) -> str:
    """Twelve hexadecimal digits of all options of the solver and all numbers of bodies, joints, geoms and actuators.

    Names and looks do not enter, nor does MuJoCo's version. Numbers enter with six digits, so that a processor that
    rounds the compiler's sums otherwise gives the same.

    Args:
        model: A compiled scene.
    """
    digest = hashlib.sha256()
    for owner, names in ((model.opt, dir(model.opt)), (model, _names(model))):
        for name in names:
            value = None if name.startswith("_") else getattr(owner, name)
            if isinstance(value, int | float | np.ndarray | np.number):
                digest.update(name.encode() + _rounded(np.atleast_1d(np.asarray(value, np.float64))))
    return digest.hexdigest()[:12]


def common_identity(models: Mapping[str, mujoco.MjModel]) -> str:
    """The same of several models, by name."""
    texts = [f"{name} {model_identity(models[name])}" for name in sorted(models)]
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:12]


def _names(model: mujoco.MjModel) -> list[str]:
    return [name for name in dir(model) if name.startswith(_PARTS) and not name.endswith(_LOOKS)]


def _rounded(values: np.ndarray) -> bytes:
    """The numbers with six digits, what is smaller than 1e-12 as zero."""
    size = np.floor(np.log10(np.maximum(np.abs(values), 1e-12)))
    unit = 10.0 ** (size - _DIGITS + 1)
    return (np.where(np.abs(values) < 1e-12, 0.0, np.round(values / unit)) + 0.0).tobytes() + size.tobytes()
