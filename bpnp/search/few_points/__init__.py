"""Enumeration of the poses of few points: minimal solvers, one-to-one matches and their refinement, all compiled."""
