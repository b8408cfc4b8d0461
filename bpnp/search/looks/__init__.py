"""Looks for poses that clusters hide: starts are looked up in a raster of the view, and the likeliest annealed."""
