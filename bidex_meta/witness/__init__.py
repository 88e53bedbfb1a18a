"""Witnesses: recorded actions that solve a task, and the search that finds them.

They prove that a scene, its reward and its success test fit together, as Meta-World's scripted policies do. A witness
belongs to task 0 of ``Benchmark("MT20", seed=0)``. Most were found by the planner on the printed reward alone; where it
stays in a local optimum a script leads the hands (``scripts``).
"""
