"""Rotations from points at infinity, such as stars, that nobody has matched."""
