"""Benchmarks for maintainers, ``python -m tools.bench KIND``. Users have ``bidex-meta bench world``."""
