"""Datasets: arrays and batches (`dataset`), files (`hdf5`), where they are (`sources`), how ours are made."""

from tutorial_lib.data.dataset import KEYS, Batch, Dataset, DatasetError, returns_to_go, sample_batch
from tutorial_lib.data.hdf5 import read_dataset, write_dataset
from tutorial_lib.data.sources import SHIPPED_DATA, find_dataset, load_dataset, shipped_tasks
