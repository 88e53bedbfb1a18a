"""The worlds that a config can name: suites, single classes, Meta-World's suites and the humanoid.

All of them have the interface ``Worlds``.
"""

from bidex_meta.worlds.base import Worlds, WorldsConfig
from bidex_meta.worlds.opening import listed, open_worlds, suites_to_run

__all__ = ["Worlds", "WorldsConfig", "listed", "open_worlds", "suites_to_run"]
