"""What maintainers alone run, from a checkout: ``python -m tools.NAME``. Not in the wheel; no package imports it."""
