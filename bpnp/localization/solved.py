"""A solution as lines of a table."""

from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

from bpnp.report.palette import VERDICTS
from bpnp.solving.solution import Solution


def solution_table(solution: Solution) -> Table:
    """Verdict, pose and matches; the next candidates, and how long it took."""
    table = Table(box=box.SIMPLE, show_header=False, padding=(0, 1))
    table.add_column(no_wrap=True, style="dim")
    table.add_column(overflow="fold")
    table.add_row("verdict", Text.assemble((solution.verdict, VERDICTS[solution.verdict]), f": {solution.reason}"))
    if solution.found:
        for name, row in zip(("rotation", "", ""), solution.rotation, strict=True):
            table.add_row(name, _numbers(row))
        table.add_row("translation", _numbers(solution.translation))
        table.add_row("camera centre", _numbers(solution.centre))
        smaller = min(len(solution.points2d), len(solution.points3d))
        table.add_row("inliers", f"{solution.inlier_count} of {smaller} ({100 * solution.inlier_ratio:.1f} %)")
        table.add_row(
            "reprojection",
            f"{solution.reprojection_error:.3g} {solution.unit} ({solution.reprojection_error_deg:.3g} deg), "
            f"inliers up to {solution.inlier_threshold:.3g} {solution.unit}",
        )
        others = [f"{c.inlier_count} inliers, score {c.score:.3f}" for c in solution.candidates[1:4]]
        table.add_row("next candidates", "; ".join(others) or "none")
    if solution.stats.dropped2d:
        table.add_row("left out", f"{solution.stats.dropped2d} 2D points that could not be undistorted")
    table.add_row("seconds", f"{solution.seconds:.2f}")
    return table


def _numbers(values: Any) -> str:
    return "  ".join(f"{value:12.6g}" for value in values)
