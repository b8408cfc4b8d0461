"""Files of version 0.1.0 are read, or refused with an error that names a remedy."""

import json
from pathlib import Path

import numpy as np
import pytest

from bpnp import Solution
from bpnp.datamodules.store import StoreError, open_store
from bpnp.examples import load

RELEASED = Path(__file__).parent / "released"


def test_a_solution_of_the_last_release_is_read() -> None:
    """`solution-0.1.0.json` is what `bpnp.solve` of that version gave for the LEDs of `bpnp.examples`."""
    solution, ring = Solution.from_json(RELEASED / "solution-0.1.0.json"), load("leds")
    assert solution.verdict == "confident"
    assert ring.rotation_error_deg(solution.rotation) < 1
    assert len(solution.matches) == 10
    assert np.isnan(solution.rotation_std_deg)  # which it did not know
    assert solution.stats.taken2d == 0
    assert Solution.from_json(solution.to_json()).reason == solution.reason
    cut = json.loads((RELEASED / "solution-0.1.0.json").read_text())
    del cut["rotation"]
    with pytest.raises(ValueError, match="not the JSON of a solution: its field 'rotation' is missing"):
        Solution.from_json(json.dumps(cut))


def test_a_store_of_the_last_release_is_refused_with_the_advice_to_prepare_it_again(tmp_path: Path) -> None:
    manifest = {"format": 3, "kind": "problems", "rows": 0, "bulk": [], "columns": {}, "checksum": 0}
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(StoreError, match="holds problems in format 3, not problems in format 4; .*prepare it again"):
        open_store(tmp_path, "problems")
