"""What the tasks with tables, doors and tools share: the distance from a hand to the point it shall be at."""

from torch import Tensor

from bidex_meta.tasks.state import TaskState
from bidex_meta.utils.maths import norm


def reach(state: TaskState, side: str, point: str) -> Tensor:
    """Distance (m) from a hand to a point, shape (n,).

    The hand's point is the palm's origin + 8 cm along the fingers + 2 cm out of the palm (docs/figures.md, hand point).

    Args:
        state: A transition.
        side: ``right`` or ``left``.
        point: Sensor of the point's position.
    """
    return state.once(("reach", side, point), lambda: norm(state[f"{side}/hand_point_position"] - state[point]))


def apart(state: TaskState, a: str, b: str) -> Tensor:
    """Distance (m) between the positions that two sensors give, shape (n,)."""
    return state.once(("apart", a, b), lambda: norm(state[a] - state[b]))
