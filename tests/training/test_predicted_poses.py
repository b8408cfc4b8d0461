import csv
from pathlib import Path

import numpy as np
from planted import posed
from planted_model import plant_model
from scipy.spatial.transform import Rotation
from small_data import quiet_trainer
from torch import nn

from bpnp import Batch, Prediction
from bpnp.datamodules import ColmapDataModule
from bpnp.training.results_writer import ResultsWriter
from bpnp.training.task import BlindPnPTask


class Oracle(nn.Module):
    """Answers with the true pose of the pair."""

    estimates = ("truth",)

    def forward(self, batch: Batch) -> Prediction:
        return Prediction(poses={"truth": posed(batch.rotation, batch.translation)})


def test_poses_are_written_in_the_coordinates_of_a_scene_far_from_its_origin(tmp_path: Path) -> None:
    planted = plant_model(tmp_path / "scene" / "sparse" / "0", origin=1e4)
    module = ColmapDataModule(root=str(tmp_path / "scene"))
    trainer = quiet_trainer(tmp_path, callbacks=[ResultsWriter()])
    trainer.predict(BlindPnPTask(Oracle()), datamodule=module, return_predictions=False)
    with (tmp_path / "predict" / "poses.csv").open(newline="") as file:
        rows = {row["id"].split("/")[-1]: row for row in csv.DictReader(file)}
    assert len(rows) == len(planted.rotations)
    for i, (rotation, translation) in enumerate(zip(planted.rotations, planted.translations, strict=True)):
        row = rows[f"photo {i}.jpg"]
        written = Rotation.from_quat([float(row[k]) for k in ("qx", "qy", "qz", "qw")]).as_matrix()
        centre = -written.T @ [float(row[k]) for k in ("tx", "ty", "tz")]
        assert np.abs(written - rotation).max() < 1e-6
        # float32 turns a point 1.7e4 away by 1e-7 of that; without the origin the centre would be off by 1.7e4.
        assert np.abs(centre + rotation.T @ translation).max() < 1e-2
