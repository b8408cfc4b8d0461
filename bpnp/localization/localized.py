"""An image that was localized: its pose in the frame of the model, and how far it is from the model's."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.text import Text
from scipy.spatial.transform import Rotation

from bpnp.datamodules.colmap.reconstruction import ImagePoints
from bpnp.metrics.errors import centre_error, rotation_error
from bpnp.report.pictures import VERDICTS
from bpnp.report.tables.fitted_table import FittedTable
from bpnp.report.tables.result_tables import number
from bpnp.solving.solution import Solution
from bpnp.types import Batch

RIGHT_DEG = 1.0
HEADER = """# Image list with two lines of data per image:
#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME
#   POINTS2D[] as (X, Y, POINT3D_ID)
"""


@dataclass(frozen=True)
class Localized:
    """One image. rotation, translation: camera = R p + t, p in the model's frame; NaN without a pose.

    rotation_error_deg, centre_error (model units): against the model's pose; 180 and infinity without a pose.
    right_matches: share of the matches that are the model's.
    """

    image: str
    image_id: int
    camera_id: int
    verdict: str
    reason: str
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    rotation_error_deg: float
    centre_error: float
    count2d: int
    count3d: int
    inlier_count: int
    inlier_ratio: float
    right_matches: float
    reprojection_error_px: float
    seconds: float

    def as_json(self) -> dict[str, Any]:
        """Plain values; null for what is not finite."""
        values = asdict(self) | {name: getattr(self, name).tolist() for name in ("rotation", "translation")}
        if not math.isfinite(self.centre_error):
            values |= {"rotation": None, "translation": None}
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}


def localized(
    image: ImagePoints, pair: Batch, solution: Solution, turn: NDArray[np.float64], origin: NDArray[np.float64]
) -> Localized:
    """From the turned scene, in which p of the model is turn (p - origin), back to its frame. pair: a batch of one."""
    rotation = solution.rotation @ turn
    translation = solution.translation - rotation @ origin
    estimate = (torch.as_tensor(rotation)[None], torch.as_tensor(translation)[None])
    truth = (torch.as_tensor(image.rotation)[None], torch.as_tensor(image.translation)[None])
    assert pair.match3d is not None
    right = pair.match3d[0].numpy()[solution.matches[:, 1]] == solution.matches[:, 0]
    return Localized(
        image=image.name,
        image_id=image.image_id,
        camera_id=image.camera_id,
        verdict=solution.verdict,
        reason=solution.reason,
        rotation=rotation,
        translation=translation,
        rotation_error_deg=float(rotation_error(estimate[0], truth[0])),
        centre_error=float(centre_error(*estimate, *truth)),
        count2d=int(pair.count2d),
        count3d=int(pair.count3d),
        inlier_count=solution.inlier_count,
        inlier_ratio=solution.inlier_ratio,
        right_matches=float(right.mean()) if len(right) else 0.0,
        reprojection_error_px=solution.reprojection_error,
        seconds=solution.seconds,
    )


def images_text(done: Sequence[Localized]) -> str:
    """COLMAP's images.txt with the poses to rely on, those of the verdict "confident"; no keypoints."""
    lines = []
    for result in done:
        if result.verdict == "confident":
            x, y, z, w = Rotation.from_matrix(result.rotation).as_quat(canonical=True).tolist()
            pose = " ".join(map(repr, (w, x, y, z, *result.translation.tolist())))
            lines.append(f"{result.image_id} {pose} {result.camera_id} {result.image}\n\n")
    return f"{HEADER}# Number of images: {len(lines)}\n{''.join(lines)}"


def localized_table(done: Sequence[Localized]) -> FittedTable:
    """A row per image."""
    headers = ("2D", "3D", "verdict", "rot\ndeg", "centre\nunits", "inlier\n%", "right\n%", "error\npx", "sec")
    rows = []
    for r in done:
        errors = (number(r.rotation_error_deg), number(r.centre_error))
        shares = (f"{100 * r.inlier_ratio:.0f}", f"{100 * r.right_matches:.0f}")
        cells = (*errors, *shares, number(r.reprojection_error_px), number(r.seconds))
        verdict = Text(r.verdict, VERDICTS[r.verdict])
        rows.append((Text(r.image), [Text(str(r.count2d)), Text(str(r.count3d)), verdict, *map(Text, cells)]))
    return FittedTable("", headers, [rows])


def summary(done: Sequence[Localized]) -> str:
    """How many are right, and how many that claim to be are not."""
    errors = np.array([result.rotation_error_deg for result in done])
    right = errors < RIGHT_DEG
    verdicts = np.array([result.verdict for result in done])
    counts = ", ".join(f"{(verdicts == verdict).sum()} {verdict}" for verdict in VERDICTS)
    wrong = int((~right & (verdicts == "confident")).sum())
    median = number(float(np.median(errors)))
    return (
        f"{len(done)} images: {100 * right.mean():.1f} % under {RIGHT_DEG:g} deg, median {median} deg; {counts}; "
        f"confident and wrong: {wrong}"
    )
