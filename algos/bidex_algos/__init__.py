"""The learners of bidex-meta, one file each, and the small pieces they share.

Imports nothing, nor do the rooms: a learner is loaded by its name, so that listing them costs no import of torch.
"""
