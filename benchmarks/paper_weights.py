"""The packaged weights `paper-lc` and `paper-lclp`: the paper's losses on drawn shapes, which have no data licence.

    python -m benchmarks paper_weights                     # 4.5 hours; a run that was stopped goes on
    python -m benchmarks paper_weights --output elsewhere  # keeps the weights of the package

The settings are those of configs/paper/modelnet40.yaml but for `SETTINGS` and for what each of `STAGES` has.
`paper-lclp` goes on from `paper-lc` with the pose loss. Stages and learning rates were chosen by the losses on drawn
shapes and on training shapes of ModelNet10.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from paper_tables import Training
from record import ROOT

from bpnp.datamodules.shapes import ProceduralKind
from bpnp.models.weights import WEIGHTS, pack_weights
from bpnp.training.losses import MatchingLoss

EPOCH = 50  # steps between checkpoints
SOLVER = "--model.solver.init_args"
SETTINGS = (
    "--config=paper/modelnet40", "--data.root=null", "--data.train_shapes=16000", "--data.val_shapes=48",
    "--data.fresh_views=true",
    f"{SOLVER}.features2d.class_path=bpnp.models.nets.ImageFeatures",
    f"{SOLVER}.features2d.init_args.centre=true", f"{SOLVER}.features2d.init_args.scale=4.0",
    f"{SOLVER}.features3d.class_path=bpnp.models.nets.SceneFeatures",
    f"{SOLVER}.features3d.init_args.centre=true", f"{SOLVER}.features3d.init_args.normalise=true",
    f"{SOLVER}.refinement.init_args.enabled=true",  # in a test of the weights; the paper's recipe has none
    "--trainer.limit_val_batches=0",
    "--trainer.precision=bf16-mixed", "--trainer.gradient_clip_val=5",
)  # fmt: skip
ADAM = 0.2  # learning rate of Adam for the parameters that Muon does not train, as a fraction of Muon's


@dataclass(frozen=True)
class Stage:
    """One stage of the training; it continues the one before."""

    name: str
    points: int  # of each problem, out of the 1,000 fixed points of its shape
    steps: int
    learning_rate: float  # constant, or with `decay` falling by a half cosine within the stage
    loss: MatchingLoss = "likelihood"
    kind: ProceduralKind = "aligned"  # of the drawn shapes (`MeshDataModule`)
    pose_loss: bool = False
    pose_weight: float = 1.0  # gamma_p of Eq. 15 in a stage with the pose loss; the paper has 1
    decay: bool = True
    muon: bool = True  # False: Adam, as in the paper, which starts at step 0, with a warm-up
    packaged: bool = False  # its end is one of the packaged weights


STAGES = (
    Stage("few-points", points=128, steps=2000, learning_rate=1e-2, kind="turned", decay=False),
    Stage("turned", points=256, steps=3750, learning_rate=1e-2, kind="turned", decay=False),
    Stage("aligned", points=256, steps=14250, learning_rate=1e-2, decay=False),
    Stage("likelihood", points=256, steps=3000, learning_rate=1e-2),
    Stage("paper-lc", 1000, 200, 1e-3, "correspondence", packaged=True),
    Stage("likelihood-lp", 256, 1750, 3e-3, pose_loss=True),
    Stage("both", 1000, 1200, 3e-3, "correspondence", pose_loss=True),
    Stage("both-adam", 1000, 400, 2e-4, "correspondence", pose_loss=True, muon=False),
    Stage("both-adam-2", 1000, 700, 4e-4, "correspondence", pose_loss=True, muon=False),
    Stage("paper-lclp", 1000, 2700, 6e-4, "correspondence", pose_loss=True, pose_weight=4, muon=False, packaged=True),
)


def trainings(folder: Path) -> Iterator[tuple[Stage, Training, int]]:
    """Yield each stage, its training, which starts where the stage before it ends, and the steps of all until there."""
    total, end = 0, 0  # steps of all stages, and those of the checkpoint
    checkpoint: Path | None = None
    for stage in STAGES:
        if stage.muon:
            start, initial = end, checkpoint
            rates = (f"--optimizer.lr={stage.learning_rate}", f"--optimizer.adam_lr={ADAM * stage.learning_rate}")
            optimizer: tuple[str, ...] = ("--model.warmup_steps=50", "--optimizer=bpnp.training.Muon", *rates)
        else:
            start, initial = 0, None
            rate = f"--model.learning_rate={stage.learning_rate}"
            optimizer = ("--model.warmup_steps=20", rate, f"--model.weights={checkpoint}")
        end, total = start + stage.steps, total + stage.steps
        decay = (f"--model.decay_start={start}", f"--model.decay_steps={stage.steps}") if stage.decay else ()
        first = (start if stage.pose_loss else end) // EPOCH  # with the pose loss; `end` is never reached
        arguments = (
            *SETTINGS, f"--data.num_points={stage.points}", "--data.batch_size=8",
            f"--data.procedural_kind={stage.kind}", *optimizer, *decay,
            f"--model.matching_loss={stage.loss}", f"--pose_loss.start_epoch={first}",
            f"--pose_loss.weight={stage.pose_weight:g}",
        )  # fmt: skip
        training = Training(folder / stage.name, arguments, end, EPOCH, initial)
        yield stage, training, total
        checkpoint = training.checkpoint


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--run", type=Path, default=ROOT / "runs" / "paper_weights", help="(default: %(default)s)")
    options.add_argument("--output", type=Path, default=Path(str(WEIGHTS)), help="folder (default: the package's)")
    chosen = options.parse_args()
    for stage, training, steps in trainings(chosen.run):
        checkpoint = training.run()
        if stage.packaged:
            pack_weights(checkpoint, chosen.output / f"{stage.name}.ckpt", steps=steps)
            print(f"wrote {chosen.output / stage.name}.ckpt", flush=True)
