"""Networks with a memory: encoder, GRU, output; and a Gaussian policy that remembers its actions and rewards."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.networks import ACTIVATIONS, MLP, Activation
from bidex_algos.nets.normalise import ObservationNormaliser


class RecurrentNet(nn.Module):
    """An encoder, a GRU on the encoder's features, and a linear output layer.

    The output layer reads both the features and the GRU's output, so that a reaction to the current step need not pass
    through the memory. All layers are float32, because rounding to bfloat16 would accumulate in the memory. Before
    training, the entries of the memory fade over 2 to ``lasting`` + 1 steps, and the logarithms of these times are
    evenly spaced (after Tallec and Ollivier 2018, arXiv 1804.11188).
    """

    def __init__(
        self, inputs: int | Inputs, hidden: Sequence[int], memory: int, outputs: int, output_gain: float,
        generator: torch.Generator, activation: Activation = "elu", lasting: int = 1
    ):  # fmt: skip
        super().__init__()
        last = MLP(inputs, hidden[:-1], hidden[-1], math.sqrt(2.0), generator, activation)
        self.encoder = nn.Sequential(last, ACTIVATIONS[activation]())
        # The layer is created without memory, because the default initialisation would draw from the global generator.
        self.gru = nn.GRU(hidden[-1], memory, device="meta").to_empty(device=torch.get_default_device())
        for name, weight in self.gru.named_parameters():
            if "bias" in name:
                nn.init.zeros_(weight)
                continue
            for gate in weight.data.chunk(3):
                nn.init.orthogonal_(gate, generator=generator)
        # The gates are reset, update, new. An update gate of 1/2 halves the memory, and its gradient, at each step.
        self.gru.get_parameter("bias_ih_l0").data.chunk(3)[1].copy_(torch.linspace(0.0, math.log(lasting), memory))
        self.head = MLP(hidden[-1] + memory, (), outputs, output_gain, generator)

    def forward(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return outputs (T, B, outputs) for inputs (T, B, inputs), and the memory (B, memory) after these steps.

        ``state`` is the memory before these steps.
        """
        features = self.encoder(x)
        remembered, last = self.gru(features, state[None].contiguous())
        return self.head(torch.cat([features, remembered], dim=-1)), last[0]


@dataclass
class Memory:
    """The values that each environment carries over from the previous step; zeros at first.

    ``state`` (N, memory) is the network's memory. ``action`` (N, a) is not clamped yet; the world clamps it to [-1, 1].
    ``known`` (N,) marks rewards (N,) that the policy sees. ``done`` (N,) marks steps that ended an episode.
    """

    state: Tensor
    action: Tensor
    reward: Tensor
    known: Tensor
    done: Tensor

    def replaced(self, mask: Tensor, other: "Memory") -> "Memory":
        """Return the memory with the rows of ``mask``, bool (N,), taken from ``other``."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Memory(*(torch.where(mask if a.dim() == 1 else mask[:, None], b, a) for a, b in pairs))


class RecurrentPolicy(nn.Module):
    """A Gaussian policy whose memory reads observation, last action, last reward and end of episode.

    Rewards of unknown classes differ by orders of magnitude, so all rewards are read as asinh(reward /
    ``reward_unit``), normalised by running statistics. A group ``last_step``, which holds all inputs besides the
    observation, is appended to ``inputs``; ``make_actor`` makes the actor from the extended inputs.
    """

    def __init__(
        self, inputs: Inputs, actions: int, memory: int, init_std: float, reward_unit: float,
        normalise_observations: bool, make_actor: Callable[[Inputs], nn.Module]
    ):  # fmt: skip
        super().__init__()
        self.num_actions = actions
        self.memory = memory
        self.reward_unit = reward_unit
        self.inputs = inputs.extended("last_step", actions + 3)
        self.observations = ObservationNormaliser(inputs, normalise_observations)
        self.rewards = ObservationNormaliser(1)
        self.actor = make_actor(self.inputs)
        self.log_std = nn.Parameter(torch.full((actions,), math.log(init_std)))

    def see(self, obs: Tensor, action: Tensor, reward: Tensor, known: Tensor, done: Tensor) -> Tensor:
        """Return the networks' input of each step, (..., width of ``inputs``).

        The input consists of the normalised observation, the last action, the last reward (0 if it is not ``known``),
        ``known`` and ``done``. Observations (..., d) and rewards (...) are given raw, and actions are (..., a).
        ``known`` and ``done`` (...) are described in :class:`Memory`.
        """
        earned = torch.where(known, self.earned(reward), 0.0)
        last = torch.stack([earned, known.float(), done.float()], dim=-1)
        return torch.cat([self.observations(obs), action.clamp(-1.0, 1.0), last], dim=-1)

    def earned(self, reward: Tensor) -> Tensor:
        """Normalise raw rewards (...) for the networks."""
        return self.rewards(self._compressed(reward)).squeeze(-1)

    @torch.no_grad()
    def step(self, obs: Tensor, memory: Memory, drawn: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return unclamped mean actions (N, a) and the memory's next state (N, memory) for raw observations (N, d).

        ``drawn`` is the result of :meth:`drawn` for an exploring episode; with None the policy does not explore.
        """
        x = self.see(obs, memory.action, memory.reward, memory.known, memory.done)
        mean, state = self.actor(x[None], memory.state)
        return mean[0], state

    def drawn(self, last: Tensor | None, rows: int, generator: torch.Generator) -> Tensor | None:
        """Return None; a subclass may draw what each of ``rows`` environments tries next, given the ``last`` draw."""
        return None

    def fresh_memory(self, rows: int) -> Memory:
        """Return the memory of ``rows`` environments at the start of a trial."""
        device = self.log_std.device
        flags = torch.zeros(2, rows, dtype=torch.bool, device=device)
        state, action = (torch.zeros(rows, width, device=device) for width in (self.memory, self.num_actions))
        return Memory(state, action, torch.zeros(rows, device=device), flags[0], flags[1])

    @torch.no_grad()
    def update_statistics(self, obs: Tensor, rewards: Tensor) -> None:
        """Add raw observations (B, d) and rewards (B',) of all processes to the running statistics."""
        self.observations.update(obs)
        self.rewards.update(self._compressed(rewards))

    def _compressed(self, reward: Tensor) -> Tensor:
        return torch.asinh(reward / self.reward_unit)[..., None]
