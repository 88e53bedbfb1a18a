"""What ``bidex-meta bench`` measures."""

from bidex_meta.bench.gpu import gpu, kernels
from bidex_meta.bench.physics import stability
from bidex_meta.bench.speed import mixing, scaling, world

__all__ = ["gpu", "kernels", "mixing", "scaling", "stability", "world"]
