"""Where the worlds of a run come from: own suites, single classes, Meta-World's suites, all asked alike."""

from bidex_meta.sources.source import Source, source_names

__all__ = ["Source", "source_names"]
