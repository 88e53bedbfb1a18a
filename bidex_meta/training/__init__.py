"""The training loop and its processes; knows no learner."""
