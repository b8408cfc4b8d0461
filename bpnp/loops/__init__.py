"""Loops on the CPU: compilation, threads and time limits."""
