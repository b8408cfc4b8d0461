"""The compiled loops of the annealing: over all pairs of clusters, and over neighbours in a grid."""
