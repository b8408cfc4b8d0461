"""Results on disk and on screen."""

from bpnp.report.results import PairRow, Results, read_results, summarise, write_results
from bpnp.report.rows import count_inliers, rows_from
from bpnp.report.tables import learning_table, recall_table, report, results_table

__all__ = [
    "PairRow",
    "Results",
    "count_inliers",
    "learning_table",
    "read_results",
    "recall_table",
    "report",
    "results_table",
    "rows_from",
    "summarise",
    "write_results",
]
