"""What commands print: on a console at least as wide as the tables."""

from pathlib import Path

from rich.console import Console

from bpnp.report.tables.fitted_table import WIDTH


def console() -> Console:
    """Standard output, at least `WIDTH` columns wide."""
    own = Console()
    own.width = max(own.width, WIDTH)
    return own


def say(path: Path, *, to: Console | None = None) -> None:
    """A line about a file that was written."""
    (to or Console()).print(f"wrote {path}", markup=False, highlight=False, soft_wrap=True)
