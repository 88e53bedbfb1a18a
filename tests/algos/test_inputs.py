"""Observations by named groups: wherever the task id stands, whatever encoder reads a group, and the task embedding."""

from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from bidex_algos.meta.promp import ProMP, ProMPConfig
from bidex_algos.nets.inputs import GroupEncoder, Inputs, with_task_embedding
from bidex_algos.nets.networks import MLP, GaussianActor
from bidex_algos.nets.normalise import ObservationNormaliser
from bidex_algos.nets.point_net import PointNet
from bidex_algos.nets.policy import SquashedActor
from bidex_algos.nets.shape import Shape
from bidex_algos.offpolicy.mtsac import MTSAC, MTSACConfig
from bidex_algos.onpolicy.mtppo import MTPPO, MTPPOConfig
from bidex_meta.agents import Timestep
from bidex_meta.errors import BidexError
from bidex_meta.world.contract import ObservationGroup, plain_groups
from tests.algos.families import PointGoals
from tests.algos.problems import opposite_bandits

PPO = MTPPOConfig(hidden=(16, 16), learning_rate=3e-3, autocast="off")
SAC = MTSACConfig(hidden=(16, 16), replay_steps=60, cut_share=0.3, warmup_steps=4, batch_size=64, autocast="off")

# Two cameras' points around the task id: groups with gaps, and the id in the middle.
POINTS = ObservationGroup("points", (slice(0, 3), slice(6, 9)))
SCATTERED = Inputs((POINTS, ObservationGroup("goal", (slice(3, 4),)), ObservationGroup("task_id", (slice(4, 6),))))
ENCODER = partial(PointNet, widths=(8, 4))


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def scattered(rows: int = 6) -> Tensor:
    x = torch.randn(rows, 9, generator=generator())
    x[:, 4:6] = torch.eye(2)[torch.arange(rows) % 2]
    return x


def test_encoded_groups_stand_behind_the_others() -> None:
    inputs, x = with_task_embedding(SCATTERED.encoded("points", ENCODER), 5), scattered()
    encoder = GroupEncoder(inputs, generator())
    out = encoder(x)
    assert out.shape == (6, encoder.size) == (6, 1 + 7 + 5)
    assert torch.equal(out[:, :1], x[:, 3:4])
    points: Any = encoder.groups["points"]
    assert torch.equal(out[:, 1:8], points(x[:, [0, 1, 2, 6, 7, 8]]))
    swapped = x[:, [6, 7, 8, 3, 4, 5, 0, 1, 2]]
    assert torch.equal(encoder(swapped), out)


def test_unknown_groups_are_named() -> None:
    with pytest.raises(BidexError, match=r"observation group.*'goals'.*goal"):
        SCATTERED.only("goals")
    with pytest.raises(BidexError, match=r"observation group.*'cloud'"):
        SCATTERED.encoded("cloud", ENCODER)


def test_heads_and_statistics_find_the_task_id_in_the_middle() -> None:
    x = scattered()
    gaussian = GaussianActor(SCATTERED, (8,), 3, 0.8, generator(), heads=2)
    squashed = SquashedActor(SCATTERED, (8,), 3, 2, 0.5, (0.1, 2.0), generator(), "relu")
    before = gaussian(x), gaussian.log_std_of(x), squashed(x)[0]
    with torch.no_grad():
        gaussian.mean.head.bias[3:] += 1.0  # the second head's
        gaussian.log_std[1] += 1.0
        squashed.net.head.bias[6:9] += 1.0
    added = torch.tensor([0.0, 1.0] * 3)[:, None].expand(6, 3)
    for was, now in zip(before, (gaussian(x), gaussian.log_std_of(x), squashed(x)[0]), strict=True):
        assert_close(now - was, added)
    normaliser = ObservationNormaliser(SCATTERED)
    normaliser.update(x)
    rest, out = [0, 1, 2, 3, 6, 7, 8], normaliser(x)
    assert torch.equal(out[:, 4:6], x[:, 4:6])
    assert_close(out[:, rest].mean(0), torch.zeros(7), atol=1e-5, rtol=0)
    assert_close(normaliser.stats.mean.float(), x[:, rest].mean(0))


def test_kept_statistics_stay_but_where_a_column_has_not_varied() -> None:
    normaliser, obs = ObservationNormaliser(2), torch.randn(50, 2, generator=generator())
    obs[:, 1] = 0.5
    normaliser.update(obs)
    normaliser.keep()
    again = ObservationNormaliser(2)
    again.load_state_dict(normaliser.state_dict())  # a resumed run keeps them too
    before = normaliser(obs)[:, 0]
    for each in (normaliser, again):
        each.update(obs.roll(1, 1) + 1.0)
        assert torch.equal(each(obs)[:, 0], before)
        assert each.shift[1] > 0.6 and each.scale[1] < 100


def test_an_embedding_tells_tasks_apart_and_is_learned() -> None:
    learner = MTSAC(opposite_bandits(), replace(SAC, task_embedding=4), seed=0)
    actor = next(net for net in learner.policy.actor.children() if isinstance(net, MLP))
    critics = list(learner.critic.nets)
    x = torch.cat([torch.zeros(2, 1), torch.eye(2)], dim=1)
    one, other = actor.encoder(x)
    assert actor.encoder.size == 1 + 4 and one[0] == other[0] and (one[1:] != other[1:]).all()
    tables = [net.encoder.groups["task_id"].vectors for net in (actor, *critics)]
    before = [table.detach().clone() for table in tables]
    assert not torch.equal(before[0], before[1])  # each network has its own
    for _ in range(2):
        learner.iterate()
    for table, was in zip(tables, before, strict=True):
        assert (table != was).any(1).all()


@pytest.mark.parametrize("autocast", ["off", "on"])
def test_the_rollout_and_the_update_compute_alike(autocast: str) -> None:
    config = replace(PPO, autocast=autocast, epochs=1, num_minibatches=1)
    learner = MTPPO(opposite_bandits(), config, seed=0)
    learner.iterate()
    assert learner.iterate()["Policy/kl"] < 1e-12


class CloudProMP(ProMP):
    """Has an encoder of its own, as a learner from outside would."""

    @classmethod
    def _inputs(cls, config: Any, shape: Shape) -> Inputs:
        return super()._inputs(config, shape).encoded("cloud", ENCODER, scaled=False)


def test_an_inner_step_leaves_encoders_alone() -> None:
    world = PointGoals(rows=12)
    world.observation_groups = (ObservationGroup("cloud", (slice(0, 3),)), ObservationGroup("rest", (slice(3, 4),)))
    learner = CloudProMP(world, ProMPConfig(hidden=(8,), tasks_per_class=4, max_adapt_steps=8), 0)
    policy = learner.policy
    obs, _ = learner.world.reset()
    policy.assign(torch.arange(12) // 4)
    action, aux = policy.adapt_action(obs)
    meta = policy.adapter.meta(3)
    assert_close(policy.adapter.distribution(meta, obs.view(3, 4, -1))[0].flatten(0, 1), aux["mean"])
    done = torch.ones(12, dtype=torch.bool)
    policy.step(Timestep(obs, action, torch.randn(12), ~done, done, aux, done))
    policy.adapt()
    moved = {name for name, own in policy.adapted.items() if (own != meta[name]).any()}
    assert moved and not [name for name in moved if ".groups." in name]


def test_a_shape_is_kept_in_a_checkpoint() -> None:
    shape = Shape(9, 2, SCATTERED.groups)
    assert Shape.load(shape.state_dict()) == shape and shape.num_id_columns == 2
    assert Shape.of(opposite_bandits()) == Shape(3, 2, plain_groups(3, 2))


def test_a_column_that_was_constant_is_not_amplified() -> None:
    """Padding in training may be another object of an unseen class."""
    normaliser, obs = ObservationNormaliser(3), torch.randn(50, 3, generator=generator())
    obs[:, 1] = 0.0
    obs[:, 2] = 0.3
    normaliser.update(obs)
    seen = normaliser(torch.tensor([[0.0, 0.7, 0.5]]))
    assert_close(seen[0, 1:], torch.tensor([0.7, 0.2]))
