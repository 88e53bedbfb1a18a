"""What ``bidex-meta bench`` measures."""

from bidex_meta.bench.capacity import capacity
from bidex_meta.bench.physics import stability
from bidex_meta.bench.speed import mixing, scaling, world

__all__ = ["capacity", "mixing", "scaling", "stability", "world"]
