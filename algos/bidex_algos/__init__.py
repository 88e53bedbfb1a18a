"""The learners of bidex-meta, one file each, and the small modules that they share.

The ``__init__.py`` files of this package and of its subpackages import nothing. A learner's module is imported only
when the learner is requested by name, so listing the learners does not import torch.
"""
