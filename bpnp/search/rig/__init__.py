"""One pose of several cameras that are fixed to each other."""
