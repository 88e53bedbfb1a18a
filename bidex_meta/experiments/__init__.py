"""Functions for what a person does with runs: train, evaluate, meta-test, verify, plot."""
