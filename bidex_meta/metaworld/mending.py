"""Meta-World 3.0.0 on MuJoCo 4: its environments can be made again."""

from typing import Any

import mujoco
import numpy as np

_WELD = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 5.0)


def mended() -> Any:
    """Meta-World's module, its environments mended in this process.

    Meta-World 3.0.0 (its newest release without an upper bound on MuJoCo) sets the hand's weld by eleven numbers for
    the whole row of ``eq_data``; since MuJoCo 3.17 that row is twelve wide, so no environment could be made. Here the
    eleven go to the first eleven places, as they were meant; the twelfth keeps what the model was compiled with.

    Raises:
        ModuleNotFoundError: It, or what it needs, is not installed.
    """
    import metaworld
    from metaworld.sawyer_xyz_env import SawyerMocapBase

    SawyerMocapBase.reset_mocap_welds = _reset_mocap_welds
    return metaworld


def _reset_mocap_welds(self: Any) -> None:
    welds = np.flatnonzero(self.model.eq_type == mujoco.mjtEq.mjEQ_WELD)
    self.model.eq_data[welds, : len(_WELD)] = _WELD
