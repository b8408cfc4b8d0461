"""Refinement of poses to the end, in float64."""
