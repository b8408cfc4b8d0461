"""Results on disk and on screen."""

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from bpnp.report.figures import plot_pair, plot_scene, recall_curve, save_figure
    from bpnp.report.folder import read_results, write_results
    from bpnp.report.page.write import write_page
    from bpnp.report.pictures import plot_image, plot_residuals
    from bpnp.report.results import PairRow, Results, cause_shares, count_inliers, rows_from, summarise
    from bpnp.report.runs import table
    from bpnp.report.samples import PairView, read_views, select_views, views_from, write_views
    from bpnp.report.tables.result_tables import learning_table, recall_table, report, results_table
    from bpnp.report.training_log import TrainingLog, read_training_log

__all__ = [
    "PairRow", "PairView", "Results", "TrainingLog", "cause_shares", "count_inliers", "learning_table", "plot_image",
    "plot_pair", "plot_residuals", "plot_scene", "read_results", "read_training_log", "read_views", "recall_curve",
    "recall_table", "report", "results_table", "rows_from", "save_figure", "select_views", "summarise",
    "table", "views_from", "write_page", "write_results", "write_views",
]  # fmt: skip

MODULES = {
    "figures": ["plot_pair", "plot_scene", "recall_curve", "save_figure"],
    "folder": ["read_results", "write_results"],
    "page.write": ["write_page"],
    "pictures": ["plot_image", "plot_residuals"],
    "results": ["PairRow", "Results", "cause_shares", "count_inliers", "rows_from", "summarise"],
    "runs": ["table"],
    "samples": ["PairView", "read_views", "select_views", "views_from", "write_views"],
    "tables.result_tables": ["learning_table", "recall_table", "report", "results_table"],
    "training_log": ["TrainingLog", "read_training_log"],
}
__getattr__, __dir__, _ = lazy_loader.attach(__name__, submod_attrs=MODULES)
