"""The sizes and observation groups of the world for which a policy's networks were made; a checkpoint stores them."""

from dataclasses import dataclass

from bidex_algos.nets.architecture import shares_a_trunk
from bidex_meta.errors import BidexError
from bidex_meta.training.learner import LearnerConfig, State
from bidex_meta.world.contract import ObservationGroup, VectorWorld


@dataclass(frozen=True)
class Shape:
    """Sizes of a world's observations (d) and actions (a), and the named parts of an observation."""

    observations: int
    actions: int
    groups: tuple[ObservationGroup, ...]
    hidden: int = 0
    """Number of hidden values per task, which the world does not show: the goal in a meta suite."""
    classes: int = 1
    """Number of classes that the observation does not tell apart; 1 if the observation has the task's one-hot."""
    goal_entries: int = 0
    """Number of entries of the observation that would show the goal if the world did not hide it."""

    @classmethod
    def of(cls, world: VectorWorld) -> "Shape":
        """Return the shape of a world."""
        observations = world.single_observation_space
        actions = world.single_action_space
        hidden = int(getattr(world, "hidden_size", 0))
        groups = tuple(world.observation_groups)
        if any(group.name == "task_id" for group in groups):
            classes = 1
        else:
            classes = world.num_tasks
        entries = len(getattr(world, "goal_entries", ()))
        return cls(int(observations.shape[0]), int(actions.shape[0]), groups, hidden, classes, entries)

    @property
    def num_id_columns(self) -> int:
        """Return the number of entries of the task's one-hot; 0 if the observation has no one-hot."""
        return sum(group.size for group in self.groups if group.name == "task_id")

    def sizes(self) -> dict[str, int]:
        """Return the sizes of observation, action and the task's one-hot, by name."""
        return {"observations": self.observations, "actions": self.actions, "num_id_columns": self.num_id_columns}

    def state_dict(self) -> State:
        """Return the shape as plain values for a checkpoint."""
        if self.hidden:
            hidden = {"hidden": self.hidden}
        else:
            hidden = {}
        if self.classes > 1:
            classes = {"classes": self.classes}
        else:
            classes = {}
        if self.goal_entries:
            entries = {"goal_entries": self.goal_entries}
        else:
            entries = {}
        groups = {group.name: [[where.start, where.stop] for where in group.where] for group in self.groups}
        return self.sizes() | hidden | classes | entries | {"groups": groups}

    @classmethod
    def load(cls, state: State) -> "Shape":
        """Return the shape that :meth:`state_dict` saved as ``state``."""
        groups = ((name, tuple(slice(*part) for part in where)) for name, where in state["groups"].items())
        named = tuple(ObservationGroup(*group) for group in groups)
        more = state.get("hidden", 0), state.get("classes", 1), state.get("goal_entries", 0)
        return cls(state["observations"], state["actions"], named, *more)


_OF_SEVERAL = ("task_embedding", "normalise_per_task")


def check_options(name: str, config: LearnerConfig, world: VectorWorld, shape: Shape) -> None:
    """Raise BidexError if an option needs another option, or the tasks' one-hot and the world does not show it."""
    options = vars(config)
    if options.get("normalise_per_task") and not options["normalise_observations"]:
        raise BidexError(f"{name}: normalise_per_task needs normalise_observations; turn it on, or leave this out.")
    wanted = [option for option in (*_OF_SEVERAL, "policy_heads") if vars(config).get(option)]
    if world.num_tasks == 1:
        # One task needs no one-hot, but cannot have heads.
        wanted = [option for option in wanted if option not in _OF_SEVERAL]
    architecture = vars(config).get("architecture", "shared")
    if not shares_a_trunk(architecture):
        wanted.append(f"architecture {architecture}")
    for option in wanted:
        if shape.num_id_columns != world.num_tasks:
            raise BidexError(
                f"{name}: {option} needs the one-hot of {world.num_tasks} tasks in the observation (an MT "
                f"suite), this world shows {shape.num_id_columns} such entries. Leave {option} off."
            )


def check_discounts(name: str, world: VectorWorld, by_class: bool) -> None:
    """Raise BidexError if classes of a suite have their own discounts and the learner has a single discount."""
    own = [task for task, gamma in zip(world.task_names, world.gammas, strict=True) if gamma is not None]
    if own and not by_class:
        raise BidexError(
            f"{name}: uses one discount for all classes, but the suite gives {', '.join(own)} one of its own. "
            "Leave gamma out of the suite's file."
        )
