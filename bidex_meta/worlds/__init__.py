"""The worlds that a config names: suites, single classes, Meta-World's suites and the humanoid behind one interface."""

from bidex_meta.worlds.base import WorldConfig, Worlds, listed, suites_to_run

__all__ = ["WorldConfig", "Worlds", "listed", "suites_to_run"]
