"""What ``bidex-meta bench`` measures."""

from bidex_meta.bench.physics import stability
from bidex_meta.bench.speed import mixing, scaling, world

__all__ = ["mixing", "scaling", "stability", "world"]
