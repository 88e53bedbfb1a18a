"""What is done to gradients and steps; knows no world and no learner."""
