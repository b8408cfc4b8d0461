"""The paper's printed results, for orientation beside ours: other data, another machine."""

from collections.abc import Mapping
from typing import Literal

Paper = Literal["modelnet40", "megadepth"]
NAMES: Mapping[Paper, str] = {"modelnet40": "ModelNet40", "megadepth": "MegaDepth"}
ERRORS = (("rotation", "_deg"), ("translation", ""), ("reprojection", "_deg"))
KEYS = (*(f"{error}_q{number}{unit}" for error, unit in ERRORS for number in (1, 2, 3)), "seconds_mean")
RECALL: Mapping[Paper, str] = {"modelnet40": "recall_joint_15deg_0.5", "megadepth": "recall_joint_10deg_1"}


def _rows(paper: Paper, text: str) -> dict[str, dict[str, str]]:
    """A row per line: label | nine quartiles, seconds and, for some, the recall in %."""
    lines = (line.split("|") for line in text.strip().splitlines())
    return {label.strip(): dict(zip((*KEYS, RECALL[paper]), numbers.split(), strict=False)) for label, numbers in lines}


# Campbell, Liu, Gould, ECCV 2020, tables 1 and 2, recalls from the text. R: the RANSAC estimate. SoftPOSIT, RANSAC and
# GOSMA were stopped after 30 s; SoftPOSIT started from the mean pose (table 1) or near the true one (table 2).
PUBLISHED: Mapping[Paper, Mapping[str, Mapping[str, str]]] = {
    "modelnet40": _rows(
        "modelnet40",
        """
        SoftPOSIT | 16.1 21.8 28.0 0.33 0.49 0.72 2.82 3.98 5.21 27
        RANSAC    | 90.8 139  165  0.43 1.15 3.08 4.22 5.87 8.06 30
        GOSMA     | 10.1 22.1 52.0 0.25 0.46 0.75 1.04 1.62 3.11 30
        Lc        | 6.08 11.3 18.3 0.34 0.52 0.81 0.56 0.86 1.31 0.1
        Lc Lp     | 4.88 9.66 16.0 0.04 0.08 0.15 0.36 0.61 1.03 0.1 72
        Lc R      | 5.49 11.7 20.0 0.04 0.09 0.20 0.37 0.70 1.25 0.1
        Lc Lp R   | 3.33 8.09 15.8 0.04 0.08 0.16 0.28 0.52 1.01 0.1
        """,
    ),
    "megadepth": _rows(
        "megadepth",
        """
        SoftPOSIT | 1.81 21.4 165  0.24 1.53 6.10 0.92 7.85 24.1 18
        RANSAC    | 66.6 122  155  6.80 15.2 28.2 4.45 8.77 13.3 30
        GOSMA     | 8.69 86.8 145  1.07 5.67 9.34 1.30 13.7 37.1 30
        Lc        | 1.91 4.47 11.4 0.52 1.05 2.34 0.54 1.12 2.81 0.2
        Lc Lp     | 1.32 3.31 8.84 0.21 0.46 1.08 0.21 0.53 1.64 0.2 73
        Lc R      | 0.44 1.55 7.70 0.05 0.18 0.80 0.06 0.16 1.27 0.2
        Lc Lp R   | 0.34 1.00 4.88 0.04 0.12 0.53 0.06 0.12 0.74 0.2 82
        """,
    ),
}
