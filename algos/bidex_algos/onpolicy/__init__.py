"""Learners that only learn from the latest rollout of the current policy."""
