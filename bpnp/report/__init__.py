"""Results on disk and on screen."""

from bpnp.report.causes import cause_of, cause_shares
from bpnp.report.commands import report_command, view_command
from bpnp.report.figures import plot_pair, recall_curve, save_figure
from bpnp.report.page import write_page
from bpnp.report.results import PairRow, Results, read_results, summarise, write_results
from bpnp.report.rows import count_inliers, rows_from
from bpnp.report.runs import table
from bpnp.report.tables import learning_table, recall_table, report, results_table
from bpnp.report.training_log import TrainingLog, read_training_log
from bpnp.report.views import PairView, read_views, select_views, view_of, views_from, write_views

__all__ = [
    "PairRow",
    "PairView",
    "Results",
    "TrainingLog",
    "cause_of",
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
    "report_command",
    "results_table",
    "rows_from",
    "save_figure",
    "select_views",
    "summarise",
    "table",
    "view_command",
    "view_of",
    "views_from",
    "write_page",
    "write_results",
    "write_views",
]
