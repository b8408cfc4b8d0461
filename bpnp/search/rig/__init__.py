"""Pose of a rig: several cameras that are fixed to each other."""
