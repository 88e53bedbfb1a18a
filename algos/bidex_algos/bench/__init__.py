"""Speed of the learners' parts (``bidex-meta bench``)."""
