"""The learners of bidex-meta, one file each, and the small pieces they share.

Nothing is imported here, nor in the rooms' own ``__init__``: a learner is loaded by its full name
(``bidex_algos.onpolicy.mtppo:MTPPO``), so that listing learners costs no import of torch.
"""
