"""What ``bidex-meta bench`` measures."""

from bidex_meta.bench.capacity import capacity
from bidex_meta.bench.gpu import gpu, kernels
from bidex_meta.bench.physics import stability
from bidex_meta.bench.speed import mixing, scaling, world

__all__ = ["capacity", "gpu", "kernels", "mixing", "scaling", "stability", "world"]
