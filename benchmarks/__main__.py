"""All benchmarks of the layers on a CPU, in one command.

    python benchmarks [--quick]
    python benchmarks --against REV: this tree beside an older commit (`against.py`)

Prints the tables of the layers against the paper's method, of time and memory by size, and of RANSAC's backends, and
writes them with their plots to benchmarks/results/<machine kind>.json, scaling-<...>.json and ransac-<...>.json.
"""

import argparse
import sys
from pathlib import Path

import against
import bench_layers
import bench_ransac
import bench_scaling
from timing import machine, restart_with_settings

RESULTS = Path(__file__).parent / "results"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small problems, to see that it works")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the files")
    options = parser.parse_args()
    kind, folder = machine()["kind"], options.results
    layers, scaling, ransac = (folder / f"{name}{kind}.json" for name in ("", "scaling-", "ransac-"))
    bench_layers.main(["--out", str(layers), *(["--quick"] if options.quick else ["--rounds", "3"])])
    sizes = ["--sizes", "250", "500"] if options.quick else []
    bench_scaling.main(["--out", str(scaling), *sizes])
    problems = ["--problems", "2"] if options.quick else []
    bench_ransac.main(["--json", str(ransac), *problems])


if __name__ == "__main__":
    if any(argument.startswith("--against") for argument in sys.argv):
        against.main()
    else:
        restart_with_settings()
        main()
