"""Views made in batches, with the CPU as device: exact geometry, the CPU path's statistics, no leak between pairs."""

from pathlib import Path

import numpy as np
import pytest
import torch
from lightning import LightningModule, Trainer
from scipy.stats import ks_2samp, kstest

from bpnp import Batch
from bpnp.datamodules import MeshDataModule, Outliers
from bpnp.datamodules.loader import collate
from bpnp.datamodules.meshes.device_views import DeviceViews, KeyDataset
from bpnp.datamodules.meshes.pools import SurfacePools
from bpnp.datamodules.meshes.source import MeshSource
from bpnp.datamodules.meshes.views import Views
from bpnp.datamodules.outliers import harder
from bpnp.datamodules.seeded import normal, permutations, random_bits, row_keys, uniform
from bpnp.geometry import project, transform

CPU = torch.device("cpu")
MESHES, POOL, POINTS = 5, 40, 24


def source(**views: object) -> MeshSource:
    """Small cubes, apart from each other, so that points tell their mesh."""
    rng = np.random.default_rng(0)
    points = 0.04 * rng.uniform(-1, 1, (MESHES, POOL, 3)) + 0.1 * np.arange(MESHES)[:, None, None]
    pools = SurfacePools(points.astype("f4"), tuple(f"c/train/{i}" for i in range(MESHES)), 1.0)
    return MeshSource(
        pools,
        np.arange(MESHES),
        num_pairs=4000,
        num_points=POINTS,
        views=Views(**views),
        seed=3,
        split="train",
        fresh_views=True,
    )


def drawn(pairs: MeshSource, index: list[int], epoch: int = 0, outliers: Outliers | None = None) -> Batch:
    keys = KeyDataset(pairs)[[(epoch, i) for i in index]]
    return DeviceViews(pairs, outliers, device=CPU).batch(keys)


def test_the_numbers_are_uniform_normal_and_of_their_key_alone() -> None:
    keys = row_keys(1, 2, torch.arange(200), 3)
    assert len(set(keys.tolist())) == 200
    assert kstest(uniform(keys, 50).flatten().numpy(), "uniform").pvalue > 0.01
    assert kstest(normal(keys, 50).flatten().numpy(), "norm").pvalue > 0.01
    assert abs(np.corrcoef(uniform(keys, 50).T.numpy())[np.triu_indices(50, 1)]).max() < 0.35
    assert torch.equal(uniform(keys[7:9], 50), uniform(keys, 50)[7:9])
    assert torch.equal(permutations(keys, 9).sort(-1).values, torch.arange(9).expand(200, -1))
    first = permutations(keys, 9)[:, 0].bincount(minlength=9)
    assert float(((first - 200 / 9) ** 2 / (200 / 9)).sum()) < 26  # chi-square, 8 degrees of freedom: 0.1 %


def test_splitmix64_is_the_published_generator() -> None:
    """The first outputs of SplitMix64 from state 1234567, as its reference implementations print them."""
    published = (6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431)
    found = random_bits(torch.tensor([1234567]), 4)[0].tolist()
    assert [value % 2**64 for value in found] == list(published)


def test_without_noise_every_match_projects_onto_its_image_point() -> None:
    outliers = Outliers(ratio=0.5, occlusion=0.25, occluded_side="both")
    batch = drawn(source(noise_px=0.0), list(range(30)), outliers=outliers)
    true = batch.match3d >= 0
    assert (true.sum(-1) == 18).all()
    seen = batch.points2d.gather(1, batch.match3d.clamp(min=0)[..., None].expand(-1, -1, 2))
    shown = project(transform(batch.rotation, batch.translation, batch.points3d))
    torch.testing.assert_close(shown[true], seen[true], rtol=0, atol=1e-6)
    for match, own in zip(batch.match3d, true, strict=True):
        assert len(match[own].unique()) == 18
    assert batch.points2d.shape == (30, 24 - 3 + 9, 2)
    assert batch.points3d.shape == (30, 24 - 3 + 9, 3)


def test_true_points_are_different_samples_of_their_own_mesh() -> None:
    pairs = source()
    batch = drawn(pairs, [0, 6, 3, 9])
    for points, name in zip(batch.points3d, batch.ids, strict=True):
        mesh = int(name.split("/")[2].split("#")[0])
        own = {tuple(p) for p in pairs.pools.points[mesh].tolist()}
        assert len({tuple(p) for p in points.tolist()} & own) == POINTS
    assert batch.ids == tuple(pairs.pair(i, 0).name for i in (0, 6, 3, 9))


def test_a_pair_depends_on_its_key_alone() -> None:
    outliers = Outliers(ratio=0.3)
    together, alone = drawn(source(), [5, 8, 900], 2, outliers), drawn(source(), [900], 2, outliers)
    for name in ("points2d", "points3d", "rotation", "translation", "match3d"):
        assert torch.equal(getattr(together, name)[2:], getattr(alone, name))
    later = drawn(source(), [900], 3, outliers)
    assert not torch.equal(later.rotation, alone.rotation)
    assert later.ids == alone.ids


@pytest.mark.parametrize("rotation", ["euler", "so3"])
def test_the_statistics_are_those_of_the_cpu_path(rotation: str) -> None:
    pairs, outliers = source(rotation=rotation, noise_px=3.0), Outliers(ratio=0.5, side="2d", occlusion=0.25)
    index = list(range(1500))
    ours = drawn(pairs, index, outliers=outliers)
    cpu = harder(pairs, outliers, seed=3, fresh=True)
    theirs = collate([cpu.pair(i, 0) for i in index], index)
    assert ours.points2d.shape == theirs.points2d.shape
    assert ours.points3d.shape == theirs.points3d.shape
    assert torch.equal((ours.match3d >= 0).sum(-1), (theirs.match3d >= 0).sum(-1))

    def numbers(batch: Batch) -> dict[str, torch.Tensor]:
        true = batch.match3d >= 0
        seen = batch.points2d.gather(1, batch.match3d.clamp(min=0)[..., None].expand(-1, -1, 2))
        noise = (seen - project(transform(batch.rotation, batch.translation, batch.points3d)))[true]
        unmatched = torch.ones(batch.mask2d.shape).scatter(1, batch.match3d.clamp(min=0), 0).bool()
        entries = {f"R{i}{j}": batch.rotation[:, i, j] for i in range(3) for j in range(3)}
        moved = {f"t{i}": batch.translation[:, i] for i in range(3)}
        return entries | moved | {
            "noise": noise.flatten()[::7] * batch.focal[0],
            "clutter x": batch.points2d[..., 0][unmatched][::5],
            "place of a match": batch.match3d[true][::7].double(),
            "place of a point without": true.double().argmin(-1).double(),
        }  # fmt: skip

    found = {key: (value, numbers(theirs)[key]) for key, value in numbers(ours).items()}
    for key, (a, b) in found.items():
        assert ks_2samp(a.numpy(), b.numpy()).pvalue > 1e-3, key
    assert float(found["noise"][0].std()) == pytest.approx(3.0, rel=0.03)


class Recorder(LightningModule):
    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.batches: list[Batch] = []

    def training_step(self, batch: Batch, batch_idx: int) -> torch.Tensor:
        self.batches.append(batch)
        return self.weight**2

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


def train(folder: Path, *, epochs: int = 2, **options: object) -> list[Batch]:
    data = MeshDataModule(
        num_points=16, pool_size=32, train_shapes=6, val_shapes=2, train_pairs=12, batch_size=4,
        cache_dir=str(folder), fresh_views=True, train_outliers=Outliers(ratio=0.5), **options,  # type: ignore[arg-type]
    )  # fmt: skip
    recorder = Recorder()
    flags = dict.fromkeys(("logger", "enable_progress_bar", "enable_checkpointing", "enable_model_summary"), False)
    trainer = Trainer(
        default_root_dir=folder, max_epochs=epochs, accelerator="cpu", limit_val_batches=0, **flags
    )  # fmt: skip
    trainer.fit(recorder, data)
    return recorder.batches


def test_a_trainer_gets_views_of_every_pair_and_new_ones_each_epoch(tmp_path: Path) -> None:
    batches = train(tmp_path, views_on_device=True)
    assert [len(batch) for batch in batches] == [4] * 6
    assert batches[0].points2d.shape == (4, 24, 2)
    epochs = [torch.cat([b.index for b in batches[:3]]), torch.cat([b.index for b in batches[3:]])]
    assert all(torch.equal(epoch.sort().values, torch.arange(12)) for epoch in epochs)
    poses = {tuple(r.flatten().tolist()) for batch in batches for r in batch.rotation}
    assert len(poses) == 24
    again = train(tmp_path, views_on_device=True, num_workers=1)
    assert all(torch.equal(a.points2d, b.points2d) for a, b in zip(batches, again, strict=True))
    loaded = train(tmp_path, views_on_device=None)
    assert loaded[0].ids == batches[0].ids
    assert not torch.equal(loaded[0].rotation, batches[0].rotation)


def test_meshes_that_a_camera_may_be_inside_are_refused() -> None:
    with pytest.warns(UserWarning, match="behind a camera"):
        pairs = source(distance=1.0)
    with pytest.raises(ValueError, match="radius of 1 at `distance` 1.0; try views_on_device false"):
        DeviceViews(pairs, None, device=CPU)


def test_outliers_drawn_for_each_pair_are_left_to_the_loader() -> None:
    with pytest.raises(ValueError, match=r"one `ratio`.* got Outliers\(ratio=\(0.0, 1.0\).*try views_on_device false"):
        DeviceViews(source(), Outliers(ratio=(0.0, 1.0)), device=CPU)
