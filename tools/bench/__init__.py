"""Benchmarks of the project itself, ``python -m tools.bench KIND``. For users there is ``bidex-meta bench world``."""
