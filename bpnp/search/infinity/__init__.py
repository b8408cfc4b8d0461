"""Rotations from unmatched points at infinity, such as stars."""
