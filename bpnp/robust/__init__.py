"""Poses from proposed pairs of points: P3P, RANSAC, and the RANSAC of other libraries."""
