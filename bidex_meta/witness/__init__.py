"""Witnesses, and their replay. A witness is a recording of actions that solve one task of a class.

The task is task 0 of the class in ``Benchmark("MT20", seed=0)``.
"""
