"""The worlds that a config names: suites, single classes, Meta-World's suites and the humanoid behind one interface."""

from bidex_meta.worlds.base import Worlds, WorldsConfig
from bidex_meta.worlds.opening import listed, open_worlds, suites_to_run

__all__ = ["Worlds", "WorldsConfig", "listed", "open_worlds", "suites_to_run"]
