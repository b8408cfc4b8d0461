"""Photos in maps: a COLMAP reconstruction with its views, and the pose of a photo in it."""
