"""Record, store, read and check data sets of whole episodes (HDF5 in Minari's layout)."""

from bidex_meta.data.dataset import Dataset, open_dataset
from bidex_meta.data.part_files import Episode

__all__ = ["Dataset", "Episode", "open_dataset"]
