"""Fine-tuning without labels (section 5 of the paper): packaged weights before and after 120 steps on a scene.

    python -m benchmarks finetune            # minutes
    python -m benchmarks finetune --check    # whether docs/train.md is what the record says

The loss is the reprojection error of the pose that the network finds (configs/paper/finetune_reprojection.yaml). Poses
and matches of the photos only measure.
"""

import argparse
import json
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import torch
from paper_tables import figures, fill_pages, head, network, row_text, solve_problems, trained_steps
from record import DATA, ROOT, write

from bpnp.datamodules import ColmapDataModule
from bpnp.models.weights import checkpoint_path

WEIGHTS = "procedural-so3"
SCENES = ("fountain-P11", "statue_of_liberty")
POINTS = 128
RECALL = (10.0, 1.0)  # degrees, scene units
FILE, PAGES = ROOT / "benchmarks" / "finetune.json", (ROOT / "docs" / "train.md",)


def fine_tune(scene: Path, folder: Path) -> Path:
    """Fine-tune the weights to the photos of a scene, unless that was done, and return the checkpoint."""
    checkpoint = folder / "checkpoints" / "last.ckpt"
    if not checkpoint.is_file():
        command = [
            sys.executable, "-m", "bpnp", "fit", "--config=paper/finetune_reprojection", f"--data.root={scene}",
            f"--trainer.default_root_dir={folder}", "--trainer.enable_progress_bar=false",
        ]  # fmt: skip
        print(" ".join(command[1:]), flush=True)
        subprocess.run(command, check=True)
    return checkpoint


def table(record: dict[str, Any]) -> str:
    """The rows of all scenes, before and after."""
    lines = []
    for key, found in record["rows"].items():
        scene, when, estimate = key.split("|")
        lines.append(row_text(f"{scene}, `{estimate}`, {when}", found))
    return head(RECALL) + "".join(lines)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--data", type=Path, default=DATA, help="folder with colmap")
    options.add_argument("--run", type=Path, default=ROOT / "runs" / "finetune", help="(default: %(default)s)")
    options.add_argument("--scenes", nargs="*", default=list(SCENES), help="(default: %(default)s)")
    options.add_argument("--output", type=Path, default=FILE, help="(default: %(default)s)")
    options.add_argument("--check", action="store_true", help="compare the page with the record, measure nothing")
    chosen = options.parse_args()
    record: dict[str, Any] = json.loads(chosen.output.read_text()) if chosen.output.is_file() else {}
    record = {"rows": record.get("rows", {})}
    if not chosen.check:
        torch.set_num_threads(1)
        for name in chosen.scenes:
            scene = chosen.data / "colmap" / name
            after = fine_tune(scene, chosen.run / name)
            for when, checkpoint in {"before": checkpoint_path(WEIGHTS), "after": after}.items():
                data = ColmapDataModule(str(scene), test_fraction=1.0, eval_max_points=POINTS)
                file = chosen.run / name / f"{when}.jsonl"
                identity = {"steps": trained_steps(checkpoint), "bytes": checkpoint.stat().st_size}
                rows = solve_problems(file, partial(network, checkpoint), data, sys.maxsize, identity)
                for estimate in ("ransac", "pnp"):
                    found = figures([row for row in rows if row.estimate == estimate], RECALL)
                    record["rows"][f"{name}|{when}|{estimate}"] = found | {"steps": 0 if when == "before" else 120}
                    print(f"{name}, {when}, {estimate}: {found}", flush=True)
            write(chosen.output, record)
    fill_pages(PAGES, "finetune", {"scenes": table(record)}, check=chosen.check)
