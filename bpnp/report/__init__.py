"""Results on disk and on screen."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from bpnp.report.figures import plot_image, plot_problem, plot_residuals, plot_scene, recall_curve, save_figure
    from bpnp.report.page.write import write_page
    from bpnp.report.points import ProblemPoints, points_from, read_points, select_points, write_points
    from bpnp.report.results import (
        ProblemRow,
        Results,
        cause_shares,
        count_inliers,
        read_results,
        rows_from,
        summarise,
        write_results,
    )
    from bpnp.report.runs import TrainingLog, read_training_log, table
    from bpnp.report.tables import learning_table, recall_table, report, results_table

MODULES = {
    "figures": ["plot_image", "plot_problem", "plot_residuals", "plot_scene", "recall_curve", "save_figure"],
    "page.write": ["write_page"],
    "points": ["ProblemPoints", "points_from", "read_points", "select_points", "write_points"],
    "results": ["ProblemRow", "Results", "cause_shares", "count_inliers", "read_results", "rows_from", "summarise",
                "write_results"],
    "runs": ["TrainingLog", "read_training_log", "table"],
    "tables": ["learning_table", "recall_table", "report", "results_table"],
}  # fmt: skip
__all__ = [
    "ProblemPoints", "ProblemRow", "Results", "TrainingLog", "cause_shares", "count_inliers", "learning_table",
    "plot_image", "plot_problem", "plot_residuals", "plot_scene", "points_from", "read_points", "read_results",
    "read_training_log", "recall_curve", "recall_table", "report", "results_table", "rows_from", "save_figure",
    "select_points", "summarise", "table", "write_page", "write_points", "write_results",
]  # fmt: skip
__getattr__, __dir__, _ = lazy_loader.attach(__name__, submod_attrs=MODULES)
