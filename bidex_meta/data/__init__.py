"""Data sets of whole episodes: recorded from worlds, stored as HDF5 in Minari's layout, read and checked."""

from bidex_meta.data.dataset import Dataset, open_dataset
from bidex_meta.data.part_files import Episode

__all__ = ["Dataset", "Episode", "open_dataset"]
