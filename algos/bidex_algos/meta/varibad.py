"""VariBAD: RL² whose memory is a belief about the task (Zintgraf et al. 2020); see docs/learners/varibad.md.

An encoder turns the trial so far into a belief: a Gaussian over a latent variable. From a sample of the latent a
decoder predicts the rewards of the whole trial; the error of this prediction trains encoder and decoder. Policy and
critic read the belief. PPO trains policy and critic but not the encoder, so the beliefs about a trial are computed only
once. Comments name the parts of the paper's objective (section 3): the return of the policy plus, for each time t, the
evidence lower bound ELBO_t, which is a reconstruction term minus the KL from the previous belief.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from bidex_algos.meta.rl2 import RL2, RL2Config
from bidex_algos.meta.trials import Batch
from bidex_algos.nets.architecture import network_bytes
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import ACTIVATIONS, MLP, gaussian_kl, linear
from bidex_algos.nets.recurrent import RecurrentNet
from bidex_algos.onpolicy.ppo import mini_batches
from bidex_meta.training.distributed import all_sum, sum_gradients
from bidex_meta.training.learner import Parts
from bidex_meta.utils.validation import Count, NonNegative, Positive
from bidex_meta.world.contract import PooledWorld

_TIMES = 16
"""Number of steps of each trial whose beliefs a mini-batch decodes."""
_STEPS = 64
"""Number of steps whose rewards are predicted from each of these beliefs."""
_BATCHES = 4
"""Largest number of mini-batches per pass of encoder and decoder; a GRU is slow on small mini-batches."""


@dataclass(frozen=True)
class VariBADConfig(RL2Config):
    """All options of VariBAD; the defaults are the preset ``laptop``."""

    latent: Count = 8  # Size of the latent; the policy reads the mean and log standard deviation of each entry.
    kl_weight: NonNegative = 0.1  # Weight of a belief's KL from the previous one, relative to the error of all rewards.
    belief_learning_rate: Positive = 1e-3  # Adam's step size for encoder and decoder.
    reward_unit: Positive = 0.3
    """The policy reads a reward as asinh(reward / reward_unit), normalised by running statistics."""

    def bytes_held(self, num_envs: int, width: int) -> int:
        """Estimate the memory that the learner takes, in bytes, if it stores ``width`` numbers per environment step."""
        return super().bytes_held(num_envs, width) + network_bytes(self.hidden, width, 2)


# The presets v2 and gpu have RL²'s values (rl2.py). Beliefs are learned from whole trials, whatever the chunk.
PRESETS: dict[str, VariBADConfig] = {
    "laptop": VariBADConfig(),
    "v2": VariBADConfig(gamma=0.99, init_std=0.3, chunk=125, hidden=(128, 128), num_minibatches=4, epochs=3),
    "gpu": VariBADConfig(
        gamma=0.99, init_std=0.3, chunk=125, hidden=(256, 128), num_minibatches=16, epochs=5, learning_rate=1e-3,
        value_horizon=10.0,
        belief_learning_rate=2e-3,  # twice v2's: 20 Adam steps per trial instead of 12, on batches 256 times as large
    ),
}  # fmt: skip


class BeliefActor(RecurrentNet):
    """An encoder with a memory, an actor that reads observation and belief, and a decoder that predicts rewards.

    The encoder infers the belief about the task. The decoder reads only the observation, which is the first ``seen``
    entries of an input (..., inputs).
    """

    def __init__(self, inputs: Inputs, seen: int, config: VariBADConfig, actions: int, generator: torch.Generator):
        hidden = config.hidden
        latent = config.latent
        activation = config.activation
        super().__init__(inputs, hidden, config.memory, 2 * latent, 1.0, generator, activation, config.trial_steps)
        self.actor = MLP(inputs.extended("belief", 2 * latent), hidden, actions, 0.01, generator, activation)
        self.seen = seen
        self.state = MLP(seen, hidden[:-1], hidden[-1], 1.0, generator, activation)
        self.task = linear(latent, hidden[-1], 1.0, generator)
        self.activation = ACTIVATIONS[activation]()
        self.paid = MLP(hidden[-1], (hidden[-1],), 1, 0.01, generator, activation)

    def forward(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean actions (T, B, actions) for inputs (T, B, inputs), and the memory after these steps.

        No gradient flows into the encoder and its memory.
        """
        x, state = self.with_belief(x, state)
        return self.actor(x), state

    def believe(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return means and log standard deviations (T, B, latent) of the beliefs at steps (T, B, inputs).

        The third result is the memory after these steps.
        """
        belief, state = super().forward(x, state)
        mean, log_std = belief.chunk(2, dim=-1)
        return mean, log_std.clamp(-6.0, 2.0), state

    def decode_reward(self, x: Tensor, latent: Tensor) -> Tensor:
        """Decode latent samples (K, B, latent) to normalised rewards (K, M, B) of the inputs ``x`` (M, B, inputs)."""
        both = self.activation(self.state(x[..., : self.seen]) + self.task(latent)[:, None])
        return self.paid(both).squeeze(-1)

    def with_belief(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Append beliefs to inputs (T, B, inputs), without gradient.

        Returns the result (T, B, inputs + 2 latent) and the memory after these steps.
        """
        with torch.no_grad():
            mean, log_std, state = self.believe(x, state)
        return torch.cat([x, mean, log_std], dim=-1), state

    def model(self) -> list[nn.Parameter]:
        """Return the weights of encoder and decoder, which PPO does not train."""
        return [weight for name, weight in self.named_parameters() if not name.startswith("actor.")]


class BeliefCritic(nn.Module):
    """A critic that reads the observation and the belief of an actor's encoder."""

    def __init__(self, actor: BeliefActor, values: MLP):
        super().__init__()
        self._actor = (actor,)  # a tuple, so that the actor's weights are not this module's
        self.values = values

    def forward(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return the critic's values (T, B, heads) for inputs (T, B, inputs), and the memory after these steps."""
        x, state = self._actor[0].with_belief(x, state)
        return self.values(x), state


class VariBAD(RL2):
    """VariBAD (Zintgraf et al. 2020, arXiv 1910.08348): a policy that acts on its belief about the hidden task."""

    name = "varibad"
    config_type = VariBADConfig
    presets = PRESETS
    config: VariBADConfig

    def __init__(self, world: PooledWorld, config: VariBADConfig, seed: int):
        super().__init__(world, config, seed)
        self.net: Any = self.policy.actor  # a BeliefActor
        self.model: list[nn.Parameter] = self.net.model()
        self.model_adam = torch.optim.Adam(self.model, lr=config.belief_learning_rate, fused=True)

    @classmethod
    def _make_actor(cls, config: VariBADConfig, inputs: Inputs, actions: int, init: torch.Generator) -> BeliefActor:
        return BeliefActor(inputs, inputs.width - actions - 3, config, actions, init)

    def _make_critic(self, heads: int) -> BeliefCritic:
        config = self.config
        inputs = self.policy.inputs.extended("belief", 2 * config.latent)
        values = MLP(inputs, config.hidden, heads, 0.01, self.initial, config.activation)
        actor: Any = self.policy.actor
        return BeliefCritic(actor, values)

    def _update(self, b: Batch) -> dict[str, Tensor]:
        """Run PPO's update with the beliefs of the played trial, then update encoder and decoder."""
        # Section 3.2, the policy's term J: only policy and critic learn from it, as in the paper's experiments.
        losses = super()._update(b)
        # Section 3.2, the sum of ELBO_t: encoder and decoder learn from it, with an optimiser of their own. The paper
        # draws trajectories from a buffer; here they are those of the trial just played.
        ones = torch.ones(b.weights.shape[1], device=self.device)
        number = min(_BATCHES, self.config.num_minibatches)
        batches = mini_batches(ones, self.config.epochs, number, self.generator, Tensor.tensor_split)
        reward, divergence = torch.stack([self._descend(b, chosen) for _, chosen, _ in batches]).mean(0)
        return losses | {"Loss/reward": reward, "Loss/divergence": divergence}

    def _prepare(self) -> tuple[Batch, Tensor]:
        """Prepare a trial as RL² does, and store the inputs with their beliefs, which PPO does not change."""
        b, explained = super()._prepare()
        found = []
        for number, begin in enumerate(range(0, len(b.obs), b.size)):
            part = slice(begin, begin + b.size)
            x = self.policy.see(b.obs[part], *(previous[part] for previous in b.previous))
            found.append(self.net.with_belief(x, b.actor_states[number])[0])
        self.known = torch.cat(found)
        return b, explained

    def _outputs(self, b: Batch, chosen: Tensor) -> tuple[Tensor, Tensor]:
        known = b.take(self.known, chosen)
        critic: Any = self.critic
        return self.net.actor(known), critic.values(known)

    def _descend(self, b: Batch, chosen: Tensor) -> Tensor:
        """Take one gradient step of encoder and decoder.

        Returns the reward error and the KL divergence of :meth:`_elbo_terms`, summed over all processes, (2,).
        """
        reward, divergence = self._elbo_terms(b, chosen)
        # Descend minus the ELBO. The reward error is a mean over the trial's rewards where the paper has a sum, so the
        # KL is divided by the number of slots.
        self.model_adam.zero_grad()
        (reward + self.config.kl_weight / len(b.weights) * divergence).backward()
        found = sum_gradients(self.model, torch.stack([reward, divergence]).detach())
        nn.utils.clip_grad_norm_(self.model, self.config.max_grad_norm)
        self.model_adam.step()
        return found

    def _elbo_terms(self, b: Batch, chosen: Tensor) -> tuple[Tensor, Tensor]:
        """Return this process's part of the two terms of the loss: the reward error and the KL divergence.

        ``chosen``, int64 (B,), are the environments whose trials are used. From the beliefs at random times, the
        decoder predicts the rewards of random steps, past and future; the reward error is the mean squared error of
        these predictions. The KL divergence is the mean divergence of each belief from the previous one.
        """
        policy = self.policy
        net = self.net
        previous = [each[:, chosen] for each in b.previous]
        _, last_reward, _, begins = previous
        x = policy.see(b.obs[:, chosen], *previous)
        valid = b.weights[:, chosen]
        # The posterior q(m | trial up to t) at each time t.
        mean, log_std, _ = net.believe(x, b.actor_states[0, chosen])
        # ELBO_t's second term: the KL from the previous posterior; at the first step from the prior N(0, 1).
        divergence = valid * gaussian_kl(mean, log_std, _delayed(mean), _delayed(log_std))
        # ELBO_t's first term: from a sample of q at time t, predict the rewards of the whole trial, past and future.
        # Both t and the predicted steps are subsampled. There is no decoder of states.
        time = torch.randperm(len(x), generator=self.generator, device=x.device)[:_TIMES]
        step = torch.randperm(len(x), generator=self.generator, device=x.device)[:_STEPS]
        noise = torch.randn(mean[time].shape, generator=self.generator, device=x.device)
        latent = mean[time] + log_std[time].exp() * noise
        errors = (net.decode_reward(x[step], latent) - policy.earned(last_reward)[step]).square()
        # A slot shows the reward of the previous step, but after the end of an episode not the state that the step led
        # to: such rewards are not predicted.
        has_reward = _delayed(valid).masked_fill(begins, 0.0)
        weights = valid[time][:, None] * has_reward[step]
        count = all_sum(torch.stack([weights.sum(), valid.sum()])).clamp_min(1.0)
        return (weights * errors).sum() / count[0], divergence.sum() / count[1]

    def _parts(self) -> Parts:
        return {**super()._parts(), "model_adam": self.model_adam}


def _delayed(x: Tensor) -> Tensor:
    """Return for each step the entry of ``x`` (T, ...) of the step before, and zeros for the first step."""
    return torch.cat([torch.zeros_like(x[:1]), x[:-1]])
