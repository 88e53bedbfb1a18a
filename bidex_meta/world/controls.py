"""Conversion of actions to controls of the hands."""

import torch
from torch import Tensor

from bidex_meta.hands.hand import FORCE_PER_SCALE, SIDES, TORQUE_PER_SCALE, hand
from bidex_meta.world.groups import Group


class Controls:
    """Writes actions into a group's engine: targets for the joints, forces and torques for the bases.

    An action begins with the right hand. Each hand has entries for 20 joints, 3 base translations and 3 base rotations,
    in this order (the paper's Tables 9 and 11). Hands with fixed bases have only the joints' entries.
    """

    def __init__(self, group: Group) -> None:
        engine = group.engine
        scene = group.members[0].scene
        self._engine = engine
        self._moving = scene.task.moving_base
        low, high = (engine.ctrl.new_tensor(x) for x in (hand().control_low, hand().control_high))
        self._middle = 0.5 * (high + low)
        self._half = 0.5 * (high - low)
        self._joints = len(low)
        self._bodies = scene.base_bodies
        self._wrench = engine.ctrl.new_empty(engine.num, 6)
        for member in group.members:
            task = member.scene.task
            self._wrench[member.engine_rows, :3] = FORCE_PER_SCALE * task.transition_scale
            self._wrench[member.engine_rows, 3:] = TORQUE_PER_SCALE * task.orientation_scale

    def write(self, action: Tensor) -> None:
        """Write actions into the engine: targets of joints, and force (N) and torque (N m) on moving bases.

        ``action`` (num, 52), or (num, 40) for fixed bases, is within [-1, 1] and finite. An entry a sets a joint's
        target, which has limits lo and hi, to lo + (a + 1)/2 (hi - lo). Force and torque are in the world frame.
        """
        action = action.to(self._engine.ctrl.dtype)
        share = action.shape[1] // len(SIDES)
        for side, body in enumerate(self._bodies):
            first = side * share
            targets = self._engine.ctrl[:, side * self._joints : (side + 1) * self._joints]
            torch.mul(action[:, first : first + self._joints], self._half, out=targets)
            targets += self._middle
            if self._moving:
                self._engine.xfrc_applied[:, body] = action[:, first + self._joints : first + share] * self._wrench
