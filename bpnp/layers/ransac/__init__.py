"""Poses from candidate matches: P3P, RANSAC of this and of other libraries, and proposals from an assignment."""
