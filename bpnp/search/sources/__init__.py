"""Where the poses of a search come from: each source draws starts, screens them, and anneals the likeliest."""
