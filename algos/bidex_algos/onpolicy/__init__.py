"""Learners that learn from the latest rollout of the present policy."""
