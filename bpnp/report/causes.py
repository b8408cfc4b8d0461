"""Why estimates are wrong: one cause for each row of a test, and the share of each."""

from collections.abc import Iterable

from bpnp.report.results import PairRow

SOLVED_DEG = 5.0
PLAUSIBLE_INLIERS = 0.5
CAUSES = (
    "solved",
    "solved, not converged",
    "no pose",
    "wrong, not converged",
    "wrong, but fits the image",
    "wrong",
)


def cause_of(row: PairRow) -> str:
    """The first of these that holds.

    - "no pose": the solver gave none;
    - "solved": rotation error up to `SOLVED_DEG` degrees; "solved, not converged" if the solver says it has not;
    - "wrong, not converged": the solver itself flags it;
    - "wrong, but fits the image": `PLAUSIBLE_INLIERS` of the 2D points have a reprojected 3D point beside them: another
      minimum, or a symmetric scene, that the solver cannot tell from the true pose;
    - "wrong": none of these.
    """
    if not row.found:
        return "no pose"
    if row.rotation_error_deg <= SOLVED_DEG:
        return "solved" if row.converged else "solved, not converged"
    if not row.converged:
        return "wrong, not converged"
    return "wrong, but fits the image" if row.inliers >= PLAUSIBLE_INLIERS * row.m else "wrong"


def cause_shares(rows: Iterable[PairRow]) -> dict[str, float]:
    """Share of the rows with each cause, in the order of `CAUSES`; they sum to one.

    Raises ValueError if there is no row.
    """
    found = [cause_of(row) for row in rows]
    if not found:
        raise ValueError("expected at least one row, got none")
    return {cause: found.count(cause) / len(found) for cause in CAUSES}
