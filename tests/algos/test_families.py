import numpy as np
import pytest
import torch

from bidex_meta.errors import BidexError
from tests.algos.families import PointClass, PointGoals, circle

TWO = (PointClass("Short", steps=5, count=3), PointClass("Long", steps=8, scale=100.0, count=2))


def play(world: PointGoals, action: torch.Tensor | None = None) -> torch.Tensor:
    """Return of one episode in all rows, (N,)."""
    obs, _ = world.reset()
    total = torch.zeros(world.num_envs)
    for _ in range(int(world.max_episode_steps.max())):
        obs, reward, _, _, _ = world.step(world.best(obs) if action is None else action)
        total += reward
    return total


def test_goals_hold_over_episodes_and_are_hidden_unless_visible():
    world, shown = PointGoals(16), PointGoals(16, goal_visible=True)
    assert world.task_index.tolist() == [*range(8), *range(8)]
    for _ in range(2):
        hidden, _ = world.reset()
        visible, _ = shown.reset()
        assert torch.equal(hidden[:, :2], visible[:, :2]) and not hidden[:, 2:].any()
        assert torch.allclose(visible[:, 2:], torch.from_numpy(np.tile(circle(8), (2, 1))).float())
    assert play(shown).mean() > -6.0
    assert play(world, torch.zeros(16, 2)).mean() < -18.0


def test_finished_rows_are_frozen_until_reset():
    world = PointGoals(4, classes=TWO)
    obs, _ = world.reset(seed=3)
    for t in range(8):
        obs, reward, terminated, truncated, info = world.step(torch.ones(4, 2))
        assert truncated[:2].all() == (t >= 4) and not terminated.any()
        assert bool(info["counted"][0]) == (t == 4)
    assert reward[:2].tolist() == [0, 0] and (reward[2:] < 0).all()
    assert torch.equal(info["so_far"]["l"], torch.tensor([5, 5, 8, 8]))
    again, _ = world.reset(options={"reset_mask": torch.tensor([True, False, False, False])})
    assert torch.equal(again[1:], obs[1:]) and not torch.equal(again[0], obs[0])


def test_set_tasks_takes_effect_with_a_full_reset():
    world = PointGoals(4, goal_visible=True, classes=TWO)
    world.reset(seed=0)
    world.set_tasks({"Long": np.array([[0.5, 0.0], [0.0, 0.5]])})
    with pytest.raises(BidexError):
        world.step(torch.zeros(4, 2))
    assert world.reset()[0][3, 2:].tolist() == [0.0, 0.5]
    for wrong in ({"Middle": circle(2)}, {"Long": np.zeros((2, 3))}):
        with pytest.raises(BidexError):
            world.set_tasks(wrong)


def test_a_restored_world_goes_on_bit_for_bit():
    world, other = PointGoals(6), PointGoals(6, seed=9)
    world.set_tasks({"PointGoals": circle(3, 0.1)})
    world.reset(seed=5)
    for _ in range(4):
        world.step(torch.ones(6, 2))
    other.load_state_dict(world.state_dict())
    for _ in range(20):
        a, b = world.step(-torch.ones(6, 2)), other.step(-torch.ones(6, 2))
        assert all(map(torch.equal, a[:4], b[:4]))
    assert torch.equal(world.reset()[0], other.reset()[0])


def test_an_unstable_row_ends_without_success():
    world = PointGoals(3, unstable=((1, 2),), garbage=float("nan"))
    world.reset()
    world.step(torch.zeros(3, 2))
    _, reward, _, truncated, info = world.step(torch.zeros(3, 2))
    assert truncated.tolist() == info["unstable"].tolist() == [False, False, True]
    assert reward.isnan().tolist() == [False, False, True]
    assert world.step(torch.zeros(3, 2))[1][2] == 0
