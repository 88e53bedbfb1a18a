"""Learners that imitate a teacher in the states that they come to themselves."""
