"""Witnesses: stored reference solutions, one recorded action sequence a class, and what replays them.

A witness solves task 0 of ``Benchmark("MT20", seed=0)``. Most are from a search on the printed reward alone
(``tools/witness_search``); where it stays in a local optimum, a scripted policy controls the hands (``scripts``).
"""
