"""The spaces of a batched world: of a row and of all rows."""

from typing import NamedTuple, cast

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector.utils import batch_space


class Spaces(NamedTuple):
    """The four of a Gymnasium vector environment."""

    single_observation: Box
    single_action: Box
    observation: Box
    action: Box


def make_spaces(single_observation: Box, action_size: int, num_envs: int) -> Spaces:
    """The spaces of rows with these observations and ``action_size`` actions within [-1, 1]."""
    single = single_observation, Box(-1.0, 1.0, (action_size,), np.float32)
    return Spaces(*single, *(cast(Box, batch_space(space, num_envs)) for space in single))
