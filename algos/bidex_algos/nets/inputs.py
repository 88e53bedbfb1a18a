"""The inputs of a network: the named groups of an observation, each unchanged or passed through its own encoder."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from typing import Any

import torch
from torch import Tensor, nn

from bidex_meta.errors import unknown_name
from bidex_meta.world.contract import ObservationGroup, plain_groups


class Columns(nn.Module):
    """Selects some columns of tensors (..., d), in ascending order, for reading or writing.

    The module adds nothing to checkpoints.
    """

    def __init__(self, ranges: Iterable[slice]):
        super().__init__()
        index = sorted(chain.from_iterable(range(part.start, part.stop) for part in ranges))
        self.size = len(index)
        first = index[0] if index else 0
        # A slice is a view, but columns with gaps must be copied.
        if index == list(range(first, first + self.size)):
            self.range = slice(first, first + self.size)
        else:
            self.range = None
        self.index: Tensor
        self.register_buffer("index", torch.tensor(index, dtype=torch.int64), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Return the columns (..., size) of ``x`` (..., d); a view if the columns are adjacent."""
        if self.range is None:
            return x.index_select(-1, self.index)
        return x[..., self.range]

    def write(self, x: Tensor, values: Tensor) -> None:
        """Write ``values`` (..., size) into the columns of ``x`` (..., d)."""
        x[..., self.index if self.range is None else self.range] = values


MakeEncoder = Callable[[int, torch.Generator], nn.Module]
"""Makes an encoder for a group, given the group's number of entries and a CPU generator for the weights. The encoder is
a module that maps (..., entries) to (..., ``size``) and has the attribute ``size``."""


@dataclass(frozen=True)
class Inputs:
    """Describes how networks read an observation, before weights exist; raises ``BidexError`` for a missing group.

    A network reads a group unchanged, or through its encoder in ``encoders``; it does not read groups in ``hidden``.
    Groups in ``unscaled`` are not normalised.
    """

    groups: tuple[ObservationGroup, ...]
    encoders: Mapping[str, MakeEncoder] = field(default_factory=dict)
    hidden: frozenset[str] = frozenset()
    unscaled: frozenset[str] = frozenset({"task_id"})

    def __post_init__(self) -> None:
        self.columns(*self.encoders)

    @classmethod
    def of(cls, inputs: "int | Inputs") -> "Inputs":
        """Return ``inputs``; an integer becomes a single group with this number of columns."""
        if isinstance(inputs, int):
            return cls(plain_groups(inputs, 0))
        return inputs

    @property
    def width(self) -> int:
        """Return d, the number of columns of the observation."""
        return sum(group.size for group in self.groups)

    def columns(self, *names: str) -> Columns:
        """Return the columns of the groups ``names``; raise BidexError if there is no group of that name."""
        ranges = {group.name: group.where for group in self.groups}
        for name in set(names) - ranges.keys():
            raise unknown_name("observation group", name, ranges)
        return Columns(chain.from_iterable(ranges[name] for name in names))

    def extended(self, name: str, size: int) -> "Inputs":
        """Append a group after all other groups, for example the actions that a critic judges."""
        end = slice(self.width, self.width + size)
        return replace(self, groups=(*self.groups, ObservationGroup(name, (end,))))

    def encoded(self, name: str, make: MakeEncoder, scaled: bool = True) -> "Inputs":
        """Add an encoder for a group; if not ``scaled``, the group's columns are not normalised."""
        if scaled:
            unscaled = self.unscaled
        else:
            unscaled = self.unscaled | {name}
        return replace(self, encoders={**self.encoders, name: make}, unscaled=unscaled)

    def without(self, *names: str) -> "Inputs":
        """Return a copy of this description in which networks do not read the groups ``names`` either."""
        self.columns(*names)
        return replace(self, hidden=self.hidden | {*names})

    def only(self, *names: str) -> "Inputs":
        """Return a copy of this description in which networks read only the groups ``names``."""
        self.columns(*names)
        return replace(self, hidden=frozenset(group.name for group in self.groups) - {*names})


class GroupEncoder(nn.Module):
    """Encodes observations (..., d) as the input (..., size) of a network's layers.

    Groups without an encoder come first, in the order of their columns, followed by groups with an encoder. Without any
    encoder the module has no weights.
    """

    def __init__(self, inputs: int | Inputs, generator: torch.Generator):
        super().__init__()
        inputs = Inputs.of(inputs)
        names = [group.name for group in inputs.groups if group.name not in inputs.hidden]
        encoded = {name: inputs.columns(name) for name in names if name in inputs.encoders}
        made: dict[str, Any] = {n: inputs.encoders[n](columns.size, generator) for n, columns in encoded.items()}
        self.columns = nn.ModuleDict(encoded)
        self.groups = nn.ModuleDict(made)
        self.plain = inputs.columns(*(name for name in names if name not in encoded))
        self.size = self.plain.size + sum(encoder.size for encoder in made.values())
        self.identity = self.plain.size == inputs.width

    def forward(self, x: Tensor) -> Tensor:
        """Encode observations (..., d) as (..., size)."""
        if self.identity:
            return x
        encoded = [encoder(self.columns[name](x)) for name, encoder in self.groups.items()]
        return torch.cat([self.plain(x), *encoded], dim=-1)


class TaskEmbedding(nn.Module):
    """Maps the one-hot of a task (..., tasks) to a learned vector of the task (..., size).

    The entries of the vectors are initially drawn from N(0, 1). If ``unit``, the vectors are scaled to unit norm.
    """

    def __init__(self, tasks: int, generator: torch.Generator, size: int, unit: bool = False):
        super().__init__()
        self.size = size
        self.unit = unit
        self.vectors = nn.Parameter(torch.randn(tasks, size, generator=generator))

    def forward(self, one_hot: Tensor) -> Tensor:
        """Return the vectors (..., size) of one-hots (..., tasks)."""
        if self.unit:
            vectors = nn.functional.normalize(self.vectors, dim=1)
        else:
            vectors = self.vectors
        return one_hot @ vectors


def with_task_embedding(inputs: Inputs, size: int, unit: bool = False) -> Inputs:
    """Add a :class:`TaskEmbedding` with ``size`` entries; with a ``size`` of 0, or no task id, change nothing."""
    if size and any(group.name == "task_id" for group in inputs.groups):
        return inputs.encoded("task_id", partial(TaskEmbedding, size=size, unit=unit))
    return inputs
