"""Commands on runs as Python functions: train, evaluate, meta-test, verify, compare and plot."""
