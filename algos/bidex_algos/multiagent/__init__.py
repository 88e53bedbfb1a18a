"""Learners of several agents that share a reward; an agent controls, for example, a hand, a finger or a palm.

The learners follow the appendices A.2 and B.2 of Bi-DexHands.
"""
