"""The learners of bidex-meta, one file each, and the small modules that they share.

This package and its subpackages import nothing: a learner is loaded by its name, so listing the learners does not
import torch.
"""
