"""Search for poses from two point sets alone, with numpy and numba, without training."""
