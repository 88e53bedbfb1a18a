"""MADDPG on a game of two agents whose optimum is known, and as one agent."""

from typing import Any

import pytest
import torch
from torch import Tensor

from bidex_algos.multiagent.maddpg import MADDPG, MADDPGConfig
from bidex_algos.offpolicy.ddpg import DDPG, DDPGConfig
from bidex_algos.replay import Transitions
from tests.algos.problems import opposite_bandits
from tests.algos.toy import ToyWorld

PAIR = "a=action/1;b=action/0"
SMALL: dict[str, Any] = {
    "hidden": (32, 32), "autocast": "off", "batch_size": 128, "learning_rate": 2e-3, "critic_learning_rate": 3e-3,
    "warmup_steps": 8, "replay_steps": 200, "policy_heads": False, "tau": 0.05, "squash_price": 0.0,
}  # fmt: skip


def rosenbrock(action: Tensor) -> Tensor:
    first, second = action.unbind(1)
    return 1.0 - 2.0 * (second - first.square()).square() - (first - 0.5).square()


def test_two_agents_find_a_coupled_optimum() -> None:
    world = ToyWorld([rosenbrock], rows=32, horizon=1, terminal=True)
    learner = MADDPG(world, MADDPGConfig(agents=PAIR, **SMALL), seed=0)
    for _ in range(25):
        learner.iterate()
    obs, _ = world.reset(seed=1)
    assert learner.eval_action(obs).mean(0).tolist() == pytest.approx([0.5, 0.25], abs=0.1)


@pytest.mark.parametrize("heads", [False, True])
def test_one_agent_is_ddpg(heads: bool) -> None:
    options = SMALL | {"policy_heads": heads, "squash_price": 0.5}
    one, other = (
        DDPG(opposite_bandits(), DDPGConfig(**options), seed=1),
        MADDPG(opposite_bandits(), MADDPGConfig(agents="single", **options), seed=1),
    )
    for _ in range(3):
        told = [learner.iterate() for learner in (one, other)]
        assert told[0]["Loss/critic"] == pytest.approx(told[1]["Loss/critic"], abs=1e-5)
    weights = [torch.cat([p.detach().flatten() for p in each.policy.actor.parameters()]) for each in (one, other)]
    torch.testing.assert_close(*weights, rtol=0, atol=1e-5)


def test_an_agent_climbs_beside_what_the_others_did() -> None:
    """Its slope is that of a critic fed with the replay's actions of the others, by autograd on one agent alone."""
    learner = MADDPG(opposite_bandits(), MADDPGConfig(agents=PAIR, **SMALL), seed=0)
    for _ in range(3):
        learner.iterate()
    draw: Transitions = learner.replay.take(learner.replay.draw(1, learner.batch_per_task, learner.generator)[0])
    obs, actor = learner.policy.observations(draw.obs), learner.policy.actor
    count = len(obs)
    net = actor.nets[0]  # agent a, whose action is the second
    joint = torch.stack([draw.actions[:, 0], torch.tanh(net(obs))[:, 0]], 1)
    expected = torch.autograd.grad(-learner.critic(obs, joint, learner.task_of_draw)[0].mean(), net.head.weight)[0]
    seen: list[Tensor] = []
    learner.adams["actor"].step = lambda: seen.append(net.head.weight.grad.clone())  # type: ignore[method-assign]
    learner.config.__dict__["max_grad_norm"] = 1e9
    counts = torch.full((2,), count / 2)
    learner._policy_step(obs, draw, torch.ones(count), counts)
    torch.testing.assert_close(seen[0], expected, rtol=1e-3, atol=1e-5)
