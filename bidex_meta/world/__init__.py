"""The batched world: many environments of several task classes that are simulated and stepped together.

The modules cover groups of environments whose models have equal structure, and actions, observations, resets, episodes
and random numbers.
"""

from bidex_meta.world.config import WorldConfig
from bidex_meta.world.depth_sensor import PointsRule
from bidex_meta.world.groups import Slot
from bidex_meta.world.world import World

__all__ = ["PointsRule", "Slot", "World", "WorldConfig"]
