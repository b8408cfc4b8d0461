"""Results on disk and on screen."""

from bpnp.report.causes import cause_of, cause_shares
from bpnp.report.page import write_page
from bpnp.report.results import PairRow, Results, read_results, summarise, write_results
from bpnp.report.rows import count_inliers, rows_from
from bpnp.report.runs import table
from bpnp.report.tables import learning_table, recall_table, report, results_table
from bpnp.report.training_log import TrainingLog, read_training_log
from bpnp.report.views import PairView, read_views, select_views, views_from, write_views

__all__ = [
    "PairRow",
    "PairView",
    "Results",
    "TrainingLog",
    "cause_of",
    "cause_shares",
    "count_inliers",
    "learning_table",
    "read_results",
    "read_training_log",
    "read_views",
    "recall_table",
    "report",
    "results_table",
    "rows_from",
    "select_views",
    "summarise",
    "table",
    "views_from",
    "write_page",
    "write_results",
    "write_views",
]
