"""Evaluation of policies: episodes, results, scores, comparison of runs, and the meta-test of agents that adapt.

The package also has the meta-test's control experiment, in which an agent adapts to data of another task.
"""
