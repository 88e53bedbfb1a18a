"""FastTD3 and BRC, and what they are made of: projection, n-step returns, the bound of returns, residual networks."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from bidex_algos.offpolicy.brc import BRC, BRCConfig, ResidualMLP
from bidex_algos.offpolicy.categorical import Atoms, ReturnBound
from bidex_algos.offpolicy.fasttd3 import FastTD3, FastTD3Config
from bidex_algos.replay import Replay, Stretches, Transitions
from tests.algos.problems import OFF_POLICY, a_draw, opposite_bandits, shake, trained
from tests.algos.toy import ToyWorld, nearness


def slow_projection(low: float, high: float, probs: np.ndarray, shift: float, factor: float) -> np.ndarray:
    values = np.linspace(low, high, len(probs))
    out = np.zeros(len(probs))
    for value, mass in zip(values, probs, strict=True):
        moved = min(max(shift + factor * value, low), high)
        upper = int(np.clip(np.searchsorted(values, moved), 1, len(values) - 1))
        width = values[upper] - values[upper - 1]
        out[upper] += mass * (moved - values[upper - 1]) / width
        out[upper - 1] += mass * (values[upper] - moved) / width
    return out


@settings(max_examples=60, deadline=None)
@given(
    low=st.floats(-20, 0), width=st.floats(0.5, 40), count=st.integers(2, 60), shift=st.floats(-50, 50),
    factor=st.floats(0, 1), seed=st.integers(0, 2**31),
)  # fmt: skip
def test_the_projection_is_that_of_a_slow_loop(
    low: float, width: float, count: int, shift: float, factor: float, seed: int
) -> None:
    probs = torch.rand(1, count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    probs /= probs.sum()
    atoms = Atoms(low, low + width, count).double()
    out = atoms.projected(probs, torch.tensor([shift]).double(), torch.tensor([factor]).double())[0]
    expected = slow_projection(low, low + width, probs[0].numpy(), shift, factor)
    assert_close(out, torch.from_numpy(expected), rtol=0, atol=1e-5)
    assert_close(out.sum(), torch.tensor(1.0).double())


ROWS = 3


class Diary:
    """Random steps of three rows, in a replay and in a list."""

    def __init__(self, steps: int, kept: int, seed: int = 0):
        generator = torch.Generator().manual_seed(seed)
        self.replay = Replay(kept, torch.tensor([0, 0, 1]), 2, 1, 1, torch.device("cpu"), 1.0)
        self.entries: list[dict[str, Tensor]] = []
        self.replay.begin(self._mark(0))
        for t in range(steps):
            draw = torch.rand(ROWS, generator=generator)
            flags = {"terminated": draw < 0.1, "truncated": (draw > 0.08) & (draw < 0.25), "unstable": draw > 0.9}
            step = {**flags, "reward": torch.randn(ROWS, generator=generator), "final": self._mark(t + 0.5)}
            self.entries.append(step)
            self.replay.add(
                torch.zeros(ROWS, 1), step["reward"], step["terminated"], step["truncated"] | step["unstable"],
                self._mark(t + 1), {"unstable": step["unstable"], "final_obs": step["final"]},
            )  # fmt: skip

    def _mark(self, t: float) -> Tensor:
        return 100 * t + torch.arange(ROWS)[:, None].float()

    def slow(self, t: int, row: int, n: int, gamma: float) -> tuple[float, int, float | None]:
        total, taken = 0.0, 0
        while True:
            step = self.entries[t]
            total, taken = total + gamma**taken * float(step["reward"][row]), taken + 1
            if step["terminated"][row]:
                return total, taken, None
            if step["truncated"][row]:
                return total, taken, float(step["final"][row])
            t += 1
            if taken == n or t == len(self.entries) or self.entries[t]["unstable"][row]:
                return total, taken, float(self._mark(t)[row])


@pytest.mark.parametrize("n", [1, 2, 3, 8])
@pytest.mark.parametrize("steps", [4, 60])
def test_n_steps_are_those_of_a_slow_loop_up_to_the_episodes_end(n: int, steps: int) -> None:
    diary = Diary(steps, kept=25)
    replay = diary.replay
    valid = [
        (t, row)
        for t in range(steps - replay.filled, steps)
        for row in range(ROWS)
        if not diary.entries[t]["unstable"][row]
    ]
    places = torch.tensor([[t % replay.slots * ROWS + row for t, row in valid]])
    stretches = Stretches(replay, places, n, 0.9)
    taken = stretches.take(0)
    assert replay.weights(stretches.last).eq(1).all()
    took = torch.as_tensor(taken.steps).expand(len(valid))
    for i, (t, row) in enumerate(valid):
        total, count, following = diary.slow(t, row, n, 0.9)
        assert float(taken.obs[i]) == 100 * t + row
        assert float(taken.rewards[i]) == pytest.approx(total, abs=1e-5) and int(took[i]) == count
        assert bool(taken.terminated[i]) == (following is None)
        assert following is None or float(taken.next_obs[i]) == following


def bound_after(gamma: float, rewards: list[list[float]], **ends: list[list[bool]]) -> ReturnBound:
    bound = ReturnBound(ToyWorld([nearness(0.0), nearness(0.0)], rows=1), gamma, 1e9)
    for t, reward in enumerate(rewards):
        flags = [torch.tensor(ends[name][t] if name in ends else [False] * 2) for name in ("terminated", "truncated")]
        bound.note(torch.tensor(reward), *flags, torch.tensor(ends["broken"][t] if "broken" in ends else [False] * 2))
    return bound


def test_the_bound_is_the_largest_discounted_sum_of_each_task() -> None:
    ends = [[False, False], [True, False], [False, False]]
    bound = bound_after(0.5, [[1.0, -8.0], [2.0, 4.0], [1.0, 0.0]], terminated=ends)
    assert_close(bound.bound, torch.tensor([2.5, 8.0]))
    assert_close(bound.discounted, torch.tensor([1.0, 0.0]))


def test_a_time_limit_counts_as_if_the_episode_went_on() -> None:
    never, last = [False, False], [True, False]
    bound = bound_after(0.8, [[1.0, 1.0]] * 3, truncated=[never, never, last], terminated=[never, never, never])
    # An endless series of rewards of 1 is worth 1 / (1 - 0.8); three of them are worth 1 + 0.8 + 0.64.
    assert_close(bound.bound, torch.tensor([5.0, 2.44]))
    both = bound_after(0.8, [[1.0, 1.0]], truncated=[[True, True]], terminated=[[True, False]])
    assert_close(both.bound, torch.tensor([1.0, 5.0]))


@given(
    late=st.integers(30, 60), idle=st.integers(0, 60), reward=st.floats(-50.0, 50.0).filter(lambda x: abs(x) > 1e-3),
    gamma=st.floats(0.5, 0.99),
)  # fmt: skip
@example(late=45, idle=30, reward=1.0, gamma=0.99)  # 0.69 of the value, were all rewards of the episode averaged
def test_reward_that_comes_late_is_bounded_as_if_it_never_ended(
    late: int, idle: int, reward: float, gamma: float
) -> None:
    rewards, never = [0.0] * idle + [reward] * late, [False, False]
    ends = [never] * (len(rewards) - 1) + [[True, True]]
    bound = bound_after(gamma, [[each, reward] for each in rewards], truncated=ends).bound
    value = abs(reward) / (1.0 - gamma)
    assert 0.95 * value < float(bound[0]) < 1.001 * value
    assert float(bound[1]) == pytest.approx(value, rel=1e-3)


def test_a_residual_network_adds_normalised_layers() -> None:
    net = ResidualMLP(3, (8, 8, 8), 2, 1.0, torch.Generator().manual_seed(0), "relu")
    x = torch.randn(5, 3, generator=torch.Generator().manual_seed(1))

    def normal(y: Tensor) -> Tensor:
        return (y - y.mean(1, keepdim=True)) / (y.var(1, correction=0, keepdim=True) + 1e-5).sqrt()

    weights = [layer.weight for layer in net.modules() if isinstance(layer, torch.nn.Linear)]
    assert [tuple(w.shape) for w in weights] == [(8, 3), (8, 8), (8, 8), (8, 8), (8, 8), (2, 8)]
    y = normal(x @ weights[0].T).relu()
    for first, second in (weights[1:3], weights[3:5]):
        y = y + normal(normal(y @ first.T).relu() @ second.T)
    assert_close(net(x), y @ weights[5].T, rtol=1e-4, atol=1e-5)


SHARED = OFF_POLICY | {"critic_hidden": (32, 32), "updates_per_step": 2, "tau": 0.1, "atoms": 51}
FAST = FastTD3Config(**SHARED | {"updates_per_step": 4}, critic_layer_norm=False, n_steps=1, squash_price=0.0)
SMALL = BRCConfig(**SHARED, n_steps=1, task_embedding=4, init_alpha=0.01, target_entropy_per_action=-2.0)
both = pytest.mark.parametrize(("kind", "config"), [(FastTD3, FAST), (BRC, SMALL)], ids=["fasttd3", "brc"])


DRAW = a_draw(-3.0, (1, 2, 3, 1, 1, 3))


def distributions(learner: Any, obs: Tensor, actions: Tensor) -> Tensor:
    x = torch.cat([obs, actions], dim=1)
    return torch.stack([net(x).detach().double().softmax(1) for net in learner.target_critic.nets])


def projected(learner: Any, draw: Transitions, rewards: Tensor, following: Tensor, bonus: Tensor) -> Tensor:
    rows = []
    for i in range(6):
        factor = 0.0 if draw.terminated[i] else 0.7 ** int(torch.as_tensor(draw.steps)[i])
        shift = float(rewards[i]) + factor * float(bonus[i])
        rows.append(slow_projection(-10.0, 10.0, following[i].numpy(), shift, factor))
    return torch.from_numpy(np.stack(rows))


TWO: dict[str, Any] = {"gamma": 0.7, "batch_per_task": 3, "cut_share": 1.0}


@pytest.mark.parametrize("lower", [True, False])
def test_fasttd3s_target_is_that_of_the_definition(lower: bool) -> None:
    world = ToyWorld([nearness(0.5), nearness(-0.5)], rows=3)
    learner, draw = FastTD3(world, replace(FAST, **TWO, clipped_double_q=lower), seed=0), DRAW
    with torch.no_grad():  # away from whatever was copied of it
        next(learner.policy.actor.parameters()).mul_(3.0)
    shake(learner.target_critic)
    learner.returns.stats.var.copy_(torch.tensor([4.0, 0.25]))
    learner.returns.bound.copy_(torch.tensor([1.0, 50.0]))  # deviation 2 counts, and 50 / 10
    again = learner.generator.clone_state()
    target = learner._target(draw, draw.next_obs)
    noise = (0.2 * torch.randn(6, 2, generator=again)).clamp(-0.5, 0.5)
    actions = (learner.policy.actor(draw.next_obs) + noise).clamp(-1, 1)
    probs = distributions(learner, draw.next_obs, actions.detach())
    means = (probs * torch.linspace(-10, 10, 51).double()).sum(2)
    choice = (means[1] < means[0]).long()
    assert 0 < choice.sum() < 6
    following = probs[choice, torch.arange(6)] if lower else probs.mean(0)
    rewards = draw.rewards / torch.tensor([2.0] * 3 + [5.0] * 3)
    expected = projected(learner, draw, rewards, following, torch.zeros(6))
    assert_close(target.double(), expected, rtol=1e-4, atol=1e-5)


def test_brcs_target_is_that_of_the_definition() -> None:
    world = ToyWorld([nearness(0.5), nearness(-0.5)], rows=3)
    learner, draw = BRC(world, replace(SMALL, **TWO), seed=0), DRAW
    shake(learner.target_critic)
    with torch.no_grad():
        learner.log_alpha.copy_(torch.tensor([0.1, 0.9]).log())
    learner.returns.bound.copy_(torch.tensor([4.0, 50.0]))
    again = learner.generator.clone_state()
    target = learner._target(draw, draw.next_obs)
    actions, log_prob = learner.policy.sample(draw.next_obs, again)
    following = distributions(learner, draw.next_obs, actions.detach()).mean(0)
    # Two actions have an entropy of 2 each in every future step; for the second task this is more than half of the
    # range.
    rooms = [10.0 - 0.1 * 4.0 / 0.3, 5.0]
    rewards = draw.rewards / torch.tensor([4.0 / rooms[0]] * 3 + [50.0 / rooms[1]] * 3)
    bonus = -torch.tensor([0.1] * 3 + [0.9] * 3) * log_prob.detach()
    assert_close(target.double(), projected(learner, draw, rewards, following, bonus), rtol=1e-4, atol=1e-5)


@both
def test_the_critics_loss_is_the_cross_entropy(kind: Any, config: Any) -> None:
    learner, draw = kind(opposite_bandits(rows=6), replace(config, batch_per_task=3), seed=0), DRAW
    target = torch.rand(6, 51, generator=torch.Generator().manual_seed(2)).softmax(1)
    losses, values = learner._critic_losses(draw.obs, draw.actions, target)
    x = torch.cat([draw.obs, draw.actions], dim=1)
    logs = torch.stack([net(x).double().log_softmax(1) for net in learner.critic.nets])
    assert_close(losses.double(), -(target * logs).sum(2), rtol=1e-4, atol=1e-5)
    assert_close(values.double(), (logs[0].exp() * torch.linspace(-10, 10, 51)).sum(1), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("one", [True, False])
def test_one_temperature_or_one_for_each_task(one: bool) -> None:
    learner = trained(BRC, opposite_bandits(rows=8), replace(SMALL, one_temperature=one), 2)
    first, second = learner.log_alpha.tolist()
    assert (first == second) == one and first != pytest.approx(torch.tensor(0.01).log().item())


@both
def test_weights_decay_but_no_temperature(kind: Any, config: Any) -> None:
    learner = kind(opposite_bandits(rows=6), replace(config, weight_decay=0.5), seed=0)
    decays = {name: adam.param_groups[0]["weight_decay"] for name, adam in learner.adams.items()}
    assert decays == {"actor": 0.5, "critic": 0.5} | ({"alpha": 0.0} if kind is BRC else {})


@both
def test_wide_critics_are_counted_as_memory(kind: Any, config: Any) -> None:
    wide = replace(config, critic_hidden=(4096, 4096, 4096))
    # These are two critics with two more matrices of 4096 by 4096 each, with gradient and two moments, in float32.
    assert wide.bytes_held(64, 500) - config.bytes_held(64, 500) > 2 * 2 * 4096**2 * 4 * 4
