"""What `bpnp solve` and `bpnp localize` are made of: files of points and cameras, images of COLMAP models."""
