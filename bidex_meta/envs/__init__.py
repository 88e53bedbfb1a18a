"""Single environments of a suite's classes, as Meta-World makes them, and vectors of such environments."""
