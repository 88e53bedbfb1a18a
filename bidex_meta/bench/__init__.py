"""What ``bidex-meta bench`` measures."""

from bidex_meta.bench.adapters import clients
from bidex_meta.bench.against import world_against
from bidex_meta.bench.capacity import capacity
from bidex_meta.bench.clouds import points
from bidex_meta.bench.gpu import gpu, kernels
from bidex_meta.bench.others import field
from bidex_meta.bench.physics import stability
from bidex_meta.bench.soak import soak
from bidex_meta.bench.speed import mixing, scaling, world

__all__ = [
    "capacity",
    "clients",
    "field",
    "gpu",
    "kernels",
    "mixing",
    "points",
    "scaling",
    "soak",
    "stability",
    "world",
    "world_against",
]
