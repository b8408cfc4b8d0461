"""Exact search for few points: minimal solvers, one-to-one matches and their enumeration, all compiled."""
