import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from bidex_algos.advantages import explained_variance, gae, successor_values, task_moments


def draws(seed: int, steps: int, rows: int):
    g = torch.Generator().manual_seed(seed)

    def normal() -> torch.Tensor:
        return torch.randn(steps, rows, generator=g, dtype=torch.float64)

    def flags(p: float) -> torch.Tensor:
        return torch.rand(steps, rows, generator=g) < p

    return normal, flags


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 9), st.integers(1, 5), st.floats(0, 1), st.floats(0, 1))
def test_gae_is_the_sum_of_its_definition(seed: int, steps: int, rows: int, gamma: float, lam: float):
    normal, flags = draws(seed, steps, rows)
    rewards, values, final, last = normal(), normal(), normal(), normal()[0]
    terminated, truncated, valid = flags(0.2), flags(0.2), ~flags(0.15)
    ended = terminated | truncated | ~valid
    following = successor_values(values, last, ended, final)
    got = gae(rewards, values, following, terminated, ended, gamma, lam, valid)
    for n in range(rows):
        for t in range(steps):
            total, discount = 0.0, 1.0
            for k in range(t, steps):
                if not valid[k, n]:
                    break
                after = final[k, n] if ended[k, n] else (values[k + 1, n] if k + 1 < steps else last[n])
                after = 0.0 if terminated[k, n] else after
                total += discount * (rewards[k, n] + gamma * after - values[k, n])
                discount *= gamma * lam
                if ended[k, n]:
                    break
            assert_close(got[t, n], torch.as_tensor(total, dtype=torch.float64), rtol=1e-9, atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 4))
def test_task_moments_are_those_of_the_valid_entries(seed: int, num_tasks: int):
    normal, flags = draws(seed, 6, 8)
    x, valid = normal(), flags(0.8)
    task_id = torch.arange(8) % num_tasks
    mean, var, count = task_moments(x.masked_fill(~valid, float("nan")), task_id, num_tasks, valid)
    for k in range(num_tasks):
        own = x[valid & (task_id == k)]
        assert count[k] == len(own)
        if len(own):
            assert_close(mean[k], own.mean())
            assert_close(var[k], own.var(correction=0))


def test_explained_variance():
    task_id, valid = torch.tensor([0, 0, 1]), torch.ones(50, 3, dtype=torch.bool)
    returns = torch.randn(50, 3)
    values = returns.clone()
    values[:, 2] = 7.0
    assert_close(explained_variance(values, returns, task_id, 2, valid), torch.tensor([1.0, 0.0]), atol=1e-5, rtol=0)
