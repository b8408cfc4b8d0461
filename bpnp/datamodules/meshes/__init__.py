"""Meshes, or procedural shapes, seen by virtual cameras."""
