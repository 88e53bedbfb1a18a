"""Witnesses: recorded actions that solve task 0 of each class of ``Benchmark("MT20", seed=0)``, and their replay."""
