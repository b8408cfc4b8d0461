"""`bpnp solve` and `bpnp localize`: poses of files of points, and of the images of COLMAP models."""

from bpnp.localization.from_files import solve_command
from bpnp.localization.from_models import localize_command

__all__ = ["localize_command", "solve_command"]
