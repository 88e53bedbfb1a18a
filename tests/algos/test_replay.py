"""Observations count vector steps and rows, so that a transition says where it comes from: 100 step + row."""

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from bidex_algos.replay import Replay, replay_bytes, steps_within
from bidex_meta.errors import BidexError
from tests.algos.ranks import same

ROWS = 5
TASKS = torch.tensor([0, 0, 1, 1, 1])
CPU = torch.device("cpu")


def mark(step: float) -> Tensor:
    return (100.0 * step + torch.arange(ROWS))[:, None].expand(ROWS, 2).clone()


def make(steps: int = 6, cut_share: float = 1.0) -> Replay:
    replay = Replay(steps, TASKS, 2, 2, 1, CPU, cut_share)
    replay.begin(mark(0))
    return replay


def add(replay: Replay, *, terminated: Any = (), truncated: Any = (), unstable: Any = ()) -> None:
    t = replay.added

    def flags(rows: Any) -> Tensor:
        return torch.tensor([row in rows for row in range(ROWS)])

    info = {"unstable": flags(unstable), "final_obs": mark(t + 0.5)}
    replay.add(
        -mark(t)[:, :1], mark(t)[:, 0] + 0.5, flags(terminated), flags(truncated) | flags(unstable), mark(t + 1), info
    )


def everything(replay: Replay) -> Tensor:
    newest = range(replay.added - replay.filled, replay.added)
    return torch.tensor([step % replay.slots * ROWS + row for step in newest for row in range(ROWS)])


def test_a_transition_is_what_happened():
    replay = make()
    for t in range(20):
        add(replay, terminated=[t % 5], truncated=[(t + 1) % 5])
    places = everything(replay)
    got = replay.take(places)
    step = torch.arange(14, 20).repeat_interleave(ROWS).float()
    row = torch.arange(ROWS).repeat(6).float()
    terminated = row == step % 5
    assert_close(got.obs, (100 * step + row)[:, None].expand(-1, 2))
    assert_close(got.actions, -(100 * step + row)[:, None])
    assert_close(got.rewards, 100 * step + row + 0.5)
    assert torch.equal(got.terminated, terminated)
    cut = row == (step + 1) % 5
    follows = torch.where(cut, 100 * (step + 0.5) + row, 100 * (step + 1) + row)
    assert_close(got.next_obs[~terminated], follows[~terminated, None].expand(-1, 2))
    assert replay.weights(places).eq(1).all()


def test_draws_are_per_task_and_reach_all_that_is_kept_and_nothing_else():
    replay, g = make(), torch.Generator().manual_seed(0)
    for filled in (1, 3, 6, 6):
        while replay.added < filled or (replay.added < 11 and filled == 6):
            add(replay)
        places = replay.draw(3, 400, g)
        assert places.shape == (3, 2 * 400)
        for part, rows in zip(places.view(3, 2, 400).unbind(1), ({0, 1}, {2, 3, 4}), strict=True):
            assert set((part % ROWS).flatten().tolist()) == rows
        assert set(places.flatten().tolist()) == set(everything(replay).tolist())


def test_a_last_observation_that_is_no_longer_kept_costs_the_weight_and_no_more():
    replay = make(steps=8, cut_share=0.01)
    assert replay.cuts_kept == ROWS
    for t in range(8):
        add(replay, truncated=[0, 1] if t % 2 == 0 else [])
    # There are eight ends and room for five, so the first three are gone.
    places = everything(replay)
    weights = replay.weights(places).view(8, ROWS)
    lost = [(t, row) for t in range(8) for row in range(ROWS) if weights[t, row] == 0]
    assert lost == [(0, 0), (0, 1), (2, 0)]
    cut = torch.tensor([2 * ROWS + 1, 4 * ROWS, 6 * ROWS + 1])
    assert_close(replay.take(cut).next_obs[:, 0], torch.tensor([251.0, 450.0, 651.0]))


@pytest.mark.parametrize("steps", [3, 6, 7, 17])
def test_what_is_saved_is_what_is_filled_and_continues_alike(steps: int):
    replay = make()
    for t in range(steps):
        add(replay, truncated=[t % 5], unstable=[(t + 2) % 5])
    state = replay.state_dict()
    assert len(state["actions"]) == min(steps, 7) and len(state["obs"]) == min(steps + 1, 7)
    assert len(state["final_obs"]) == min(steps, replay.cuts_kept)
    kept = state["obs"].clone()
    again = make()
    again.load_state_dict(state)
    for t in range(4):
        for one in (replay, again):
            add(one, truncated=[t], terminated=[t + 1])
    assert torch.equal(state["obs"], kept)
    assert same(replay.state_dict(), again.state_dict())
    draws = [one.draw(1, 50, torch.Generator().manual_seed(0))[0] for one in (replay, again)]
    assert torch.equal(*draws)
    assert torch.equal(replay.weights(draws[0]), again.weights(draws[0]))
    assert same(vars(replay.take(draws[0])), vars(again.take(draws[0])))


def test_a_replay_of_another_size_is_refused():
    with pytest.raises(BidexError, match=r"\(6, 5, 2\), this one has \(7, 5, 2\)"):
        make(steps=7).load_state_dict(make(steps=6).state_dict())


@pytest.mark.parametrize("cut_share", [0.01, 0.25, 1.0])
def test_the_bytes_are_counted_and_the_bound_is_kept(cut_share: float):
    replay = Replay(40, TASKS, 2, 11, 3, CPU, cut_share)
    tensors = [replay._obs, replay._final_obs, *replay._steps.values()]
    size = replay_bytes(40, ROWS, 11, 3, cut_share)
    assert size == sum(x.numel() * x.element_size() for x in tensors)
    assert steps_within(size, 40, ROWS, 11, 3, cut_share) == 40
    assert steps_within(size, 400, ROWS, 11, 3, cut_share) == 40
    assert steps_within(size - 1, 400, ROWS, 11, 3, cut_share) == 39
    assert steps_within(10, 400, ROWS, 11, 3, cut_share) == 0
