"""What each part of the search buys: the same pairs and batches with one part taken out.

python benchmarks/bench_ablation.py --data ../shared/data --limit 20 --max-batches 6 psb-so3 psb-0.5 walkthrough
"""

import argparse
import importlib
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from bench_search import run, summary, write_json

from bpnp.search import annealing, scene
from bpnp.search.starts import Array

Part = list[tuple[Any, str, Any]]  # module, name, value


def parts() -> dict[str, Part]:
    """What is patched to take a part out."""
    search = importlib.import_module("bpnp.search.many")  # bpnp.search.many is the function
    first = annealing.RECIPES[0]
    few = tuple(recipe._replace(outliers=0.01) for recipe in annealing.RECIPES)
    return {
        "everything": [],
        "random subsets instead of clusters": [(scene, "_clusters", _subset)],
        "no middle stage": [(annealing, "MIDDLE_ROUNDS", 1)],
        "no poses shaken around the best": [(annealing, "SHAKEN", 0)],
        "steps of the model's length": [(annealing, "RELAXATION", np.float32(1))],
        "one recipe for all batches": [(search, "RECIPES", (first,))],
        "300 starts a batch": [(annealing, "STARTS", 300)],
        "no outliers expected": [(search, "RECIPES", few), (search, "FINE_OUTLIERS", 0.01)],
        "one Sinkhorn sweep in the fine stage": [(annealing, "SWEEPS", 1)],
        "one share of outliers at the end": [(annealing, "SHARES", ())],
    }


def _subset(points: Array, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    chosen = points[rng.choice(len(points), min(count, len(points)), replace=False)]
    return chosen, np.full(len(chosen), len(points) / len(chosen), np.float32)


def without(part: Part, work: Callable[[], list[dict]]) -> list[dict]:
    with ExitStack() as stack:
        for module, name, value in part:
            stack.enter_context(patch.object(module, name, value))
        return work()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--limit", type=int, default=20)
    parser.add_argument("--max-batches", type=int, default=6)
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    run("psb", options.data, 1, 0, None, 1)  # compiles
    results: dict[str, dict] = {}
    for name, part in parts().items():
        results[name] = {}
        for data in options.sets:
            rows = without(part, partial(run, data, options.data, options.limit, 0, None, options.max_batches))
            results[name][data] = summary(data, rows) | {"max_batches": options.max_batches}
        print(
            f"{name:36s}",
            "  ".join(
                f"{data} {row['rotation_q_deg'][1]:6.2f} deg {row['under_2_deg']:4.0%} {row['cpu_seconds_mean']:5.2f} s"
                for data, row in results[name].items()
            ),
            flush=True,
        )
        if options.output:
            write_json(options.output, results)


if __name__ == "__main__":
    main()
