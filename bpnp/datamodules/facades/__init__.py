"""Random scenes like sparse SfM maps of buildings."""
