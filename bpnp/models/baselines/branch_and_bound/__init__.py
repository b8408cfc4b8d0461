"""Globally optimal solvers by branch and bound: GOPAC and GOSMA."""
