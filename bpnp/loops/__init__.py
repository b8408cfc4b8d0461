"""Loops on the CPU: how they are compiled, shared among threads, and ended when their time is over."""
