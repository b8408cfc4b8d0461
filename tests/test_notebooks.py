"""The notebooks in examples/ run from the first cell to the last; what they assert holds."""

import ast
import json
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow

SHORTER = ("train_problems=400", "train_problems=80")  # of the training
NOTEBOOKS = sorted((Path(__file__).parents[1] / "examples").glob("*.ipynb"))


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_stored_with_its_outputs(notebook: Path) -> None:
    """With what the last line of each cell shows, without warnings, paths of a machine, or photos."""
    cells = [cell for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert all(output["output_type"] in ("stream", "execute_result") for output in outputs)
    assert not [output for output in outputs if output.get("name") == "stderr"]
    assert "/tmp/" not in json.dumps(outputs)
    for cell in cells:
        source, text = "".join(cell["source"]), json.dumps(cell["outputs"])
        assert cell["execution_count"], source
        assert cell["outputs"] or "print(" not in source, source
        if "photo=" in source or "read_photo(" in source:
            assert "image/png" not in text


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(
    notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    monkeypatch.chdir(tmp_path)
    if notebook.stem == "hloc":
        photos = request.getfixturevalue("shared_data") / "photos" / "sacre_coeur"
        (tmp_path / "sacre_coeur").symlink_to(photos)
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    codes = ["".join(cell["source"]).replace(*SHORTER) for cell in cells if cell["cell_type"] == "code"]
    assert codes[0].startswith("%matplotlib inline\n"), "without it a figure is shown as its name"
    codes[0] = codes[0].partition("\n")[2]
    names: dict[str, Any] = {"__name__": "notebook"}
    for code in codes:
        exec(compile(ast.parse(code, notebook.name), notebook.name, "exec"), names)
    assert any("assert " in code for code in codes)
