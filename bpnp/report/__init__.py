"""Results on disk and on screen."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from bpnp.report.figures import plot_image, plot_problem, plot_residuals, plot_scene, recall_curve
    from bpnp.report.page.write import write_page
    from bpnp.report.points import read_points
    from bpnp.report.results import ProblemRow, Results, read_results, write_results
    from bpnp.report.runs import table

__all__ = [
    "ProblemRow", "Results", "plot_image", "plot_problem", "plot_residuals", "plot_scene", "read_points",
    "read_results", "recall_curve", "table", "write_page", "write_results",
]  # fmt: skip
__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "figures": ["plot_image", "plot_problem", "plot_residuals", "plot_scene", "recall_curve"],
        "page.write": ["write_page"],
        "points": ["read_points"],
        "results": ["ProblemRow", "Results", "read_results", "write_results"],
        "runs": ["table"],
    },
)
