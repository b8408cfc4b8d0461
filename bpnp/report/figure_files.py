"""Files of figures."""

from pathlib import Path
from typing import TYPE_CHECKING

from bpnp.files import delay_interrupts, write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SUFFIXES = (".png", ".jpg", ".jpeg", ".svg", ".pdf")


def save_figure(figure: "Figure", path: Path | str, *, dpi: int = 110) -> Path:
    """Write a figure atomically, and return its path; raise ValueError for a name without one of the `SUFFIXES`."""
    path = Path(path)
    check_picture_name(path)
    with write_atomically(path) as temporary, delay_interrupts():  # matplotlib reports Ctrl-C as an input error
        figure.savefig(temporary, format=path.suffix[1:].lower(), dpi=dpi)
    return path


def check_picture_name(path: Path, what: str = "the file name") -> None:
    """Raise ValueError, which begins with `what`, if `save_figure` does not write files of this suffix."""
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{what} {path.name!r} has to end in {', '.join(SUFFIXES)}")
