"""What each part of the search buys: the same pairs and batches with one part taken out.

python benchmarks/bench_ablation.py --data ../shared/data --limit 20 --max-batches 6 psb-so3 psb-0.5 walkthrough
"""

import argparse
import warnings
from dataclasses import replace
from pathlib import Path

from bench_search import run, summary, write_json

from bpnp.search.settings import SearchSettings, Shaking


def variants(full: SearchSettings) -> dict[str, SearchSettings]:
    """Settings without one part each."""
    return {
        "everything": full,
        "random points instead of cluster centres": replace(full, lloyd_iterations=0),
        "no middle stage": replace(full, middle=tuple(replace(stage, iterations=1) for stage in full.middle)),
        "no poses shaken around the best": replace(full, shaking=Shaking(poses=0)),
        "one recipe for all batches": replace(full, recipes=full.recipes[:1]),
        "300 starts a batch": replace(full, starts=300),
        "hardly any outliers expected": replace(full, outliers=0.01),
        "one share of outliers at the end": replace(full, end_outliers=()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--limit", type=int, default=20)
    parser.add_argument("--max-batches", type=int, default=6)
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    run("psb", options.data, 1, 0, SearchSettings(turns=1))  # compiles
    results: dict[str, dict] = {}
    for name, settings in variants(SearchSettings(turns=options.max_batches)).items():
        results[name] = {}
        for data in options.sets:
            rows = run(data, options.data, options.limit, 0, settings)
            results[name][data] = summary(data, rows) | {"max_batches": options.max_batches}
        print(
            f"{name:40s}",
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
