"""Learners that learn from a replay buffer."""
