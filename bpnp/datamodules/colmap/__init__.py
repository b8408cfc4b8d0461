"""Photos with known poses, from COLMAP models."""
