"""Policies that nobody trained: what others are measured against."""

import torch
from gymnasium.spaces import Box


class ZeroAgent:
    """Does nothing: action 0 everywhere.

    Args:
        action_space: The world's batched action space, shape ``(num_envs, action)``.
    """

    def __init__(self, action_space: Box):
        self._shape = action_space.shape

    def eval_action(self, obs: torch.Tensor) -> torch.Tensor:
        """Zeros ``(num_envs, action)`` on the device of ``obs``."""
        return torch.zeros(self._shape, device=obs.device)

    def reset(self, env_mask: torch.Tensor) -> None:
        """Nothing is remembered."""


class RandomAgent:
    """Uniform actions, the same on every device.

    Args:
        action_space: The world's batched action space, a Box of shape ``(num_envs, action)``.
        seed: Of this agent's own generator.
    """

    def __init__(self, action_space: Box, seed: int = 0):
        self._low = torch.as_tensor(action_space.low)
        self._range = torch.as_tensor(action_space.high) - self._low
        self._generator = torch.Generator().manual_seed(seed)

    def eval_action(self, obs: torch.Tensor) -> torch.Tensor:
        """Uniform in the action space, ``(num_envs, action)`` on the device of ``obs``."""
        # Drawn on the CPU: a generator on a GPU gives other numbers for the same seed.
        return (self._low + self._range * torch.rand(self._range.shape, generator=self._generator)).to(obs.device)

    def reset(self, env_mask: torch.Tensor) -> None:
        """Nothing is remembered."""
