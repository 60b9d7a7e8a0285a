"""What C2IQL knows of undiscounted cost: discounting, cost reconstruction and constraint conditioning."""
