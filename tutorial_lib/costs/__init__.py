"""The parts of C2IQL for undiscounted cost: discounting, cost reconstruction and constraint conditioning."""
