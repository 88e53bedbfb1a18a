import hypothesis.strategies as st
import torch
from hypothesis import given, settings
from torch import Tensor, nn
from torch.testing import assert_close

from bidex_algos.balancing import per_task_gradients, project_conflicting


def in_a_loop(gradients: Tensor) -> Tensor:
    """PCGrad as the paper writes it, task by task, in cyclic order."""
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


def test_gradients_that_agree_are_summed():
    gradients = torch.tensor([[1.0, 0.0], [1.0, 1.0], [0.0, 2.0]])
    found, apart = project_conflicting(gradients)
    assert torch.equal(found, gradients.sum(0)) and apart == 0.0


def test_two_that_conflict_lose_what_points_against_the_other():
    found, apart = project_conflicting(torch.tensor([[1.0, 0.0], [-1.0, 1.0]]))
    assert_close(found, torch.tensor([0.5, 0.5]) + torch.tensor([0.0, 1.0]))
    assert apart == 1.0


def test_a_task_without_a_gradient_changes_nothing():
    gradients = torch.tensor([[1.0, 0.0], [0.0, 0.0]])
    assert torch.equal(project_conflicting(gradients)[0], gradients[0])


def test_gradients_per_task_are_those_of_each_loss():
    layer = nn.Linear(3, 2)
    x = torch.randn(2, 3)
    losses = layer(x).square().sum(1)
    found = per_task_gradients(losses, list(layer.parameters()))
    for row, loss in zip(found, losses, strict=True):
        one = torch.autograd.grad(loss, list(layer.parameters()), retain_graph=True)
        assert_close(row, torch.cat([g.flatten() for g in one]))
