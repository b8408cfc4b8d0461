"""What `bpnp table` is made of: several methods on the same pairs, in the form of the paper's tables."""
