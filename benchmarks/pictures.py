"""Pictures of solved pairs: a clean mesh, the points of a photo among clutter, and a failure.

python benchmarks/pictures.py --data ../shared/data --output docs/images psb:3 south_building-0.50:7 psb-1.0:5
Each pair is SET:NUMBER, a set of bench_search.py and a place in it.
"""

import argparse
import warnings
from pathlib import Path

import torch
from bench_search import source

from bpnp import solve
from bpnp.metrics import rotation_error
from bpnp.report.figures import save_figure
from bpnp.solving.pictures import solution_picture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="+")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--output", type=Path, default=Path("docs/images"))
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    for name in options.pairs:
        data, _, number = name.rpartition(":")
        pair = source(data, options.data, 100).problem(int(number))
        assert pair.rotation is not None
        solution = solve(pair.points2d[0], pair.points3d[0], seed=options.seed)
        error = float(rotation_error(torch.as_tensor(solution.rotation), pair.rotation[0]))
        figure = solution_picture(solution, title=f"{pair.ids[0]}: {error:.3g} deg off")
        path = save_figure(figure, options.output / f"solve-{data}-{number}.png")
        count, seconds = solution.inlier_count, solution.seconds
        print(f"{path}: {solution.verdict}, {error:.3g} deg off, {count} matches, {seconds:.1f} s")


if __name__ == "__main__":
    main()
