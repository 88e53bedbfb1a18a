"""Tools for maintainers, run from a checkout: ``python -m tools.NAME``. The wheel does not contain these tools."""
