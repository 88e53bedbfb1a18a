"""The base of learners with a memory: trials, rotation of tasks, statistics of first and last episodes."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from bidex_algos.learner import Learner
from bidex_algos.meta.memory_agent import MemoryAgent
from bidex_algos.meta.trials import Player, Trials, play
from bidex_algos.nets.recurrent import RecurrentPolicy
from bidex_algos.rollout import EpisodeStatistics
from bidex_meta.training.distributed import all_sum, own_seed, rank, world_size
from bidex_meta.training.learner import AutoresetMode, Capability, State
from bidex_meta.world.contract import PooledWorld, as_endless


def of_episodes(firsts: EpisodeStatistics, lasts: EpisodeStatistics) -> dict[str, float]:
    """Return metrics of the first and the last episodes of trials."""
    metrics = {}
    for which, statistics in (("first", firsts), ("last", lasts)):
        found = statistics.metrics()
        if "Train/mean_return" in found:  # every task has ended an episode
            metrics[f"Train/return_{which}_episode"] = found["Train/mean_return"]
            metrics[f"Train/success_{which}_episode"] = found["Train/success_rate"]
    return metrics


class TrialLearner(Learner):
    """Base of learners that play, in each iteration, one trial in every environment.

    A trial is a few episodes of one task with one memory.
    """

    world: PooledWorld
    policy: RecurrentPolicy
    per_process = ("generator", "episodes")
    capabilities = frozenset({Capability.ADAPTS, Capability.ADAPTS_INDEPENDENTLY})
    going_on = ("trials_played", *Learner.going_on)

    def __init__(self, world: PooledWorld, config: Any, seed: int):
        if config.max_adapt_steps is None:  # the memory is sized for a whole trial
            config = replace(config, max_adapt_steps=int(world.max_episode_steps.max()))
        super().__init__(world, config, seed)
        self.agent = MemoryAgent(self.policy, own_seed(seed))
        self.trials_played = 0
        self.limits = world.max_episode_steps.clamp_max(config.max_adapt_steps)
        """Maximum number of steps per episode, for each environment (N,)."""
        self.episodes, self.firsts, self.lasts = (EpisodeStatistics(world.task_id, world.task_names) for _ in range(3))
        # These are the pools and row counts of classes with fewer rows than tasks. Each trial takes one task per row.
        rows = torch.bincount(world.task_id, minlength=world.num_tasks).tolist()
        each = zip(world.task_names, world.pools, rows, strict=True)
        self.pools = {name: (torch.tensor(pool), count) for name, pool, count in each if count < len(pool)}
        self.most_rows = max(rows)
        self.endless = as_endless(world)

    @classmethod
    def autoreset_mode(cls, config: Any) -> AutoresetMode:
        """Return the autoreset mode that the world needs: DISABLED, because the episodes of a trial begin together."""
        return "DISABLED"

    def _play(self, trials: Trials, player: Player, blind_share: float = 0.0) -> None:
        """Play the next trial in all environments and record it in ``trials``.

        In a fraction ``blind_share`` of the episodes, the policy does not see rewards.
        """
        counts = [[self.episodes] for _ in range(trials.episodes)]
        counts[0].append(self.firsts)
        counts[-1].append(self.lasts)
        with self._collecting():
            obs = self._begin()
            play(self.world, self.policy, player, trials, obs, blind_share, self.generator, counts)

    def _begin(self) -> Tensor:
        trial = self.trials_played * world_size() + rank()
        if self.endless is not None:
            self.world.set_tasks(self.endless.fresh_tasks(trial, self.most_rows))
        elif self.pools:
            # The pool rotates, so all tasks of a class are played equally often.
            turned = {name: pool.roll(-trial * rows, 0).numpy() for name, (pool, rows) in self.pools.items()}
            self.world.set_tasks(turned)
        if self.trials_played == 0:
            return self._first_observations()
        return self.world.reset()[0]

    def _count(self, trials: Trials) -> None:
        self.env_steps += int(all_sum(trials.lengths.sum()))
        self.trials_played += 1

    def _episodes_metrics(self) -> dict[str, float]:
        return self.episodes.metrics() | of_episodes(self.firsts, self.lasts)

    @classmethod
    def load_policy(cls, state: State, device: str | torch.device = "cpu") -> MemoryAgent:
        """Return the agent of a checkpoint, for a world of any number of environments; see ``Learner.load_policy``."""
        return MemoryAgent(super().load_policy(state, device))
