"""Poses of a prediction in the frame of the user's scene, in memory and as a CSV or JSON file."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import roma
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import BasePredictionWriter
from lightning.pytorch.utilities.rank_zero import rank_zero_info
from torch import Tensor, distributed

from bpnp.files import write_text
from bpnp.geometry import quaternion_rotation
from bpnp.types import Batch, Pose, Prediction

COLUMNS = ("id", "estimate", "found", "converged", "qw", "qx", "qy", "qz", "tx", "ty", "tz")


def in_scene_frame(prediction: Prediction, batch: Batch) -> Prediction:
    """Name the problems of a prediction, and transform the poses to the original coordinates of their scenes.

    With an origin o of the batch, that was subtracted from the coordinates, they are (R, t - R o) in float64, where R
    is the rotation nearest to that of the solver.
    """
    poses = prediction.poses
    if batch.origin is not None:
        poses = {name: _translate(pose, batch.origin) for name, pose in poses.items()}
    return replace(prediction, poses=poses, ids=batch.ids, index=batch.index)


def _translate(pose: Pose, origin: Tensor) -> Pose:
    # A large origin amplifies the rounding of a float32 rotation, so make it exact first.
    rotation = quaternion_rotation(roma.rotmat_to_unitquat(pose.rotation.double()))
    return replace(
        pose,
        rotation=rotation,
        translation=pose.translation.double() - (rotation @ origin.to(rotation)[..., None])[..., 0],
    )


@dataclass(frozen=True)
class PoseRow:
    """One estimate of one problem: camera = R p + t, COLMAP's `cam_from_world`; NaN without a pose."""

    index: int
    id: str
    estimate: str
    found: bool
    converged: bool
    rotation: list[list[float]]
    quaternion: list[float]  # w, x, y, z
    translation: list[float]


def pose_rows(prediction: Prediction) -> list[PoseRow]:
    """Return every pose of a prediction with `ids`."""
    rows = []
    for estimate, pose in prediction.poses.items():
        quaternion = roma.rotmat_to_unitquat(pose.rotation.double()).roll(1, -1)
        quaternion = torch.where(pose.found[:, None], quaternion, torch.nan)
        columns = (pose.found, pose.stats.converged, pose.rotation.double(), quaternion, pose.translation.double())
        assert prediction.index is not None
        for index, name, *values in zip(
            prediction.index.tolist(), prediction.ids, *(column.tolist() for column in columns), strict=True
        ):
            rows.append(PoseRow(index, name, estimate, *values))
    return rows


def folder_of_loader(folder: Path, loader: int, count: int) -> Path:
    """Return the folder of the files of one of `count` loaders: with several, each has its own, named as in metrics."""
    return folder / f"dataloader_idx_{loader}" if count > 1 else folder


class PredictionWriter(BasePredictionWriter):
    """Write the poses of a prediction atomically when it ends, sorted by problem.

    Of several loaders, each has a folder of its own, such as `dataloader_idx_0`.

    Args:
        folder: Folder of the file. Default: None, the default_root_dir of the trainer.
        format: "csv", the default, for quaternions (w, x, y, z) and translations; "json" for rotation matrices and
            translations.
        overwrite: Replace the file of an earlier prediction. Default False: such a file is an error.
    """

    def __init__(
        self, folder: str | None = None, format: Literal["csv", "json"] = "csv", overwrite: bool = False
    ) -> None:
        super().__init__("batch")
        self.folder, self.format, self.overwrite = folder, format, overwrite
        self.rows: list[list[PoseRow]] = []  # by loader

    def path(self, trainer: Trainer, loader: int = 0) -> Path:
        """Return the path of the file.

        Args:
            trainer: Trainer of the prediction, whose default_root_dir is the default folder.
            loader: Index of the loader. Default: 0.
        """
        folder = Path(self.folder or trainer.default_root_dir)
        return folder_of_loader(folder, loader, len(trainer.num_predict_batches)) / f"predictions.{self.format}"

    def on_predict_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Raise ValueError if the file exists and must not be replaced."""
        self.rows = [[] for _ in trainer.num_predict_batches]
        for path in (self.path(trainer, loader) for loader in range(len(self.rows))):
            if path.exists() and not self.overwrite and not trainer.fast_dev_run:  # type: ignore[attr-defined]
                raise ValueError(
                    f"{path} exists. Use --predictions.folder for another folder, or --predictions.overwrite true."
                )

    def write_on_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        prediction: Any,
        batch_indices: Sequence[int] | None,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int,
    ) -> None:
        """Keep the poses of the batch."""
        if isinstance(prediction, Prediction) and prediction.ids:  # a user's own task may predict something else
            self.rows[dataloader_idx] += pose_rows(prediction)

    def on_predict_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Gather the poses of all processes and write the file of each loader."""
        gathered = gather_objects(self.rows)
        for loader, parts in enumerate(zip(*gathered, strict=True)):
            if not trainer.is_global_zero or trainer.fast_dev_run or not any(parts):  # type: ignore[attr-defined]
                continue
            # Count problems of several processes once; the sort is stable and keeps the order of the estimates.
            rows = {(row.index, row.estimate): row for part in parts for row in part}
            ordered = sorted(rows.values(), key=lambda row: row.index)
            path = write_text(
                self.path(trainer, loader),
                as_csv(ordered) if self.format == "csv" else as_json(ordered),
                errors="surrogateescape",
            )
            rank_zero_info(f"poses of {len({row.index for row in ordered})} problems in {path}")


def gather_objects(value: Any) -> list[Any]:
    """Return the value of every process, which can be pickled, in the order of their ranks."""
    if not distributed.is_available() or not distributed.is_initialized():
        return [value]
    values = [None] * distributed.get_world_size()
    distributed.all_gather_object(values, value)
    return values


def as_csv(rows: Sequence[PoseRow]) -> str:
    """Return a table with the columns `COLUMNS`."""
    text = io.StringIO()
    table = csv.writer(text)
    table.writerow(COLUMNS)
    for row in rows:
        table.writerow([row.id, row.estimate, row.found, row.converged, *row.quaternion, *row.translation])
    return text.getvalue()


def as_json(rows: Sequence[PoseRow]) -> str:
    """Return a JSON list of poses; rotation and translation are null without a pose."""
    content = [
        {
            "id": row.id,
            "estimate": row.estimate,
            "found": row.found,
            "converged": row.converged,
            "rotation": row.rotation if row.found else None,
            "translation": row.translation if row.found else None,
        }
        for row in rows
    ]
    return json.dumps(content, indent=1) + "\n"
