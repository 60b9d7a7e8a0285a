"""Studies: grids of training runs, how processes share them, and their results beside the paper's."""
