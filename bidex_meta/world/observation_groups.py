"""The named groups of a world's observation, from the layouts of its classes."""

from collections.abc import Sequence
from itertools import groupby

from bidex_meta.hands.hand import SIDES
from bidex_meta.tasks.layout import Layout, hand_blocks
from bidex_meta.world.contract import ObservationGroup

_HAND_OF = {block.name: f"{side}_hand" for side in SIDES for block in hand_blocks(side, moving=True)}
"""By name and not by prefix: ``right_handle_position`` is of an object."""


def observation_groups(
    layouts: Sequence[Layout],
    width: int,
    num_id_columns: int,
    hidden: Sequence[Sequence[int]] | None = None,
    points: tuple[str, int] | None = None,
) -> tuple[ObservationGroup, ...]:
    """Groups that hold for rows of all these classes.

    Args:
        layouts: Of the world's slots.
        width: Entries of an observation before the task id, at least those of each layout.
        num_id_columns: Entries of the task id.
        hidden: Entries of each layout that are zero, as padding is.
        points: Name and entries of the cloud between the padded observation and the task id.

    Returns:
        In the order of their first entries. An entry that is of one kind in some classes and of another one in others
        is in ``task``.
    """
    hidden = [()] * len(layouts) if hidden is None else hidden
    by_class = zip(*(_kinds(layout, width, zero) for layout, zero in zip(layouts, hidden, strict=True)), strict=True)
    kinds = [kinds[0] if len(set(kinds)) == 1 else "task" for kinds in by_class]
    if points is not None:
        kinds += [points[0]] * points[1]
    kinds += ["task_id"] * num_id_columns
    ranges: dict[str, list[slice]] = {}
    for kind, run in groupby(range(len(kinds)), key=kinds.__getitem__):
        entries = list(run)
        ranges.setdefault(kind, []).append(slice(entries[0], entries[-1] + 1))
    return tuple(ObservationGroup(kind, tuple(where)) for kind, where in ranges.items())


def _kinds(layout: Layout, width: int, hidden: Sequence[int]) -> list[str]:
    """The group of each entry of one class's padded observation; hidden ones are padding."""
    kinds = ["padding"] * width
    for block, where in layout:
        kinds[where] = [_HAND_OF.get(block.name, "goal" if block.goal else "object")] * block.size
    for i in hidden:
        kinds[i] = "padding"
    return kinds
