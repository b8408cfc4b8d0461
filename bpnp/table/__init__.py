"""The paper's tables on any data: several methods, pair by pair, resumable and in parallel."""

from bpnp.table.command import table_command

__all__ = ["table_command"]
