"""Several cameras that are fixed to each other: their joint evidence, and the solution made of it."""
