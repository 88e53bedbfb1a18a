"""Evaluation of policies: episodes, results, the meta-test and its control, scores, comparison of runs."""
