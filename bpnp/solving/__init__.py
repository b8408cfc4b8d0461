"""Deprecated place of `bpnp.search`; the next minor version removes it."""
