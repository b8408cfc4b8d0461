"""Results on disk and on screen."""

from bpnp.report.figures import plot_pair, recall_curve, save_figure
from bpnp.report.folder import read_results, write_results
from bpnp.report.page.write import write_page
from bpnp.report.results import PairRow, Results, cause_shares, count_inliers, rows_from, summarise
from bpnp.report.runs import table
from bpnp.report.samples import PairView, read_views, select_views, views_from, write_views
from bpnp.report.solutions import view_of
from bpnp.report.tables import learning_table, recall_table, report, results_table
from bpnp.report.training_log import TrainingLog, read_training_log

__all__ = [
    "PairRow",
    "PairView",
    "Results",
    "TrainingLog",
    "cause_shares",
    "count_inliers",
    "learning_table",
    "plot_pair",
    "read_results",
    "read_training_log",
    "read_views",
    "recall_curve",
    "recall_table",
    "report",
    "results_table",
    "rows_from",
    "save_figure",
    "select_views",
    "summarise",
    "table",
    "view_of",
    "views_from",
    "write_page",
    "write_results",
    "write_views",
]
