"""Datasets: their arrays and batches, their files, where they are found, and how ours are made.

`dataset` holds the arrays and batches, `hdf5` reads and writes files, `sources` finds and downloads them. The
other modules make the datasets that are shipped with the project.
"""

from tutorial_lib.data.dataset import KEYS, Batch, Dataset, DatasetError, returns_to_go, sample_batch
from tutorial_lib.data.hdf5 import read_dataset, write_dataset
from tutorial_lib.data.sources import SHIPPED_DATA, find_dataset, load_dataset, shipped_tasks
