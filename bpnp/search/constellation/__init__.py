"""Compiled parts of the exact search for few points: minimal solvers, matching, enumeration."""
