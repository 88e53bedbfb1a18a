"""The batched world: groups of models with equal structure, actions, observations, resets, episodes, random numbers."""

from bidex_meta.world.depth_sensor import PointsRule
from bidex_meta.world.groups import Slot
from bidex_meta.world.world import World, WorldConfig

__all__ = ["PointsRule", "Slot", "World", "WorldConfig"]
