"""Losses of several tasks on the way to shared weights: CAGrad and FAMO against closed forms, and in MT-PPO."""

import math

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import example, given, settings
from torch import Tensor
from torch.testing import assert_close

from bidex_algos.balancing import (
    Famo,
    conflict_averse,
    project_conflicting,
    worst_served,
)
from bidex_algos.onpolicy.mtppo import MTPPOConfig

SMALL = MTPPOConfig(
    hidden=(32, 32), rollout_steps=8, learning_rate=1e-3, learning_rate_range=(1e-5, 2e-3), std_range=(0.05, 1.0),
    autocast="off",
)  # fmt: skip
seeds = st.integers(0, 2**31)


def draw(seed: int, tasks: int, entries: int = 5) -> torch.Tensor:
    return torch.randn(tasks, entries, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@settings(max_examples=60, deadline=None)
@given(seeds, st.integers(2, 20), st.integers(1, 30), st.integers(1, 30), st.floats(-4, 0), st.floats(0.05, 0.95))
@example(296, 16, 17, 6, -1.16, 0.87)  # a descent along pairs of weights ended 0.4 below, in squares of the mean
def test_no_direction_serves_the_worst_served_task_better_than_cagrads(
    seed: int, tasks: int, entries: int, rank: int, apart: float, c: float
):
    # Of low rank, or nearly parallel; sizes differ tenfold.
    gradients = draw(seed, 1, entries) * (apart < -2) + 10**apart * draw(seed, tasks, rank) @ draw(seed, rank, entries)
    gradients *= torch.logspace(0, 1, tasks, dtype=torch.float64)[:, None]
    gram, even = gradients @ gradients.T, torch.full((tasks,), 1 / tasks, dtype=torch.float64)
    length = gradients.mean(0).norm()
    direction = conflict_averse(gradients, c)[0] / tasks
    assert (direction - gradients.mean(0)).norm() <= (c + 1e-6) * length
    # Whatever the weights, their dual value is no less than what any direction gives.
    weights = worst_served(gram, even, c * length)
    assert weights.min() >= 0 and weights.sum() == pytest.approx(1, abs=1e-5)
    weights /= weights.sum()
    best = weights @ gram @ even + c * length * (weights @ gram @ weights).clamp_min(0.0).sqrt()
    assert (gradients @ direction).min() >= best - 1e-4 * length.square()


def test_cagrad_without_a_radius_or_a_conflict_is_the_sum():
    gradients = draw(0, 4)
    assert_close(conflict_averse(gradients, 0.0)[0], gradients.sum(0))
    same = gradients[:1].expand(3, -1)
    assert_close(conflict_averse(same, 0.4)[0], 1.4 * same.sum(0))
    assert torch.equal(conflict_averse(torch.zeros(3, 5), 0.4)[0], torch.zeros(5))
    assert_close(conflict_averse(gradients[:1], 0.4)[0], 1.4 * gradients[0])


def test_famo_of_two_losses_is_the_closed_form():
    # l_i = a_i x_i^2 about the least 0, each with a coordinate of its own.
    famo, a, x = Famo(2, rate=0.1, decay=0.0, device=torch.device("cpu")), torch.tensor([1.0, 8.0]), torch.ones(2)
    with torch.no_grad():
        famo.logits.copy_(torch.tensor([0.3, -0.2]))
    z = [1 / (1 + math.exp(-0.5)), 1 / (1 + math.exp(0.5))]
    losses = a * x.square()
    weights = famo.weights(losses)
    total = z[0] / 1.0 + z[1] / 8.0
    assert weights.tolist() == pytest.approx([2 * z[0] / 1.0 / total, 2 * z[1] / 8.0 / total])
    # The direction is the gradient of the mean of log l_i, weighted by z, but for its length.
    slope = weights * 2 * a * x
    assert float(slope[0] / slope[1]) == pytest.approx(z[0] / z[1])
    # The first loss falls to a quarter, the second stays: the second shall weigh more, by J' (log 4, 0).
    famo.learn(lambda: losses * torch.tensor([0.25, 1.0]))
    fallen = math.log(4.0)
    expected = [z[0] * (1 - z[0]) * fallen, -z[1] * z[0] * fallen]
    gradient = famo.logits.grad
    assert gradient is not None and gradient.tolist() == pytest.approx(expected)
    # Adam's first step is its rate long, against the gradient.
    assert famo.logits.tolist() == pytest.approx([0.3 - 0.1, -0.2 + 0.1], abs=1e-5)


def test_famo_leaves_out_a_task_without_samples():
    famo = Famo(3, rate=0.1, decay=0.0, device=torch.device("cpu"))
    weights = famo.weights(torch.tensor([1.0, 0.0, 1.0]))
    assert_close(weights, torch.tensor([1.5, 0.0, 1.5]))
    famo.learn(lambda: torch.tensor([0.5, 3.0, 0.5]))
    assert famo.logits[1] > famo.logits[0] == famo.logits[2]


def in_a_loop(gradients: Tensor) -> Tensor:
    total = torch.zeros_like(gradients[0])
    for i in range(len(gradients)):
        left = gradients[i].clone()
        for shift in range(1, len(gradients)):
            other = gradients[(i + shift) % len(gradients)]
            if left @ other < 0:
                left = left - (left @ other) / (other @ other) * other
        total = total + left
    return total


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 6))
def test_surgery_equals_the_loop_over_tasks(seed: int, tasks: int):
    gradients = torch.randn(tasks, 7, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    assert_close(project_conflicting(gradients)[0], in_a_loop(gradients))
