"""Small data sets on disk, in the layouts that the recipes read, and a network small enough to train in a test."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning import LightningModule, Trainer
from torch import Tensor, nn, optim

from bpnp import BPnPNet, Matcher
from bpnp.datamodules import MeshDataModule
from bpnp.datamodules.shapes import Mesh, procedural_shape
from bpnp.geometry import project, transform
from bpnp.layers import RansacPnP
from bpnp.models import Refinement
from bpnp.models.nets import ImageFeatures, SceneFeatures
from bpnp.types import Batch

SMALL_FEATURES = [
    f"--model.solver.features{side}.{size}" for side in ("2d", "3d") for size in ("channels=16", "depth=2")
]
SMALL_NET = ["--model.solver=bpnp.models.BPnPNet", *SMALL_FEATURES]
SMALL_MESHES = [
    "--data.num_points=24",
    "--data.pool_size=64",
    "--data.train_shapes=12",
    "--data.val_shapes=5",
    "--data.test_shapes=7",
    "--data.train_problems=24",
    "--data.batch_size=4",
]
MESHES = ["--data=bpnp.datamodules.MeshDataModule", *SMALL_MESHES]


def small_net(
    channels: int = 16,
    depth: int = 2,
    *,
    centre: bool = False,
    scale: float = 1.0,
    normalise: bool = False,
    refine: bool = True,
    threshold: float = 0.01,
    transport: nn.Module | None = None,
    rounds: int = 0,
) -> BPnPNet:
    """BPnPNet with features of few channels."""
    size = {"channels": channels, "depth": depth, "centre": centre}
    return BPnPNet(
        ImageFeatures(**size, scale=scale),  # type: ignore[arg-type]
        SceneFeatures(**size, normalise=normalise),  # type: ignore[arg-type]
        transport,
        RansacPnP(threshold=threshold),
        refinement=Refinement(enabled=refine),
        rounds=rounds,
    )


def small_matcher(frame: str = "any") -> Matcher:
    """An untrained Matcher in float64 in which every part has an effect."""
    torch.manual_seed(0)
    net = Matcher(channels=16, depth=2, heads=2, neighbours=3, frame=frame).double().eval()  # type: ignore[arg-type]
    if net.seen is not None:
        nn.init.normal_(net.seen.weight)  # zero until it is trained
    return net


def quiet_trainer(folder: Path, **settings: Any) -> Trainer:
    """A trainer on the CPU that prints nothing and, unless told to, writes nothing."""
    off = ("logger", "enable_checkpointing", "enable_progress_bar", "enable_model_summary", "num_sanity_val_steps")
    return Trainer(**dict.fromkeys(off, False) | {"default_root_dir": folder, "accelerator": "cpu"} | settings)


def small_meshes(cache: Path, **settings: object) -> MeshDataModule:
    """The data of MESHES, or with other settings."""
    pairs = (option.removeprefix("--data.").split("=") for option in SMALL_MESHES)
    numbers = {name: int(value) for name, value in pairs}
    return MeshDataModule(**(numbers | {"cache_dir": str(cache)} | settings))  # type: ignore[arg-type]


def check_pairs(batch: Batch, tolerance: float = 2e-6) -> None:
    """True pairs project onto their 2D points, no 2D point twice, and nothing is beyond the masks."""
    assert batch.match3d is not None
    true = batch.match3d >= 0
    seen = batch.points2d.gather(1, batch.match3d.clamp(min=0)[..., None].expand(-1, -1, 2))
    shown = project(transform(batch.rotation.double(), batch.translation.double(), batch.points3d.double())).float()
    torch.testing.assert_close(shown[true], seen[true], rtol=0, atol=tolerance)
    for match, own in zip(batch.match3d, true, strict=True):
        assert len(match[own].unique()) == own.sum()
    assert (batch.mask3d | ~true).all()
    assert (batch.points3d[~batch.mask3d] == 0).all()
    assert (batch.points2d[~batch.mask2d] == 0).all()


class Recorder(LightningModule):
    """Keeps the batches that it is trained on; its loss is that of one weight."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(()))
        self.batches: list[Batch] = []

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        self.batches.append(batch)
        return self.weight**2

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        raise AssertionError("there is nothing to validate on")

    def configure_optimizers(self) -> optim.Optimizer:
        return optim.SGD(self.parameters(), lr=0.1)


def recorded(data: object, folder: Path, *, checkpoint: Path | None = None, **options: object) -> list[Batch]:
    """The batches that a quiet trainer trains on."""
    recorder = Recorder()
    quiet_trainer(folder, **options).fit(recorder, data, ckpt_path=checkpoint)  # type: ignore[arg-type]
    return recorder.batches


def write_mesh_tree(root: Path, *, train: int = 3, test: int = 2) -> Path:
    """<root>/{box,lamp}/{train,test}/*.off, half of them with the counts on the header line."""
    for number, name in enumerate(("box", "lamp")):
        for split, count in (("train", train), ("test", test)):
            folder = root / name / split
            folder.mkdir(parents=True)
            for i in range(count):
                mesh = procedural_shape(np.random.default_rng([number, i]))
                write_off(folder / f"{name}_{i:04d}.off", mesh, joined_header=i % 2 == 1)
    return root


def write_off(path: Path, mesh: Mesh, *, joined_header: bool) -> None:
    head = f"OFF{' ' if joined_header else chr(10)}{len(mesh.vertices)} {len(mesh.faces)} 0"
    vertices = [" ".join(map(str, v)) for v in mesh.vertices.tolist()]
    faces = [" ".join(map(str, (3, *f))) for f in mesh.faces.tolist()]
    path.write_text("\n".join([head.replace("OFF ", "OFF"), *vertices, *faces]) + "\n")


def is_written(path: Path, text: bytes) -> bool:
    """Return whether another process writes this to a file within half a minute."""
    deadline = time.monotonic() + 30
    while text not in path.read_bytes() and time.monotonic() < deadline:
        time.sleep(0.1)
    return text in path.read_bytes()
