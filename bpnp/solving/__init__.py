"""Parts of `bpnp.solve`: checked arguments, candidates, matches and the solution."""
