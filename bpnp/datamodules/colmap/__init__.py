"""Photos with known poses, in COLMAP models."""
