import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from lightning import Callback, Trainer
from planted import padded, plant, posed
from scipy.spatial.transform import Rotation
from small_data import quiet_trainer, small_meshes, small_net
from torch import nn
from torch.utils.data import DataLoader

import bpnp.metrics
import bpnp.training.losses
import bpnp.training.task
from bpnp import Batch, Matcher, Prediction
from bpnp.layers import Sinkhorn
from bpnp.report import read_results
from bpnp.training.callbacks import PoseLossWarmup, ResultsWriter
from bpnp.training.losses import Losses, correspondence_loss
from bpnp.training.predictions import PredictionWriter
from bpnp.training.task import BlindPnPTask, TrainingDivergedError, number_globally

pytestmark = pytest.mark.slow


class CountingSolver(nn.Module):
    """BPnPNet that notes for each call whether poses were wanted, and can be told to give an assignment of NaN."""

    estimates = ("ransac", "pnp")

    def __init__(self, broken_calls: tuple[int, ...] = ()) -> None:
        super().__init__()
        self.net = small_net()
        self.wanted: list[bool] = []
        self.broken_calls = broken_calls

    def forward(self, batch: Batch) -> Prediction:
        return self.noted(self.net(batch), poses=True)

    def match(self, batch: Batch) -> Prediction:
        return self.noted(self.net.match(batch), poses=False)

    def noted(self, prediction: Prediction, *, poses: bool) -> Prediction:
        self.wanted.append(poses)
        if len(self.wanted) - 1 in self.broken_calls:
            assert prediction.assignment is not None
            return Prediction(prediction.assignment * math.nan, prediction.assignment_stats, prediction.poses)
        return prediction


def fit(tmp_path: Path, task: BlindPnPTask, ckpt_path: str | None = None, **settings: object) -> Trainer:
    """One epoch unless told otherwise, without validation."""
    run = quiet_trainer(tmp_path, **({"max_epochs": 1, "limit_val_batches": 0} | settings))
    run.fit(task, datamodule=small_meshes(tmp_path), ckpt_path=ckpt_path, weights_only=ckpt_path is not None)
    return run


def test_no_pose_is_solved_in_training_before_the_switch(tmp_path: Path) -> None:
    task, weights = BlindPnPTask(CountingSolver(), learning_rate=1e-4), []

    class Weights(Callback):
        def on_train_batch_end(self, trainer: Trainer, task: BlindPnPTask, *_: object) -> None:
            weights.append(task.pose_weight)

    callbacks = [PoseLossWarmup(start_epoch=1, weight=0.5), Weights()]
    fit(tmp_path, task, max_epochs=2, limit_train_batches=3, callbacks=callbacks)
    assert task.solver.wanted == [False] * 3 + [True] * 3
    assert callbacks[0].switched_at == 1
    assert weights == [0.0] * 3 + [0.5] * 3
    assert task.pose_weight == 0.0  # as configured, for another fit


def test_the_weight_of_the_task_is_that_after_the_switch_or_refused(tmp_path: Path) -> None:
    task, warmup = BlindPnPTask(CountingSolver(), pose_weight=0.25), PoseLossWarmup(start_epoch=0)
    run = fit(tmp_path, task, max_steps=1, callbacks=[warmup])
    logged = {name.removeprefix("train/"): float(value) for name, value in run.callback_metrics.items()}
    pose = logged["rotation_loss"] + logged["translation_loss"]
    assert logged["loss"] == pytest.approx(logged["correspondence_loss"] + 0.25 * pose, rel=1e-5)
    with pytest.raises(ValueError, match=r"model.pose_weight is 0.25 and the weight of PoseLossWarmup is 2\."):
        fit(tmp_path, task, callbacks=[PoseLossWarmup(start_epoch=1, weight=2.0)])


def test_a_pose_loss_that_never_joins_brings_a_warning(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="joins at epoch 5, and the training ends after 1 epochs without it"):
        fit(tmp_path, BlindPnPTask(CountingSolver()), limit_train_batches=1, callbacks=[PoseLossWarmup(start_epoch=5)])
    with pytest.warns(UserWarning, match="ended before epoch 5, at which the pose loss joins"):
        fit(tmp_path, BlindPnPTask(CountingSolver()), max_epochs=9, max_steps=1, callbacks=[PoseLossWarmup(5)])


def test_the_switch_survives_resuming_with_another_start(tmp_path: Path) -> None:
    first, resumed, file = BlindPnPTask(CountingSolver()), BlindPnPTask(CountingSolver()), str(tmp_path / "two.ckpt")
    run = fit(tmp_path, first, max_epochs=2, limit_train_batches=1, callbacks=[PoseLossWarmup(start_epoch=1)])
    run.save_checkpoint(file)
    fit(tmp_path, resumed, file, max_epochs=3, limit_train_batches=1, callbacks=[PoseLossWarmup(start_epoch=50)])
    assert resumed.solver.wanted == [True]


class OwnWarmup(PoseLossWarmup):
    """A switch of a user's."""


@pytest.mark.parametrize("kind", [OwnWarmup, PoseLossWarmup])
def test_a_training_with_a_switch_of_the_users_is_resumed(kind: type[PoseLossWarmup], tmp_path: Path) -> None:
    """Also by the class that it is derived from."""
    first, resumed, file = BlindPnPTask(CountingSolver()), BlindPnPTask(CountingSolver()), str(tmp_path / "one.ckpt")
    run = fit(tmp_path, first, limit_train_batches=1, callbacks=[OwnWarmup(start_epoch=0)])
    run.save_checkpoint(file)
    fit(tmp_path, resumed, file, max_epochs=2, limit_train_batches=1, callbacks=[switch := kind(start_epoch=50)])
    assert (resumed.solver.wanted, switch.switched_at) == ([True], 0)
    with pytest.warns(UserWarning, match=r"add the following callbacks: \['PoseLossWarmup'\]"):  # Lightning's
        fit(tmp_path, BlindPnPTask(CountingSolver()), file, max_epochs=2, limit_train_batches=1)


def test_a_switch_of_another_weight_is_printed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    file, options = str(tmp_path / "one.ckpt"), {"max_epochs": 2, "limit_train_batches": 1}
    switch = [PoseLossWarmup(0, weight=0.1)]
    fit(tmp_path, BlindPnPTask(CountingSolver()), callbacks=switch, limit_train_batches=1).save_checkpoint(file)
    fit(tmp_path, BlindPnPTask(CountingSolver()), file, callbacks=[PoseLossWarmup(0, weight=0.5)], **options)
    assert "The pose loss has weight=0.5 (saved: 0.1)." in caplog.text
    quiet_trainer(tmp_path).test(BlindPnPTask(CountingSolver()), datamodule=small_meshes(tmp_path), ckpt_path=file)


def test_a_step_without_a_finite_loss_is_left_out_and_counted(tmp_path: Path) -> None:
    def run(broken_calls: tuple[int, ...], steps: int) -> BlindPnPTask:
        torch.manual_seed(3)
        task = BlindPnPTask(CountingSolver(broken_calls), learning_rate=1e-3)
        fit(tmp_path, task, limit_train_batches=steps)
        return task

    broken, short = run((2,), 3), run((), 2)
    assert (broken.skipped_steps, broken.consecutive_skipped_steps) == (1, 1)
    for name, value in broken.solver.named_parameters():
        torch.testing.assert_close(value, short.solver.get_parameter(name), rtol=0, atol=0, msg=name)


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
@pytest.mark.parametrize("kind", ["norm", "value"])
def test_gradients_are_clipped_in_every_precision(precision: str, kind: str, tmp_path: Path) -> None:
    class Largest(Callback):
        norms, values = list[float](), list[float]()

        def on_before_zero_grad(self, trainer: Trainer, task: BlindPnPTask, optimizer: torch.optim.Optimizer) -> None:
            gradients = [p.grad for p in task.parameters() if p.grad is not None]
            if gradients:
                self.norms.append(float(torch.nn.utils.get_total_norm(gradients)))
                self.values.append(max(float(gradient.abs().max()) for gradient in gradients))

    seen, clip = Largest(), {"gradient_clip_val": 1e-3, "gradient_clip_algorithm": kind}
    fit(tmp_path, BlindPnPTask(small_net()), limit_train_batches=3, precision=precision, callbacks=[seen], **clip)
    assert len(seen.norms) == 2
    assert max(seen.norms if kind == "norm" else seen.values) == pytest.approx(1e-3, rel=1e-3)


@pytest.mark.parametrize("kind", ["BPnPNet", "Matcher"])
def test_unconverged_gradients_of_a_layer_are_logged_as_a_fraction_of_the_epoch(kind: str, tmp_path: Path) -> None:
    solver = small_net() if kind == "BPnPNet" else Matcher(channels=8, depth=1, heads=2)
    task, shares = BlindPnPTask(solver), []
    counts = solver.transport.backward_stats if kind == "BPnPNet" else solver.backward_stats

    class Failing(Callback):
        """Three samples of the first epoch fail."""

        def on_train_batch_end(self, trainer: Trainer, task: BlindPnPTask, *_: object) -> None:
            counts.unconverged += 1 if trainer.current_epoch == 0 else 0

        def on_train_epoch_start(self, trainer: Trainer, task: BlindPnPTask) -> None:
            assert counts.samples == counts.unconverged == 0
            shares.append(trainer.callback_metrics.get("train/backward_failed"))

    run = fit(tmp_path, task, max_epochs=2, limit_train_batches=3, callbacks=[Failing()])
    assert shares == [None, 3 / 12]
    assert run.callback_metrics["train/backward_failed"] == 0


@pytest.mark.parametrize("steps", [1, 0])
def test_a_fraction_of_the_epoch_is_that_of_all_processes(
    steps: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """This process fails in 1 of 4 samples, or has none; the other one fails in 5 of 6."""

    class Other(Callback):
        def on_train_epoch_end(self, trainer: Trainer, task: BlindPnPTask) -> None:
            counts = task.solver.transport.backward_stats
            counts.samples, counts.unconverged = 4 * steps, steps
            monkeypatch.setattr(trainer.strategy, "reduce", lambda counts, **_: counts + torch.tensor([5, 6]))

    run = fit(tmp_path, BlindPnPTask(small_net()), max_epochs=1, limit_train_batches=1, callbacks=[Other()])
    assert run.callback_metrics["train/backward_failed"] == pytest.approx((5 + steps) / (6 + 4 * steps))


def test_many_skipped_steps_in_a_row_end_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bpnp.training.task, "MOST_SKIPPED", 4)
    task = BlindPnPTask(CountingSolver(broken_calls=tuple(range(100))))
    with pytest.raises(TrainingDivergedError, match="in 4 consecutive steps .* Use a lower model.learning_rate"):
        fit(tmp_path, task)
    assert len(task.solver.wanted) == 4


def test_the_pose_loss_is_the_mean_over_the_samples_with_a_pose(tmp_path: Path) -> None:
    """Half of the samples have three points, and no pose; the weight of the others stays gamma_p."""
    batch = padded([plant(1, points, seed=points, dtype=torch.float32) for points in (20, 3, 21, 3)])
    task = BlindPnPTask(small_net(), pose_weight=2.0)
    prediction = task.solver(batch)
    found, solved = prediction.poses["pnp"], prediction.poses["pnp"].stats.converged
    assert solved.any()
    assert not solved[[1, 3]].any()
    angles = [
        (Rotation.from_matrix(a.T) * Rotation.from_matrix(b)).magnitude()
        for a, b in zip(found.rotation[solved].detach().numpy(), batch.rotation[solved].numpy(), strict=True)
    ]
    distances = (found.translation - batch.translation).norm(dim=-1)[solved]
    expected = correspondence_loss(prediction.assignment, batch.match3d).mean()
    expected = expected + 2 * (np.mean(angles) + distances.mean())
    losses = task.losses(prediction, batch)
    torch.testing.assert_close(losses.total, expected.float(), rtol=1e-4, atol=1e-5)
    assert float(losses.pose_means()["rotation"]) == pytest.approx(np.mean(angles), rel=1e-4)
    assert float(losses.pose_means()["translation"]) == pytest.approx(float(distances.mean()), rel=1e-5)


def test_the_terms_of_the_pose_loss_and_the_samples_without_a_pose_are_logged(tmp_path: Path) -> None:
    batch = padded([plant(1, points, seed=points, dtype=torch.float32) for points in (20, 3, 21, 3)])
    task = BlindPnPTask(small_net(), pose_weight=0.5)
    solved = task.solver(batch).poses["pnp"].stats.converged.float().mean()
    run = quiet_trainer(tmp_path, max_epochs=1)
    run.fit(task, DataLoader([batch], batch_size=None))  # type: ignore[arg-type]
    logged = {name: float(value) for name, value in run.callback_metrics.items()}
    pose = logged["train/rotation_loss"] + logged["train/translation_loss"]
    assert logged["train/pose_loss"] == pytest.approx(pose)
    assert logged["train/loss"] == pytest.approx(logged["train/correspondence_loss"] + 0.5 * pose, rel=1e-5)
    assert logged["train/without_pose"] == pytest.approx(1 - float(solved))


def test_the_figures_of_a_step_are_those_of_the_batches_of_all_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """One process has four problems, two of them without a pose, the other one has two."""
    task, values = BlindPnPTask(small_net(), pose_weight=2.0), torch.tensor([0.3, 0.1, 0.5, 0.2, 0.9, 0.4])
    posed = torch.tensor([False, True, False, True, True, True])

    def losses(part: slice) -> Losses:
        pose = {"rotation": values[part] ** 2 * posed[part]}
        return Losses(values[part], torch.ones_like(posed[part]), pose, posed[part], 2.0, torch.tensor([3.0, 2.0, 3.0]))

    def figures(part: slice) -> dict[str, torch.Tensor]:
        return task._figures(losses(part), Prediction(), padded(OWN))

    other = torch.stack(list(figures(slice(4, 6)).values()))
    monkeypatch.setattr("torch.distributed.is_initialized", lambda: True)
    monkeypatch.setattr("torch.distributed.get_world_size", lambda: 2)
    monkeypatch.setattr("torch.distributed.all_reduce", lambda shares: shares.add_(other))
    rotation = float((values**2)[posed].mean())
    assert {name: float(value) for name, value in figures(slice(0, 4)).items()} == pytest.approx(
        {
            "loss": float(values.mean()) + 2 * rotation,
            "correspondence_loss": float(values.mean()),
            "without_pose": 2 / 6,
            "rotation_loss": rotation,
            "pose_loss": rotation,
        },
        abs=1e-6,
    )


@pytest.mark.parametrize("kind", ["correspondence", "likelihood"])
def test_the_correspondence_loss_of_a_step_is_computed_once(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = Mock(side_effect=bpnp.training.losses.correspondence_loss)
    monkeypatch.setattr(bpnp.training.losses, "correspondence_loss", counted)
    run = fit(tmp_path, BlindPnPTask(small_net(), matching_loss=kind), limit_train_batches=2)  # type: ignore[arg-type]
    assert counted.call_count == 2
    assert "train/correspondence_loss" in run.callback_metrics


def test_a_training_without_a_logger_brings_no_warning_of_it(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="You called `self.log")
        fit(tmp_path, BlindPnPTask(small_net()), limit_train_batches=1, limit_val_batches=1)


@pytest.mark.parametrize("precision", ["bf16-true", "16-true"])
def test_a_precision_of_three_digits_is_refused(precision: str, tmp_path: Path) -> None:
    instead = precision.replace("true", "mixed")
    with pytest.raises(ValueError, match=f"trainer.precision is {precision}, in which .* use {instead}, 32-true or"):
        fit(tmp_path, BlindPnPTask(small_net()), precision=precision)


def test_each_of_several_loaders_has_its_own_metrics_and_files(tmp_path: Path) -> None:
    """The problems of both are numbered from 0."""
    task, parts = BlindPnPTask(small_net()), (padded(OWN[:3]), padded(OWN[3:8]))
    loaders = [DataLoader([part], batch_size=None) for part in parts]  # type: ignore[arg-type]
    run = quiet_trainer(tmp_path, callbacks=[ResultsWriter(), PredictionWriter()])
    run.predict(task, loaders)
    tested, validated = run.test(task, loaders, verbose=False), run.validate(task, loaders, verbose=False)
    for i, part in enumerate(parts):
        with torch.no_grad():
            expected = correspondence_loss(task.solver.eval().match(part).assignment, part.match3d).mean()
        for stage, found in (("test", tested), ("val", validated)):
            own = {name for name in found[i] if name.startswith(f"{stage}/")}
            assert all(name.endswith(f"/dataloader_idx_{i}") for name in own)
            loss = found[i][f"{stage}/correspondence_loss/dataloader_idx_{i}"]
            assert loss == pytest.approx(float(expected), rel=1e-5)
        results = read_results(tmp_path / "test" / f"dataloader_idx_{i}")
        assert [row.index for row in results.of("pnp")] == list(range(len(part)))
        median = tested[i][f"test/pnp/rotation_q2_deg/dataloader_idx_{i}"]
        assert median == pytest.approx(results.estimates["pnp"]["rotation_q2_deg"], rel=1e-6)
        lines = (tmp_path / f"dataloader_idx_{i}" / "predictions.csv").read_text().splitlines()
        assert len(lines) == 1 + 3 * len(part)


class ThreeOfFour(nn.Module):
    """The sum of the squares of P, of three samples in four."""

    def forward(self, prediction: Prediction, batch: Batch) -> torch.Tensor:
        assert prediction.assignment is not None
        values = prediction.assignment.square().sum((1, 2))
        return values.where(torch.arange(len(batch)) % 4 < 3, torch.nan)


@pytest.mark.parametrize("needs_pose", [None, False])
def test_the_samples_that_a_loss_leaves_out_are_logged(needs_pose: bool | None, tmp_path: Path) -> None:
    """Without the attribute, a loss gets the poses."""
    task = BlindPnPTask(CountingSolver(), loss=ThreeOfFour())
    task.solver.net.transport = Sinkhorn(tolerance=1e-9, max_iterations=1)
    if needs_pose is not None:
        task.loss.needs_pose = needs_pose
    run = fit(tmp_path, task, limit_train_batches=1)
    logged = {name.removeprefix("train/"): float(value) for name, value in run.callback_metrics.items()}
    assert task.solver.wanted == [needs_pose is None]
    assert logged["left_out"] == 0.25
    assert logged["matching_loss"] == pytest.approx(logged["loss"])
    assert (logged["sinkhorn_iterations"], logged["sinkhorn_unconverged"]) == (1, 1)


def test_an_angle_replaces_the_true_matches_in_training_and_validation(tmp_path: Path) -> None:
    """P is uniform: the loss is 1 - 2 times the fraction of pairs within the angle, counted by numpy."""
    batch = replace(padded(OWN), match3d=None)
    task = BlindPnPTask(small_net(transport=Sinkhorn(mu=1e6)), correspondence_angle=0.2)
    rays = np.concatenate([batch.points2d.numpy(), np.ones((10, 12, 1))], -1)
    camera = batch.points3d.numpy() @ batch.rotation.numpy().transpose(0, 2, 1) + batch.translation.numpy()[:, None]
    rays, camera = (values / np.linalg.norm(values, axis=-1, keepdims=True) for values in (rays, camera))
    within = np.arccos(np.clip(rays @ camera.transpose(0, 2, 1), -1, 1)) <= 0.2
    expected = 1 - 2 * within.mean()
    assert float(task.losses(task.solver.match(batch), batch).total) == pytest.approx(expected, abs=1e-4)
    run, data = quiet_trainer(tmp_path, max_epochs=1), DataLoader([batch], batch_size=None)  # type: ignore[arg-type]
    run.fit(task, data, data)
    for part in ("train", "val"):
        assert float(run.callback_metrics[f"{part}/correspondence_loss"]) == pytest.approx(expected, abs=1e-4)


def test_a_pose_loss_without_its_pose_is_refused(tmp_path: Path) -> None:
    class Matching(CountingSolver):
        estimates = ("ransac",)

    with pytest.raises(ValueError, match="The pose loss needs the pose 'pnp', and Matching returns 'ransac'"):
        BlindPnPTask(Matching(), pose_weight=1.0)
    with pytest.raises(ValueError, match="The pose loss needs the pose 'pnp', and Matching returns 'ransac'"):
        fit(tmp_path, BlindPnPTask(Matching()), max_steps=1, callbacks=[PoseLossWarmup(start_epoch=100)])


def test_the_errors_of_a_pose_are_computed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the metrics, the rows of the results and the points of the page, for two batches and three estimates."""
    counted = Mock(side_effect=bpnp.metrics.pose_errors)
    monkeypatch.setattr(bpnp.metrics, "pose_errors", counted)
    run = quiet_trainer(tmp_path, callbacks=[ResultsWriter()])
    run.test(BlindPnPTask(small_net()), datamodule=small_meshes(tmp_path, eval_batch_size=4), verbose=False)
    assert counted.call_count == 2 * 3


def test_a_test_writes_results_and_a_prediction_poses(tmp_path: Path) -> None:
    module = small_meshes(tmp_path, num_points=40, noise_px=0.0)
    task = BlindPnPTask(small_net())
    run = quiet_trainer(tmp_path, callbacks=[ResultsWriter()])
    run.test(task, datamodule=module, verbose=False)
    results = read_results(tmp_path / "test")
    assert len(results.rows) == 7 * 3
    assert {row.id for row in results.rows} == {pair for batch in module.test_dataloader() for pair in batch.ids}
    logged = float(run.callback_metrics["test/rotation_q2_deg"])
    assert logged == pytest.approx(results.estimates["ransac"]["rotation_q2_deg"], rel=1e-6)
    assert float(run.callback_metrics["test/correspondence_loss"]) == pytest.approx(results.correspondence_loss)


# Ten problems without a number, as a user's own data set gives them; `padded` collates them as docs/data.md shows.
OWN = [plant(1, 12, seed=number, dtype=torch.float32) for number in range(10)]


def test_problems_that_are_numbered_within_their_batch_are_all_counted(tmp_path: Path) -> None:
    task, one_batch, loader = BlindPnPTask(small_net()), padded(OWN), DataLoader(OWN, 2, collate_fn=padded)
    run = quiet_trainer(tmp_path, callbacks=[ResultsWriter()])
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="expected one (pair|problem) per")
        run.test(task, loader, verbose=False)
        tested = dict(run.callback_metrics)
        run.validate(task, loader, verbose=False)
        validated = dict(run.callback_metrics)
    rows = read_results(tmp_path / "test").of("ransac")
    assert [(row.index, row.id) for row in rows] == [(i, str(i)) for i in range(10)]
    with torch.no_grad():
        expected = correspondence_loss(task.solver.eval().match(one_batch).assignment, one_batch.match3d).mean()
    assert float(tested["test/correspondence_loss"]) == pytest.approx(float(expected), rel=1e-5)
    assert float(validated["val/correspondence_loss"]) == pytest.approx(float(expected), rel=1e-5)


@pytest.mark.parametrize("refine", [False, True])
def test_a_validation_refines_poses_on_request(refine: bool, tmp_path: Path) -> None:
    run = quiet_trainer(tmp_path)
    task = BlindPnPTask(small_net(), refine_validation=refine)
    run.validate(task, DataLoader(OWN[:2], 2, collate_fn=padded), verbose=False)
    assert ("val/refined/rotation_q2_deg" in run.callback_metrics) == refine
    assert "val/pnp/rotation_q2_deg" in run.callback_metrics


@pytest.mark.parametrize(
    ("answer", "estimates", "error"),
    [
        (lambda batch: batch.points2d, ("a",), "Answering returned a Tensor, not a Prediction"),
        (
            lambda batch: Prediction(poses={"b": posed(batch.rotation, batch.translation)}),
            ("a",),
            r"of Answering has no a, which its `estimates` name, among \['b'\]",
        ),
        (
            lambda batch: Prediction(poses={"a": posed(batch.rotation, batch.translation)}),
            "a",
            r"`estimates` of the solver is 'a'; it is a tuple of names: \('a',\)",
        ),
        (
            lambda batch: Prediction(poses={"a": posed(batch.rotation[:1], batch.translation[:1])}),
            ("a",),
            r"rotations \(1, 3, 3\) .* instead of \(2, 3, 3\)",
        ),
    ],
)
def test_a_wrong_prediction_of_a_solver_is_named(answer: Any, estimates: Any, error: str, tmp_path: Path) -> None:
    class Answering(nn.Module):
        forward = staticmethod(answer)

    Answering.estimates = estimates
    with pytest.raises(ValueError, match=error):
        quiet_trainer(tmp_path).test(BlindPnPTask(Answering()), DataLoader(OWN[:2], 2, collate_fn=padded))


def test_a_loader_that_gives_no_batch_is_named(tmp_path: Path) -> None:
    for run in (quiet_trainer(tmp_path).fit, quiet_trainer(tmp_path).test):
        with pytest.raises(ValueError, match=r"the loaders .* return a list, not a Batch; use a `collate_fn`"):
            run(BlindPnPTask(small_net()), DataLoader([(torch.rand(5, 2), torch.rand(5, 3))] * 2, 2))


def test_repeated_numbers_are_refused_in_several_processes() -> None:
    first, second = padded(OWN[:2]), padded(OWN[2:4])
    numbers = set[int]()
    number_globally(first, numbers, processes=2)
    assert numbers == {0, 1}
    with pytest.raises(ValueError, match=r"some of the numbers \[0, 1\] in `Batch.index` repeat"):
        number_globally(second, numbers, processes=2)


def test_a_training_starts_from_packaged_weights_or_those_of_a_file(tmp_path: Path) -> None:
    packaged = Matcher.from_pretrained("matcher-clutter")
    task = BlindPnPTask(Matcher(), weights="matcher-clutter")
    assert all(torch.equal(own, packaged.state_dict()[key]) for key, own in task.solver.state_dict().items())
    trainer = quiet_trainer(tmp_path, max_epochs=0)
    small = BlindPnPTask(Matcher(channels=16, depth=1))
    trainer.strategy.connect(small)
    trainer.save_checkpoint(tmp_path / "small.ckpt", weights_only=True)
    other = BlindPnPTask(Matcher(channels=16, depth=1), weights=str(tmp_path / "small.ckpt"))
    assert all(torch.equal(a, b) for a, b in zip(small.parameters(), other.parameters(), strict=True))
    # In a view's frame the net has a part more, which adds nothing at first.
    view = BlindPnPTask(Matcher(channels=16, depth=1, frame="view"), weights=str(tmp_path / "small.ckpt"))
    batch = Batch.from_arrays(torch.rand(1, 9, 2), torch.rand(1, 12, 3) + 1)
    torch.testing.assert_close(view.solver.match(batch).assignment, small.solver.match(batch).assignment)
    with pytest.raises(ValueError, match=r"another Matcher: channels=128 \(saved: 16\), depth=6 \(saved: 1\)"):
        BlindPnPTask(Matcher(), weights=str(tmp_path / "small.ckpt"))
    with pytest.raises(FileNotFoundError, match="matcher-of-none"):
        BlindPnPTask(Matcher(), weights="matcher-of-none")


def test_overfit_batches_repeats_the_same_problems(tmp_path: Path) -> None:
    seen: list[tuple[str, ...]] = []

    class Seen(Callback):
        def on_train_batch_start(self, trainer: Trainer, pl_module: object, batch: Batch, batch_idx: int) -> None:
            seen.append(batch.ids)

    run = quiet_trainer(tmp_path, callbacks=[Seen()], max_epochs=3, overfit_batches=2)
    run.fit(BlindPnPTask(small_net()), datamodule=small_meshes(tmp_path, train_problems=32, batch_size=4))
    assert len(seen) == 6
    assert len(set(seen)) == 2
    assert seen[:2] * 3 == seen


def test_a_switch_is_that_of_one_training(tmp_path: Path) -> None:
    warmup, first, second = (
        PoseLossWarmup(start_epoch=1),
        BlindPnPTask(CountingSolver()),
        BlindPnPTask(CountingSolver()),
    )
    fit(tmp_path, first, max_epochs=2, limit_train_batches=1, callbacks=[warmup])
    fit(tmp_path, second, max_epochs=2, limit_train_batches=1, callbacks=[warmup])
    assert first.solver.wanted == second.solver.wanted == [False, True]


def test_a_stopped_training_leaves_the_weight_of_the_pose_loss_as_it_was(tmp_path: Path) -> None:
    class Stop(Callback):
        def on_train_batch_end(self, *_: object) -> None:
            raise RuntimeError("stopped")

    task = BlindPnPTask(CountingSolver(), pose_weight=0.5)
    with pytest.raises(RuntimeError, match="stopped"):
        fit(tmp_path, task, max_epochs=2, limit_train_batches=1, callbacks=[PoseLossWarmup(start_epoch=1), Stop()])
    assert task.pose_weight == 0.5


class Turned(nn.Module):
    """A solver whose poses are off by an angle."""

    estimates = ("pnp",)
    degrees = 100.0

    def forward(self, batch: Batch) -> Prediction:
        turn = torch.as_tensor(Rotation.from_euler("x", self.degrees, degrees=True).as_matrix())
        return Prediction(poses={"pnp": posed((turn @ batch.rotation.double()).float(), batch.translation.float())})


def test_an_interrupted_validation_does_not_count_in_the_next(tmp_path: Path) -> None:
    class Stop(Callback):
        def on_validation_batch_end(self, *_: object) -> None:
            raise RuntimeError("stopped")

    task, data = BlindPnPTask(Turned()), small_meshes(tmp_path)
    with pytest.raises(RuntimeError, match="stopped"):
        quiet_trainer(tmp_path, max_epochs=1, callbacks=[Stop()]).validate(task, datamodule=data, verbose=False)
    task.solver.degrees = 10.0
    run = quiet_trainer(tmp_path, max_epochs=1)
    run.validate(task, datamodule=data, verbose=False)
    assert float(run.callback_metrics["val/rotation_q3_deg"]) == pytest.approx(10, abs=0.01)


def test_another_optimizer_may_follow_where_no_checkpoint_is_resumed(tmp_path: Path) -> None:
    class WithSGD(BlindPnPTask):
        def configure_optimizers(self) -> torch.optim.Optimizer:  # type: ignore[override]
            return torch.optim.SGD(self.parameters(), lr=1e-4)

    adam = fit(tmp_path, BlindPnPTask(small_net()), limit_train_batches=1)
    adam.save_checkpoint(file := str(tmp_path / "adam.ckpt"))
    task = WithSGD.load_from_checkpoint(file)
    task.skipped_steps = 3
    fit(tmp_path, task, limit_train_batches=1)
    assert task.skipped_steps == 0
    with pytest.raises(ValueError, match="trained with Adam, and this run uses SGD"):
        fit(tmp_path, WithSGD(small_net()), file, max_epochs=2, limit_train_batches=1)
