"""Learners of several agents that share a reward: fingers and palms (appendix A.2, B.2)."""
