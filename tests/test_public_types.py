"""Types of the public functions: mypy accepts right calls and rejects wrong ones."""

import re
from pathlib import Path

import pytest
from mypy import api

pytestmark = pytest.mark.nightly

ROOT = Path(__file__).parents[1]
HEAD = """
from pathlib import Path
import cv2
import numpy as np
import pandas as pd
import pycolmap
import torch
import trimesh
from bpnp import Batch, BPnPNet, GravityPrior, Matcher, PosePrior, SceneMap, solve, solve_many, verify

x, p, K = np.zeros((5, 2)), np.zeros((5, 3)), np.eye(3)
pinhole, sized = ("PINHOLE", [800.0, 800, 320, 240]), ("PINHOLE", 640, 480, (800, 800, 320, 240))
solution, scene = solve(x, p), SceneMap.from_colmap("sparse/0")
"""
RIGHT = """
solve(x.tolist(), torch.zeros(5, 3), [[800, 0, 320], [0, 800, 240], [0, 0, 1]])
solve([(1, 2), (3, 4)], ((1, 2, 3), (3, 4, 5)), image_size=(640, 480))
solve([cv2.KeyPoint()], trimesh.PointCloud(p), pinhole, focal_error=0.1)
solve(pd.DataFrame(x), p, (K, None))
solve(x, p, K, np.zeros(5))
solve(x, p, [800, 800, 320.0, 240], [0.1, 0, 0, 0])
solve(x, p, (800, 800, 320, 240), distortion=None)
solve_many([x, x], p, [[800, 800, 320.0, 240], K])
solve(x, p, (K, [0.1, 0, 0, 0]), labels2d=[1, 2], labels3d=np.arange(2), scores2d=[0.4, 1], normals3d=p)
solve(x, p, pycolmap.Camera(), labels2d=torch.zeros(5, 3), labels3d=p)
solve(x, p, {"model": "PINHOLE", "params": [800.0, 800, 320, 240]}, time_limit=1, seed=3)
solve(x, p, solution.camera, prior=solution)
solve(x, p, prior=PosePrior(K, None, 3.0), solver="search")
solve(x, p, prior=GravityPrior([0, -1, 0], [0, 0, 1]), solver=Path("net.ckpt"))
solve(x, p, prior=BPnPNet.from_pretrained("procedural-so3"), solver=Matcher.from_pretrained("matcher-maps"))
solve(x, p, prior=(K, [0, 0, 5]))
solve(x, p, prior=np.eye(4).tolist())
solve(x, p, prior=pycolmap.Rigid3d())
solve(x, p, prior="learned")
solve([x, x], p, [pinhole, sized], rig=[pycolmap.Rigid3d(), (K, [0.1, 0, 0])], scores2d=[np.ones(5), None])
solve([x, x], p, K, rig=[np.eye(4)] * 2, labels2d=[[1, 2], np.arange(2)], labels3d=[1, 2])
solve_many([x, torch.zeros(5, 2)], p, [K, pinhole, None], prior=[PosePrior(K, None, 3.0), solution, None])
solve_many(np.stack([x, x]), [p, p.tolist()], K, labels2d=[[1, 2], None], labels3d=p)
solve_many([x, x], p, sized, prior=(K, p[0]))
solve_many([[x, x], [x, x]], p, [pinhole, K], rig=[np.eye(4)] * 2, scores2d=[[np.ones(5), [0.5] * 5]] * 2)
verify(x, p, solution.rotation, solution.translation, solution.camera, matches=solution.matches)
verify(x, p, torch.eye(3), [0, 0, 5], matches=[(0, 1), (2, 3)])
verify(x, p, *cv2.solvePnP(p, x, K, np.zeros(5))[1:], K, np.zeros(5))
verify(x, p, (K, p[0]), camera=[800, 800, 320, 240])
verify(x, p, solution, camera=K)
verify(x, p, pycolmap.Rigid3d(), camera=pinhole)
Batch.from_arrays(x, p, focal=800.0)
Batch.from_arrays([x, torch.zeros(4, 2)], [p, p], [K, K], [p[0], [0, 0, 5]], [[0, -1], [1, 0]], focal=[800, 700])
SceneMap.from_colmap(pycolmap.Reconstruction())
scene.localize(x, K, scores=[1, 2, 3], views=["a.jpg"], up_camera=[0, -1, 0])
scene.localize([cv2.KeyPoint()], image_size=(640, 480), prior=np.eye(4))
scene.localize_photo("a.jpg", "unknown", views=["b.jpg"], time_limit=None)
scene.localize_photo(Path("a.jpg"), scene)
scene.localize_photo("a.jpg", scene.views[0].camera, focal_error=0.1)
solution.plot(camera=pinhole)
"""
WRONG = """
solve("a", p)
solve(x, 3)
solve([1, 2], p)
solve(x, p, camera="x")
solve(x, p, ("PINHOLE", 3))
solve(x, p, K, "x")
solve(x, p, prior=3)
solve(x, p, image_size=640)
solve(x, p, labels2d="abc")
solve(x, p, scores3d=0.5)
solve(x, p, rig=[3])
solve(x, p, time_limit="10")
solve(x, p, solver=3)
solve_many(3, p)
solve_many(["x"], p)
solve_many([x], p, "x")
solve_many([x], p, ["x", "y"])
solve_many([x], p, prior=3)
verify(x, p, 3, p[0])
verify(x, p, K, p[0], matches="a")
Batch.from_arrays("x", p)
Batch.from_arrays(x, 3)
SceneMap.from_colmap(3)
scene.localize("x", K)
scene.localize(x, "unknown")
scene.localize(x, K, up_camera=1)
scene.localize_photo(3)
scene.localize_photo("a.jpg", "x")
scene.localize_photo("a.jpg", view=["b.jpg"])
solution.plot(camera="x")
"""


def calls_with_errors(calls: str, folder: Path) -> list[str]:
    """Return the calls, one per line, that mypy rejects."""
    file = folder / "calls.py"
    file.write_text(HEAD + calls)
    config = folder / "mypy.ini"
    config.write_text(f"[mypy]\nmypy_path = {ROOT}\n\n[mypy-lazy_loader.*,pandas.*]\nignore_missing_imports = True\n")
    report, problem, _ = api.run(
        [f"--config-file={config}", f"--cache-dir={ROOT / '.mypy_cache' / 'calls'}", str(file)]
    )
    assert not problem
    rows = [int(row) for row in re.findall(r"^\S*calls\.py:(\d+): error", report, re.MULTILINE)]
    assert rows or "Success" in report, report
    lines = file.read_text().splitlines()
    return [lines[row - 1] for row in dict.fromkeys(rows)]


@pytest.mark.parametrize(("calls", "rejected"), [(RIGHT, []), (WRONG, WRONG.split("\n")[1:-1])], ids=["right", "wrong"])
def test_mypy_rejects_wrong_calls_and_accepts_right_ones(calls: str, rejected: list[str], tmp_path: Path) -> None:
    assert calls_with_errors(calls, tmp_path) == rejected
