"""Poses from candidate pairs of points: P3P, RANSAC of this and of other libraries, proposals from an assignment."""
