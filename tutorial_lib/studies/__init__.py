"""Grids of training runs: what to run, where it runs, and what the results say beside the paper's."""
