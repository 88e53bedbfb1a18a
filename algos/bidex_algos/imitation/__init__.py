"""Learners that imitate a teacher in the states that the learner itself visits."""
