"""From actions in [-1, 1] to position targets and base forces."""

import torch
from torch import Tensor

from bidex_meta.hands.hand import FORCE_PER_SCALE, SIDES, TORQUE_PER_SCALE, hand
from bidex_meta.world.groups import Group


def clean(action: Tensor) -> tuple[Tensor, Tensor]:
    """Clips actions to [-1, 1].

    Returns:
        The actions with non-finite numbers replaced by 0, shape (n, a), and which rows held one, shape (n,), bool.
    """
    # Zero times a number is zero unless it is infinite or none.
    broken = (0.0 * action).sum(dim=1) != 0.0
    return action.nan_to_num(0.0, 0.0, 0.0).clamp_(-1.0, 1.0), broken


class Controls:
    """Writes actions into a group's engine. The action order is the appendix's: per hand 20 joints, 3 base
    translations, 3 base rotations; the right hand first (Tables 9 and 11).
    """  # noqa: D205

    def __init__(self, group: Group) -> None:
        """Reads ranges, bodies and scales of the group's classes."""
        engine, scene = group.engine, group.members[0].scene
        self._engine, self._moving = engine, scene.task.moving_base
        low, high = (engine.ctrl.new_tensor(x) for x in (hand().control_low, hand().control_high))
        self._middle, self._half = 0.5 * (high + low), 0.5 * (high - low)
        self._joints = len(low)
        self._bodies = scene.base_bodies
        self._wrench = engine.ctrl.new_empty(engine.num, 6)
        for member in group.members:
            task = member.scene.task
            self._wrench[member.engine_rows, :3] = FORCE_PER_SCALE * task.transition_scale
            self._wrench[member.engine_rows, 3:] = TORQUE_PER_SCALE * task.orientation_scale

    def write(self, action: Tensor) -> None:
        """Sets targets lo + (a + 1)/2 (hi - lo), and force (N) and torque (N m) at the bases, in the world frame.

        Args:
            action: Clean actions of the group's rows, shape (num, 52 or 40).
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
