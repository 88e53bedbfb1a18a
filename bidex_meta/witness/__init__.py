"""Witnesses: recorded actions that solve a task, their replay, and scripts that solve one in closed loop.

They prove that a scene, its reward and its success test fit together, as Meta-World's scripted policies do. A witness
belongs to task 0 of ``Benchmark("MT20", seed=0)``. Most were searched on the printed reward alone; where such a search
stays in a local optimum, a script controls the hands (``scripts``). The search is no part of the package.
"""
