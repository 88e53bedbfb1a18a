"""What a policy's networks must know of the world they were made for; a checkpoint keeps it."""

from dataclasses import dataclass
from typing import Any

from bidex_meta.world.contract import ObservationGroup, VectorWorld, plain_groups


@dataclass(frozen=True)
class Shape:
    """Sizes of a world's spaces and the parts of its observation.

    Attributes:
        observations: Entries of an observation, d.
        actions: Entries of an action, a.
        groups: The named parts of an observation.
    """

    observations: int
    actions: int
    groups: tuple[ObservationGroup, ...]

    @classmethod
    def of(cls, world: VectorWorld) -> "Shape":
        """That of a world."""
        observations, actions = world.single_observation_space, world.single_action_space
        return cls(int(observations.shape[0]), int(actions.shape[0]), tuple(world.observation_groups))

    @classmethod
    def plain(cls, observations: int, actions: int, num_id_columns: int = 0) -> "Shape":
        """That of a world which knows no parts but the task's one-hot behind the rest."""
        return cls(observations, actions, plain_groups(observations, num_id_columns))

    @property
    def num_id_columns(self) -> int:
        """Entries of the task's one-hot, 0 where the observation has none."""
        return sum(group.size for group in self.groups if group.name == "task_id")

    def sizes(self) -> dict[str, int]:
        """The numbers without the places of the groups."""
        return {name: getattr(self, name) for name in ("observations", "actions", "num_id_columns")}

    def state_dict(self) -> dict[str, Any]:
        """Plain values for a checkpoint."""
        return self.sizes() | {"groups": {g.name: [[w.start, w.stop] for w in g.where] for g in self.groups}}

    @classmethod
    def load(cls, state: dict[str, Any]) -> "Shape":
        """What :meth:`state_dict` gave; earlier versions kept the sizes alone, and the one-hot was last."""
        if "groups" not in state:
            return cls.plain(**state)
        groups = ((name, tuple(slice(*part) for part in where)) for name, where in state["groups"].items())
        return cls(state["observations"], state["actions"], tuple(ObservationGroup(*group) for group in groups))
