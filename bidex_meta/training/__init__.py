"""The training loop and its processes, independent of any particular learner."""
