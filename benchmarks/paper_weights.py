"""The packaged weights `paper-lc` and `paper-lclp`: the paper's losses on drawn shapes, which have no data licence.

    python -m benchmarks paper_weights                     # an hour; a run that was stopped goes on
    python -m benchmarks paper_weights --output elsewhere  # keeps the weights of the package

The settings are those of configs/paper/modelnet40.yaml but for `SETTINGS` and for what each of `STAGES` has: 40,000
fixed problems of 4,000 drawn shapes. The first stage starts from `procedural-euler`, which was trained on few points
first (docs/model-card.md). `paper-lclp` goes on from `paper-lc` with the pose loss. A stage with the likelihood comes
before each. Stages and learning rates were chosen by the errors on 120 of ModelNet10's training shapes.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from paper_tables import Training
from record import ROOT

from bpnp.models.weights import WEIGHTS, pack_weights
from bpnp.training.losses import MatchingLoss

EPOCH = 50  # steps between checkpoints
SOLVER = "--model.solver.init_args"
SETTINGS = (
    "--config=paper/modelnet40", "--data.root=null", "--data.train_shapes=4000", "--data.val_shapes=48",
    f"{SOLVER}.features2d.class_path=bpnp.models.nets.ImageFeatures",
    f"{SOLVER}.features2d.init_args.centre=true", f"{SOLVER}.features2d.init_args.scale=4.0",
    f"{SOLVER}.features3d.class_path=bpnp.models.nets.SceneFeatures",
    f"{SOLVER}.features3d.init_args.centre=true", f"{SOLVER}.features3d.init_args.normalise=true",
    "--model.weights=procedural-euler", "--model.warmup_steps=10", "--trainer.limit_val_batches=0",
    "--trainer.precision=bf16-mixed", "--trainer.gradient_clip_val=5",
)  # fmt: skip


@dataclass(frozen=True)
class Stage:
    """One stage of the training; it continues the one before.

    points: of each problem, out of the 1,000 fixed points of its shape.
    learning_rate: falls by a half cosine within the stage.
    packaged: whether its end is one of the packaged weights.
    """

    name: str
    points: int
    batch: int
    steps: int
    learning_rate: float
    loss: MatchingLoss = "correspondence"
    pose_loss: bool = False
    packaged: bool = True


STAGES = (
    Stage("likelihood", points=500, batch=8, steps=2400, learning_rate=1e-4, loss="likelihood", packaged=False),
    Stage("paper-lc", points=1000, batch=8, steps=200, learning_rate=3e-5),
    Stage("likelihood-lp", 500, 8, steps=1900, learning_rate=7e-5, loss="likelihood", pose_loss=True, packaged=False),
    Stage("paper-lclp", points=1000, batch=8, steps=300, learning_rate=1e-5, pose_loss=True),
)


def trainings(folder: Path) -> Iterator[tuple[Stage, Training]]:
    """Yield each stage with its training, which starts where the one before ends."""
    switch = sum(stage.steps for stage in STAGES if not stage.pose_loss) // EPOCH
    end, start = 0, None
    for stage in STAGES:
        decay = (f"--model.decay_start={end}", f"--model.decay_steps={stage.steps}")
        end += stage.steps
        arguments = (
            *SETTINGS, f"--data.num_points={stage.points}", f"--data.batch_size={stage.batch}",
            f"--model.learning_rate={stage.learning_rate}", f"--model.matching_loss={stage.loss}",
            f"--pose_loss.start_epoch={switch}", *decay,
        )  # fmt: skip
        training = Training(folder / stage.name, arguments, end, EPOCH, start)
        yield stage, training
        start = training.checkpoint


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--run", type=Path, default=ROOT / "runs" / "paper_weights", help="(default: %(default)s)")
    options.add_argument("--output", type=Path, default=Path(str(WEIGHTS)), help="folder (default: the package's)")
    chosen = options.parse_args()
    for stage, training in trainings(chosen.run):
        checkpoint = training.run()
        if stage.packaged:
            pack_weights(checkpoint, chosen.output / f"{stage.name}.ckpt")
            print(f"wrote {chosen.output / stage.name}.ckpt", flush=True)
