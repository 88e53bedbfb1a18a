"""Learners that learn to adapt to a task."""
