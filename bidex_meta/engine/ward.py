"""Finds broken worlds of the Warp engine and keeps them from harm: launches alone, for its graphs."""

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from bidex_meta.engine import kernels
from bidex_meta.engine.health import LARGEST, LONGEST, SHORTEST, quaternion_columns


class Ward:
    """Which worlds are broken, and the kernels that look at all of them. Nothing here waits for the device.

    Attributes:
        failed: Which worlds broke since their last reset, shape (num,), bool.
    """

    def __init__(self, model: mujoco.MjModel, data: mjw.Data) -> None:
        """Allocates on the current device; ``keep`` must follow before the first step.

        Args:
            model: A model of the structure that all worlds share.
            data: The worlds.
        """
        self.failed = wp.zeros(data.nworld, dtype=bool)
        self._quaternions = wp.array(quaternion_columns(model)[::4].astype(np.int32), dtype=int)
        self._fixtures = [wp.clone(data.mocap_pos), wp.clone(data.mocap_quat)]

    def keep(self, data: mjw.Data) -> None:
        """Remembers where the fixtures of all worlds stand; broken worlds get theirs back there."""
        for kept, now in zip(self._fixtures, (data.mocap_pos, data.mocap_quat), strict=True):
            wp.copy(kept, now)

    def examine(self, d: mjw.Data) -> None:
        """Before a control step: marks worlds that were broken by hand where no substep would, and disarms them."""
        applied = [d.ctrl, d.qfrc_applied, d.xfrc_applied]
        width = max(array.shape[1] for array in applied)
        fixtures = d.mocap_pos.shape[1]
        wp.launch(
            kernels.examine,
            dim=(d.nworld, width),
            inputs=[d.time, d.qacc_warmstart, *applied, float(mujoco.mjMAXVAL)],
            outputs=[self.failed],
            device=self.failed.device,
        )
        wp.launch(
            kernels.examine_poses,
            dim=(d.nworld, max(self._quaternions.shape[0], fixtures)),
            inputs=[d.qpos, self._quaternions, d.mocap_pos, d.mocap_quat, LARGEST, SHORTEST, LONGEST],
            outputs=[self.failed],
            device=self.failed.device,
        )
        wp.launch(
            kernels.disarm,
            dim=(d.nworld, max(width, fixtures)),
            inputs=[self.failed, *self._fixtures],
            outputs=[d.time, *applied, d.mocap_pos, d.mocap_quat],
            device=self.failed.device,
        )

    def watch(self, m: mjw.Model, d: mjw.Data) -> None:
        """Marks worlds with a bad number (mj_checkPos, mj_checkVel, mj_checkAcc) and puts all marked ones at rest at
        the reference pose.
        """  # noqa: D205
        wp.launch(
            kernels.watch,
            dim=d.qpos.shape,
            inputs=[d.qpos, d.qvel, d.qacc, LARGEST, float(mujoco.mjMAXVAL)],
            outputs=[self.failed],
            device=self.failed.device,
        )
        wp.launch(
            kernels.quarantine,
            dim=d.qpos.shape,
            inputs=[self.failed, m.qpos0],
            outputs=[d.qpos, d.qvel, d.qacc_warmstart],
            device=self.failed.device,
        )
