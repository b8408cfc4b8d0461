"""Poses from candidate matches of points: P3P, RANSAC of this and of other libraries, proposals from an assignment."""
