"""FlashSAC: SAC with bounded networks and few updates with large batches (Kim et al. 2026, arXiv 2604.04539).

Targets are r + gamma (1 - terminated) (Z'(s', a') - alpha log pi(a'|s')), where Z' comes from the critic with the lower
mean. The rows of a layer's weights have unit norm, and batch norms bound the layer's outputs. A critic processes (s, a)
and (s', a') in one batch. Each environment repeats its noise for some steps. Everything else is described in
``mtsac.py`` and ``categorical.py``; for differences from the paper see ``docs/learners/flashsac.md``.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain

import torch
from torch import Tensor, nn

from bidex_algos.nets.architecture import follow
from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import ACTIVATIONS, MLP, Activation, Layers, autocast, linear
from bidex_algos.nets.policy import sample_squashed, squashed_policy
from bidex_algos.offpolicy.categorical import Categorical, CategoricalConfig, CategoricalCritics, check_residual
from bidex_algos.offpolicy.mtsac import MTSAC, MTSACConfig
from bidex_algos.replay import Transitions
from bidex_meta.training.distributed import all_sum, world_size
from bidex_meta.training.learner import Parts
from bidex_meta.utils.validation import Count, Finite, Positive, Share
from bidex_meta.world.contract import VectorWorld

WIDER = 4  # ratio of the width within a block to the width of its input
MOMENTUM = 0.01  # weight of a new batch in the running statistics of batch norms


def _directions(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    layer = linear(inputs, outputs, 1.0, generator)
    layer.register_parameter("bias", None)
    return layer


class InvertedBlock(nn.Module):
    """Residual block: x plus the output of two layers on x.

    The layers have no biases; each is followed by a batch norm and a non-linearity. The first layer's output is
    :data:`WIDER` times as wide as x.
    """

    def __init__(self, width: int, generator: torch.Generator, activation: Activation):
        super().__init__()
        layers: list[nn.Module] = []
        for inputs, outputs in ((width, WIDER * width), (WIDER * width, width)):
            norm = nn.BatchNorm1d(outputs, momentum=MOMENTUM)
            layers += [_directions(inputs, outputs, generator), norm, ACTIVATIONS[activation]()]
        self.layers = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        """Map (batch, width) to (batch, width)."""
        return x + self.layers(x)


class FloatRMSNorm(nn.RMSNorm):
    """Scales (..., n) to a root mean square of 1, in the precision of its weights."""

    def forward(self, x: Tensor) -> Tensor:
        """Map (..., n) to (..., n)."""
        return super().forward(x.to(self.weight.dtype))


class UnitMLP(MLP):
    """A batch norm, a linear layer, inverted blocks, an RMS norm and an output layer, one after another.

    The class replaces :class:`MLP` and takes its arguments. ``hidden`` lists one width several times: once for the
    first layer and once for each block. ``output_gain`` and ``layer_norm`` have no effect. Batch norms use running
    statistics except within :func:`by_batch`.
    """

    def __init__(
        self, inputs: int | Inputs, hidden: Sequence[int], outputs: int, output_gain: float, generator: torch.Generator,
        activation: Activation = "relu", layer_norm: bool = False
    ):  # fmt: skip
        super().__init__(inputs, (), outputs, output_gain, generator, activation)
        width = hidden[0]
        self.body = nn.Sequential(
            nn.BatchNorm1d(self.encoder.size, momentum=MOMENTUM),
            _directions(self.encoder.size, width, generator),
            *(InvertedBlock(each, generator, activation) for each in hidden[1:]),
            FloatRMSNorm(width, eps=1e-6),
        )
        self.head = linear(width, outputs, 1.0, generator)
        self.to_sphere()
        self.eval()

    @torch.no_grad()
    def to_sphere(self) -> None:
        """Scale each row of a linear layer's weights to norm 1, and weights of normalisation layers to norm sqrt(n).

        The weights of a normalisation layer for n features are its scales and shifts, taken as one vector.
        """
        for layer in (*self.body.modules(), self.head):
            if isinstance(layer, nn.Linear):
                layer.weight.div_(layer.weight.norm(dim=1, keepdim=True).clamp_min(1e-8))
            elif isinstance(layer, (nn.BatchNorm1d, nn.RMSNorm)):
                weights = list(layer.parameters())
                size = torch.stack([weight.square().mean() for weight in weights]).sum().sqrt().clamp_min(1e-8)
                for weight in weights:
                    weight.div_(size)


def _of(module: nn.Module) -> list[UnitMLP]:
    return [each for each in module.modules() if isinstance(each, UnitMLP)]


@contextmanager
def by_batch(network: nn.Module) -> Iterator[None]:
    """Let the batch norms of ``network`` normalise by the statistics of their input, within this context.

    The batch norms also merge these statistics into their running statistics.
    """
    network.train()
    yield
    network.eval()


@dataclass(frozen=True)
class FlashSACConfig(CategoricalConfig, MTSACConfig):
    """All options of FlashSAC; the defaults are the preset ``laptop``."""

    critic_hidden: Layers = (128, 128, 128)
    """Width of the critics' layers, once for the first layer and once for each block; inside a block layers are four
    times as wide."""
    hidden: Layers = (64, 64, 64)  # Width of the actor's layers, listed as in critic_hidden.
    value_heads: bool = False  # Give each critic one distribution per task instead of one for all.
    updates_per_step: Count = 2  # Updates of the critics after each vector step.
    policy_delay: Count = 2  # Updates of the critics for each update of the actor and the temperatures.
    n_steps: Count = 3  # Number of steps whose rewards a target sums before it adds the value of the next state.
    tau: Share = 0.05  # Share of the critics that enters the target critics in each update (1 - Polyak's factor).
    value_bound: Positive = 5.0  # The atoms are evenly spaced from minus this value to this value, in scaled rewards.
    target_entropy_per_action: Finite = -0.478
    """Target of the temperatures: entropy of the squashed policy per entry of the action. The default is the entropy of
    a normal distribution with standard deviation 0.15, log(0.15 sqrt(2 pi e)). Uniform actions have 0.69."""
    noise_repeats: Count = 16
    """Largest number of steps for which an environment keeps the noise of its actions. A number n is drawn with a
    probability proportional to n^-2. 1: new noise at each step."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_residual(self)


PRESETS: dict[str, FlashSACConfig] = {
    "laptop": FlashSACConfig(),
    # The values are from the authors' code (github.com/Holiday-Robot/FlashSAC, 2026): configs/agent/flashSAC.yaml, and
    # for batch, updates, discount and steps scripts/run_isaaclab.sh, whose hands are most similar to ours. The script
    # keeps 10,000,000 transitions after a warm-up of 100,000; the same numbers result here with 4,096 environments
    # instead of its 1,024. Log standard deviations (flash_rl/agents/flashSAC/layer.py) range from -10 to 2 and start in
    # the middle. The gradient has no limit (here a huge one), and observations are not normalised.
    "gpu": FlashSACConfig(
        hidden=(128, 128, 128), critic_hidden=(256, 256, 256), replay_steps=2442, replay_memory=23.0, warmup_steps=25,
        updates_per_step=2, policy_delay=2, batch_size=2048, gamma=0.99, n_steps=3, tau=0.01, learning_rate=3e-4,
        critic_learning_rate=3e-4, alpha_learning_rate=3e-4, init_alpha=0.01, std_range=(4.54e-5, 7.39),
        init_std=0.0183, max_grad_norm=1e9, normalise_observations=False, atoms=101, value_bound=5.0, noise_repeats=16,
    ),
}  # fmt: skip


class FlashSAC(Categorical, MTSAC):
    """FlashSAC (Kim et al. 2026, arXiv 2604.04539) on a batched world."""

    name = "flashsac"
    config_type = FlashSACConfig
    presets = PRESETS
    config: FlashSACConfig
    per_process = (*Categorical.per_process, "noise", "repeats")
    going_on = ("updates", "noise", "repeats", *MTSAC.going_on)
    critic_network = UnitMLP
    policy_of = staticmethod(partial(squashed_policy, network=UnitMLP))

    def __init__(self, world: VectorWorld, config: FlashSACConfig, seed: int):
        super().__init__(world, config, seed)
        self.target_critic.train()
        self.updates = 0
        self.of_actor = {name: torch.zeros((), device=self.device) for name in ("Loss/actor", "Policy/entropy")}
        self.noise = torch.zeros(world.num_envs, self.shape.actions, device=self.device)
        self.repeats = torch.zeros(
            world.num_envs, dtype=torch.int64, device=self.device
        )  # remaining steps of the noise
        self.shares = torch.arange(1.0, config.noise_repeats + 1, device=self.device) ** -2

    def _make_critics(self, inputs: Inputs, heads: int) -> CategoricalCritics:
        critics = super()._make_critics(inputs, heads)
        # With weights of unit norm, the network could not overcome the biases of a narrow initial distribution, which
        # reach 50.
        for net in _of(critics):
            nn.init.zeros_(net.head.bias)
        return critics

    def _explore(self, obs: Tensor) -> Tensor:
        with autocast(self.device, self.low_precision):
            mean, log_std = self.policy.actor(self.policy.observations(obs))
        fresh = self.repeats == 0
        noise = torch.randn(mean.shape, generator=self.generator, device=self.device)
        steps = torch.multinomial(self.shares, len(obs), replacement=True, generator=self.generator) + 1
        self.noise = torch.where(fresh[:, None], noise, self.noise)
        self.repeats = torch.where(fresh, steps, self.repeats) - 1
        return sample_squashed(mean, log_std, self.noise)[0]

    def _update(self, draw: Transitions, weights: Tensor, counts: Tensor) -> dict[str, Tensor]:
        obs = self.policy.observations(draw.obs)
        next_obs = self.policy.observations(draw.next_obs)
        both = torch.cat([obs, next_obs])
        count = len(obs)
        with torch.no_grad():
            next_actions, log_prob = self.policy.sample(next_obs, self.generator)
            actions = torch.cat([draw.actions, next_actions])
            bonus = -self.log_alpha.exp()[self.task_of_draw] * log_prob
            target = self._projected(draw, self._following(both, actions)[count:], bonus)
        reported = self._fit_critics(both, replace(draw, actions=actions), target, weights, counts)
        if self.updates % self.config.policy_delay == 0:
            with by_batch(self.policy.actor):
                actions, log_prob = self.policy.sample(both, self.generator)
            self.of_actor = self._policy_step(obs, actions[:count], log_prob[:count], weights, counts)
        self.updates += 1
        follow(self.target_critic, self.critic, self.config.tau)
        self._share_statistics()
        return reported | self.of_actor

    def _critic_losses(self, obs: Tensor, actions: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        with by_batch(self.critic):
            return super()._critic_losses(obs, actions, target)

    def _descend(self, loss: Tensor, numbers: Tensor, clipped: str, **parameters: list[nn.Parameter]) -> Tensor:
        numbers = super()._descend(loss, numbers, clipped, **parameters)
        for net in _of({"actor": self.policy.actor, "critic": self.critic}[clipped]):
            net.to_sphere()
        return numbers

    @torch.no_grad()
    def _share_statistics(self) -> None:
        """Average the running statistics over all processes, because each process updates them with its own batch."""
        if world_size() == 1:
            return
        nets = (self.policy.actor, self.critic, self.target_critic)
        buffers = chain.from_iterable(net.named_buffers() for net in nets)
        running = [x for name, x in buffers if name.endswith(("running_mean", "running_var"))]
        means = (all_sum(torch.cat(running)) / world_size()).split([len(x) for x in running])
        for x, mean in zip(running, means, strict=True):
            x.copy_(mean)

    def _own_parts(self) -> Parts:
        return {**super()._own_parts(), "of_actor": self.of_actor}
