"""Learners that learn from what the present policy has just played."""
