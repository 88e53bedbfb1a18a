"""Gymnasium's access to attributes of vector environments, for one object that is all environments at once."""

from typing import Any

from torch import Tensor

from bidex_meta.world.numpy_form import NumpyWorld


class RowAttributes:
    """``get_attr``, ``set_attr``, ``call`` and ``to_numpy`` of a batched world.

    Attributes:
        num_envs: Rows.
        task_id: Slot of each row, shape (num_envs,), int64.
        task_names: Names of the slots.
    """

    num_envs: int
    task_id: Tensor
    task_names: list[str]

    @property
    def task_name(self) -> list[str]:
        """Slot name of each row."""
        return [self.task_names[i] for i in self.task_id.tolist()]

    def to_numpy(self, stagger: bool = False) -> NumpyWorld:
        """This world in NumPy arrays, as Gymnasium's vector wrappers expect one; ``stagger`` as there."""
        world: Any = self
        return NumpyWorld(world, stagger)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """An attribute for each row: its own entry of a per-row attribute, else the world's value."""
        value = getattr(self, name)
        per_row = name == "task_name" or (isinstance(value, Tensor) and value.shape[:1] == (self.num_envs,))
        return tuple(value) if per_row else (value,) * self.num_envs

    def set_attr(self, name: str, values: Any) -> None:
        """Sets an attribute of the world."""
        setattr(self, name, values)

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Calls a method of the world (or reads an attribute) and returns the result for each row."""
        value = getattr(self, name)
        if not callable(value):
            return self.get_attr(name)
        return (value(*args, **kwargs),) * self.num_envs
