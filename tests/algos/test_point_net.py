"""PointNet: a set goes in, not a list; and the short way back gives the gradients of the long one."""

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from bidex_algos.nets.point_net import PointNet, _largest_of


def net(points: int, channels: int = 3, **config: Any) -> PointNet:
    generator = torch.Generator().manual_seed(0)
    return PointNet(points * channels, generator, (8, 16), channels, **config)


def clouds(points: int, channels: int = 3) -> Tensor:
    return torch.randn(5, points, channels, generator=torch.Generator().manual_seed(1)) * 0.1


def test_order_and_repetition_of_points_do_not_matter_but_for_the_centre() -> None:
    made, cloud = net(40), clouds(40)
    shuffled = cloud[:, torch.randperm(40, generator=torch.Generator().manual_seed(2))]
    assert_close(made(cloud.flatten(1)), made(shuffled.flatten(1)))
    twice = torch.cat((cloud, cloud), dim=1)
    assert_close(made(cloud.flatten(1)), net(80)(twice.flatten(1)))
    away = cloud + torch.tensor([1.0, -2.0, 0.5])
    before, after = made(cloud.flatten(1)), made(away.flatten(1))
    assert_close(after[:, :-3], before[:, :-3], atol=1e-4, rtol=1e-4)
    assert_close(after[:, -3:] - before[:, -3:], torch.tensor([[1.0, -2.0, 0.5]]).expand(5, 3))


@pytest.mark.parametrize("channels", [3, 4])
def test_the_gradient_through_the_largest_points_is_that_through_all(channels: int) -> None:
    made, cloud = net(40, channels), clouds(40, channels)
    made(cloud.flatten(1)).square().sum().backward()
    short = [weights.grad.clone() for weights in made.parameters() if weights.grad is not None]
    made.zero_grad()
    centre = cloud[..., :3].mean(dim=1, keepdim=True)
    points = torch.cat(((cloud[..., :3] - centre) / 0.2, cloud[..., 3:]), dim=2)
    features = made.shared(points).max(dim=1).values
    features.square().sum().backward()
    for mine, weights in zip(short, made.parameters(), strict=True):
        assert_close(mine, weights.grad)
    with torch.no_grad():
        assert_close(made(cloud.flatten(1))[:, :-3], features.detach())


@pytest.mark.parametrize("points", [1, 7, 100, 256])
def test_the_largest_is_found_by_blocks(points: int) -> None:
    values = torch.randn(3, points, 9, generator=torch.Generator().manual_seed(3))
    assert torch.equal(_largest_of(values), values.argmax(dim=1))


def test_points_read_leaves_points_out_evenly() -> None:
    made, cloud = net(40, read=10), clouds(40)
    changed = cloud.clone()
    changed[:, 1::4] += 1.0
    assert torch.equal(made(cloud.flatten(1)), made(changed.flatten(1)))
    changed[:, 0] += 1.0
    assert not torch.equal(made(cloud.flatten(1)), made(changed.flatten(1)))
