"""`bpnp verify` on planted problems: a pose from a file or from numbers; a mistake is one line."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planted import plant

import bpnp
from bpnp import Solution
from bpnp.cli import main

PLANTED = plant(1, 30, seed=9)
X, P = PLANTED.points2d[0].numpy(), PLANTED.points3d[0].numpy()
R, T = PLANTED.rotation[0].numpy(), PLANTED.translation[0].numpy()
NUMBERS = ["--rotation", *map(str, R.ravel()), "--translation", *map(str, T + 0.01)]


@pytest.fixture
def files(tmp_path: Path) -> list[str]:
    np.savetxt(tmp_path / "x.csv", 800 * X + [320, 240], delimiter=",")
    np.save(tmp_path / "p.npy", P)
    (tmp_path / "pose.json").write_text(json.dumps({"rotation": R.tolist(), "translation": T.tolist()}))
    pairs = np.stack([PLANTED.match3d[0].numpy(), np.arange(30)], -1)
    np.savetxt(tmp_path / "pairs.csv", pairs, delimiter=",", fmt="%d")
    return [str(tmp_path / "x.csv"), str(tmp_path / "p.npy"), "--camera", "SIMPLE_PINHOLE,800,320,240"]


def test_a_pose_from_a_file_is_confirmed(files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "out" / "checked.json"
    main(["verify", files[0], files[1], str(tmp_path / "pose.json"), *files[2:], "--output", str(output)])
    assert "confident" in capsys.readouterr().out
    np.testing.assert_allclose(Solution.from_json(output).rotation, R, atol=1e-6)
    main(["verify", files[0], files[1], str(output), *files[2:], "--json"])  # that of a solution
    assert json.loads(capsys.readouterr().out)["verdict"] == "confident"


def test_a_pose_in_numbers_with_matches_is_judged(
    files: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["verify", *files, *NUMBERS, "--matches", str(tmp_path / "pairs.csv"), "--json", "--seed", "3"])
    content = json.loads(capsys.readouterr().out)
    assert content["verdict"] == "confident"
    assert len(content["matches"]) == 30
    main(["verify", *files, *NUMBERS, "--as_it_is", "--json", "--inlier_threshold", "50", "--time_limit", "100"])
    content = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(content["translation"], T + 0.01, atol=1e-12)
    assert content["inlier_threshold"] == 50


def test_options_reach_the_verdict_as_they_are_written(files: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Pass all options to `verify`; their effects are tested in tests/search/test_verify.py."""
    asked, solution = list[dict[str, Any]](), bpnp.solve(X, P)

    def noted(*arguments: Any, **options: Any) -> Solution:
        asked.append(options)
        return solution

    monkeypatch.setattr("bpnp.search.verify.verify", noted)
    main(["verify", *files, *NUMBERS, "--seed", "3", "--time_limit", "7", "--as_it_is"])
    assert [asked[0][name] for name in ("seed", "time_limit", "refine")] == [3, 7, False]


def bent(folder: Path) -> Path:
    """Write the JSON of a pose whose rotation is none."""
    pose = {"rotation": (2 * np.eye(3)).tolist(), "translation": T.tolist()}
    (folder / "bent.json").write_text(json.dumps(pose))
    return folder / "bent.json"


def test_the_exit_status_is_the_verdict_with_strict(files: list[str]) -> None:
    far = [*NUMBERS[:-1], f"{T[2] + 30}"]
    main(["verify", *files, *NUMBERS, "--strict", "--quiet"])
    main(["verify", *files, *far, "--quiet"])
    with pytest.raises(SystemExit) as stop:
        main(["verify", *files, *far, "--strict", "--quiet"])
    assert stop.value.code == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda files, folder: files, "give the JSON of a pose, or --rotation and --translation"),
        (lambda files, folder: [*files, *NUMBERS[:10]], "give the JSON of a pose, or --rotation and --translation"),
        (lambda files, folder: [*files[:2], "nothing.json", *files[2:]], "there is no file nothing.json"),
        (lambda files, folder: [*files, *NUMBERS[:9], "7", *NUMBERS[10:]], "--rotation is no rotation matrix"),
        (
            lambda files, folder: [*files[:2], str(bent(folder)), *files[2:]],
            "error: the rotation of the pose is no rotation matrix",
        ),
        (lambda files, folder: [*files, *NUMBERS, "--matches", str(folder / "p.npy")], " needs two columns; it has"),
        (lambda files, folder: [*files, *NUMBERS, "--image", "a"], "--image needs a COLMAP model"),
        (lambda files, folder: [*files, *NUMBERS, "--surface", "9"], "--surface draws points from a mesh, and"),
    ],
)
def test_a_mistake_is_one_line(
    change: Any, message: str, files: list[str], tmp_path: Path, fails: Callable[..., str]
) -> None:
    assert message in fails("verify", *change(files, tmp_path))
