import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import bidex_meta.world.starts as starts_module
from bidex_meta.world.random import env_keys, threefry, uniform
from tests.world.play import assert_same, number_of_ends, play, random_actions, suite_world

CPU = torch.device("cpu")


def words(*values: int) -> tuple[torch.Tensor, torch.Tensor]:
    first, second = (torch.tensor([value]) for value in values)
    return first, second


@pytest.mark.parametrize(
    ("key", "counter", "expected"),
    [
        ((0, 0), (0, 0), (0x6B200159, 0x99BA4EFE)),
        ((0xFFFFFFFF, 0xFFFFFFFF), (0xFFFFFFFF, 0xFFFFFFFF), (0x1CB996FC, 0xBB002BE7)),
        ((0x13198A2E, 0x03707344), (0x243F6A88, 0x85A308D3), (0xC4923A9C, 0x483DF7A0)),
    ],
)
def test_threefry_gives_the_published_answers(
    key: tuple[int, int], counter: tuple[int, int], expected: tuple[int, int]
) -> None:
    """Known answers of Random123 for Threefry-2x32 with 20 rounds."""
    assert tuple(int(word) for word in threefry(words(*key), words(*counter))) == expected


def test_uniform_numbers_look_uniform() -> None:
    values = uniform(env_keys(0, "A", 2000, CPU), torch.arange(2000) % 7, 31)
    assert values.shape == (2000, 31) and values.dtype == torch.float64
    assert float(values.min()) >= 0.0 and float(values.max()) < 1.0
    assert torch.equal(values, values.float().double())
    assert abs(float(values.mean()) - 0.5) < 5 * (1 / 12 / values.numel()) ** 0.5
    assert abs(float(values.var()) - 1 / 12) < 1e-3
    assert (values.mean(dim=0) - 0.5).abs().max() < 5 * (1 / 12 / 2000) ** 0.5
    correlation = torch.corrcoef(values.T) - torch.eye(31)
    assert correlation.abs().max() < 0.11
    assert torch.histc(values, 16, 0, 1).sub(values.numel() / 16).abs().max() < 5 * (values.numel() / 16) ** 0.5


def test_rows_episodes_draws_seeds_and_names_differ() -> None:
    keys = env_keys(0, "A", 100, CPU)
    values = uniform(keys, torch.zeros(100, dtype=torch.int64), 20)
    assert values.unique().numel() > 1990
    assert (values != uniform(keys, torch.ones(100, dtype=torch.int64), 20)).float().mean() > 0.99
    for seed, name in ((1, "A"), (0, "B"), (10, "A")):
        assert (env_keys(seed, name, 100, CPU) != keys).any(dim=1).all()


@given(st.lists(st.integers(0, 99), min_size=1, max_size=20), st.integers(1, 31), st.integers(0, 10**6))
def test_numbers_do_not_depend_on_the_other_rows_or_draws(rows: list[int], draws: int, episode: int) -> None:
    keys, episodes = env_keys(3, "A", 100, CPU), torch.arange(100) + episode
    everything = uniform(keys, episodes, 31)
    chosen = torch.tensor(rows)
    assert torch.equal(uniform(keys[chosen], episodes[chosen], draws), everything[chosen][:, :draws])
    assert torch.equal(env_keys(3, "A", 40, CPU), keys[:40])


def test_how_many_episodes_are_drawn_ahead_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    played = []
    for ahead in (1, 3, 8):
        monkeypatch.setattr(starts_module, "_AHEAD", ahead)
        world = suite_world("MT4", 8)
        world.reset(seed=0)
        played.append(play(world, random_actions(world, 60)))
    assert number_of_ends(played[0]) > 12
    assert_same(played[0], played[1])
    assert_same(played[0], played[2])
