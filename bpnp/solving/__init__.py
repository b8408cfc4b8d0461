"""What `bpnp.solve` is made of: checked arguments, candidates, matches and the solution."""
