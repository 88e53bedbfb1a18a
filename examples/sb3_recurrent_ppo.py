"""RL² by sb3-contrib's RecurrentPPO: train on trials of a suite with hidden goals, then play the meta-test.

pip install "bidex-meta[sb3]", then: python examples/sb3_recurrent_ppo.py --suite ML1-DoorCloseInward-v2 --steps 1000000
"""

import copy
from pathlib import Path

import numpy as np
import torch
import tyro
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from torch import Tensor

from bidex_meta import Benchmark, meta_test
from bidex_meta.agents import Timestep
from bidex_meta.cli.tables import print_meta_test
from bidex_meta.clients.sb3_env import SB3VecEnv
from bidex_meta.clients.trial_env import TrialWorld


class RecurrentAgent:
    """A recurrent policy of sb3-contrib as a `TrialAgent`; its observations are those of `TrialWorld`."""

    def __init__(self, policy: RecurrentActorCriticPolicy) -> None:
        self.policy = policy

    def __deepcopy__(self, memo: dict) -> "RecurrentAgent":
        """Return an agent with the same policy, which does not learn, and a memory of its own."""
        return copy.copy(self)  # no array is changed in place

    def reset(self, env_mask: Tensor) -> None:
        """Begin trials: `meta_test` begins them in all environments at once."""
        self.memory = None
        self.begins = np.ones(len(env_mask), dtype=bool)
        self.last = np.zeros((len(env_mask), self.policy.action_space.shape[0] + 2), dtype=np.float32)

    def act(self, obs: Tensor) -> Tensor:
        """Return actions without noise; the memory waits for `observe`."""
        seen = np.concatenate((obs.numpy(), self.last), axis=1)
        action, self.next_memory = self.policy.predict(seen, self.memory, self.begins, deterministic=True)
        return torch.from_numpy(action)

    def observe(self, timestep: Timestep) -> None:
        """Remember the last action, reward and end; environments that wait remember nothing."""
        valid = timestep.valid.numpy()[:, None]
        ended = timestep.terminated | timestep.truncated
        last = torch.cat((timestep.action, timestep.reward[:, None], ended[:, None].float()), dim=1)
        self.last = np.where(valid, last.numpy(), self.last)
        before = self.memory or [np.zeros_like(new) for new in self.next_memory]
        self.memory = tuple(np.where(valid, new, old) for new, old in zip(self.next_memory, before, strict=True))
        self.begins = self.begins & ~valid[:, 0]


def main(
    suite: str = "ML1-DoorCloseInward-v2",
    steps: int = 1_000_000,
    num_envs: int = 64,
    rollout: int = 250,
    rollouts: int = 10,
    seed: int = 0,
    result_file: Path = Path("result.json"),
) -> RecurrentPPO:
    """Train, then print the meta-test's table and save its result.

    Args:
        suite: A suite that hides its goals (`bidex-meta list suites`).
        steps: Environment steps.
        num_envs: Environments of the world.
        rollout: Steps of an environment between two updates.
        rollouts: Episodes of each task in a shot of the meta-test.
        seed: Of everything.
        result_file: Where the result goes: `bidex-meta submit --evaluation` makes a row of the leaderboard from it.
    """
    world = Benchmark(suite, seed=seed).make_world("train", num_envs, "cpu", episodes_per_task=3)
    learner = RecurrentPPO(
        "MlpLstmPolicy",
        SB3VecEnv(TrialWorld(world)),
        n_steps=rollout,
        batch_size=num_envs * rollout // 4,
        n_epochs=4,
        gamma=0.99,
        policy_kwargs={"net_arch": [128, 128], "lstm_hidden_size": 128, "log_std_init": -1.2},
        seed=seed,
        device="cpu",
        verbose=1,
    )
    learner.learn(steps, log_interval=5)
    result = meta_test(RecurrentAgent(learner.policy), suite, split="test", rollouts=rollouts, device="cpu")
    print_meta_test(result)
    result.save(result_file)
    return learner


if __name__ == "__main__":
    tyro.cli(main)
