"""PointNet (Qi et al. 2017, arXiv 1612.00593) without transforms: a shared network on each point, then the maximum."""

import math
from collections.abc import Sequence
from functools import partial
from typing import cast

import torch
from torch import Tensor, nn

from bidex_algos.nets.inputs import Inputs
from bidex_algos.nets.products import Linear
from bidex_meta.errors import BidexError
from bidex_meta.training.learner import LearnerConfig

POINT_GROUPS = {"points": 3, "kind_points": 4}  # observation groups that are point clouds, and the values per point
_SPREAD = 0.2  # metres, about a hand's length; distances from a cloud's centre are divided by this length
_CACHED = 1 << 19  # number of outputs of a layer that a CPU computes at once


class PointNet(nn.Module):
    """Maps point clouds (..., entries) to features (..., size).

    The features are the maximum of each learned feature over all points, and the centre of the cloud (metres). A point
    has ``channels`` values; the first three are its position. The layers read positions relative to the cloud's centre,
    so that they see shapes rather than the place of the hands.
    """

    def __init__(self, entries: int, generator: torch.Generator, widths: Sequence[int], channels: int = 3):
        super().__init__()
        self.channels = channels
        self.size = widths[-1] + 3
        layers: list[nn.Module] = []
        for before, after in zip((channels, *widths[:-1]), widths, strict=True):
            layer = Linear(before, after)
            nn.init.orthogonal_(layer.weight, math.sqrt(2.0), generator=generator)
            nn.init.zeros_(layer.bias)
            layers += [layer, nn.ReLU()]
        self.shared = nn.Sequential(*layers[:-1])  # the maximum serves as the last non-linearity

    def forward(self, x: Tensor) -> Tensor:
        """Encode point clouds (..., entries) as (..., size)."""
        cloud = x.unflatten(-1, (-1, self.channels))
        place = cloud[..., :3]
        rest = cloud[..., 3:]
        centre = place.mean(dim=-2, keepdim=True)
        points = torch.cat(((place - centre) / _SPREAD, rest), dim=-1)
        return torch.cat((self._largest(points.flatten(0, -3)).view(*x.shape[:-1], -1), centre[..., 0, :]), dim=-1)

    def _largest(self, points: Tensor) -> Tensor:
        """Return the maximum of each feature, (n, features), over points (n, points, channels)."""
        last = cast(nn.Linear, self.shared[-1])
        if not torch.is_grad_enabled() or last.out_features >= points.shape[1]:
            return torch.cat([self.shared(part).amax(dim=1) for part in self._parts(points)])
        # Only the point with the maximum of a feature has a gradient, so we find these points first and differentiate
        # only them.
        with torch.no_grad():
            found = torch.cat([_largest_of(self.shared(part)) for part in self._parts(points)])
        chosen = points.gather(1, found[..., None].expand(-1, -1, points.shape[2]))
        return (self.shared[:-1](chosen) * last.weight).sum(dim=2) + last.bias

    def _parts(self, points: Tensor) -> tuple[Tensor, ...]:
        """Split the clouds into parts; on a CPU the results for each part fit into the cache."""
        if points.device.type != "cpu" or torch.compiler.is_exporting():  # an export is for any number of clouds
            return (points,)
        return points.split(max(1, _CACHED // (points.shape[1] * (self.size - 3))))


def _largest_of(values: Tensor) -> Tensor:
    """Return ``values.argmax(dim=1)`` of (n, points, features), faster on a CPU, where argmax is not vectorised."""
    points = values.shape[1]
    step = next(d for d in range(min(16, points), 0, -1) if points % d == 0)
    blocks = values.unflatten(1, (-1, step))
    block = blocks.amax(dim=2).max(dim=1).indices
    within = blocks.gather(1, block[:, None, None].expand(-1, 1, step, -1))[:, 0].max(dim=1).indices
    return block * step + within


def with_point_net(inputs: Inputs, config: LearnerConfig) -> Inputs:
    """Give each point cloud among the inputs a PointNet as its encoder; point clouds are not normalised.

    Raises BidexError if there is a point cloud but the config has no option ``point_widths``.
    """
    options = vars(config)
    for group in inputs.groups:
        channels = POINT_GROUPS.get(group.name)
        if channels is None:
            continue
        if "point_widths" not in options:
            raise BidexError(
                f"{config.algo} does not read point clouds. Use another learner, such as mtppo or mtsac, or leave "
                "--points (a suite's table [points]) out."
            )
        make = partial(PointNet, widths=tuple(options["point_widths"]), channels=channels)
        inputs = inputs.encoded(group.name, make, scaled=False)
    return inputs
