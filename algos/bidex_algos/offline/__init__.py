"""Learners that never act: they learn from stored transitions."""
