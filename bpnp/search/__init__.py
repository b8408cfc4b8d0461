"""Poses from two point sets alone: numpy and numba, nothing to train."""
