"""A teaching library for safe offline reinforcement learning: C2IQL, its parts and its baselines."""
