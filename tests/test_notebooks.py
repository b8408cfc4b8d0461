"""The notebooks in examples/ run from the first cell to the last; what they assert holds."""

import ast
import importlib
import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nbformat
import pytest

pytestmark = pytest.mark.nightly

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


def test_the_table_of_the_training_begins_with_the_network_before_the_switch() -> None:
    """For each estimate; RANSAC and the PnP layer have smaller errors of the translation after it."""
    cells = json.loads((NOTEBOOKS[0].parent / "train.ipynb").read_text(encoding="utf-8"))["cells"]
    text = "".join(cells[-1]["outputs"][0]["data"]["text/plain"])
    rows = [line.rsplit(maxsplit=2) for line in text.splitlines()[1:]]
    names = [label.removeprefix(label.split("$")[0]) for label, *_ in rows]
    assert names == ["$L_c$", "$L_c + L_p$"] * 3
    for before, after in zip(rows[:4:2], rows[1:4:2], strict=True):
        assert float(after[2]) < float(before[2])


@pytest.fixture
def own_logging() -> Iterator[None]:
    """Restore the level of Lightning's messages, which a notebook raises for itself."""
    messages = logging.getLogger("lightning.pytorch")
    level = messages.level
    yield
    messages.setLevel(level)


@pytest.mark.usefixtures("own_logging")
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(
    notebook: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    monkeypatch.chdir(tmp_path)
    content = json.loads(notebook.read_text(encoding="utf-8"))
    if photos := content["metadata"].get("bpnp", {}).get("photos"):
        (tmp_path / photos).symlink_to(request.getfixturevalue("shared_data") / "photos" / photos)
    cells = content["cells"]
    codes = ["".join(cell["source"]).replace(*SHORTER) for cell in cells if cell["cell_type"] == "code"]
    assert codes[0].startswith("%matplotlib inline\n"), "without it a figure is shown as its name"
    codes[0] = codes[0].partition("\n")[2]
    names: dict[str, Any] = {"__name__": "notebook"}
    for code in codes:
        exec(compile(ast.parse(code, notebook.name), notebook.name, "exec"), names)
    assert any("assert " in code for code in codes)


@pytest.mark.parametrize("has_photos", [False, True])
def test_a_notebook_runs_only_with_its_photos(
    has_photos: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without its folder of photos a notebook is unchanged; with it the notebook has outputs and its metadata."""
    monkeypatch.syspath_prepend(NOTEBOOKS[0].parent)
    monkeypatch.chdir(tmp_path)
    own = {"bpnp": {"photos": "some_photos"}}
    cell = nbformat.v4.new_code_cell("from pathlib import Path\nprint(Path('some_photos').is_dir())")
    nbformat.write(nbformat.v4.new_notebook(cells=[cell], metadata=own), "some.ipynb")
    before = Path("some.ipynb").read_bytes()
    if has_photos:
        Path("some_photos").mkdir()
    importlib.import_module("store_outputs").main(["some.ipynb"])
    stored = nbformat.read("some.ipynb", as_version=4)
    assert (Path("some.ipynb").read_bytes() == before) is not has_photos
    assert stored.metadata["bpnp"] == own["bpnp"]
    if has_photos:
        assert [output.text for output in stored.cells[0].outputs] == ["True\n"]
        assert "stored the outputs of some.ipynb" in capsys.readouterr().out
    else:
        assert "left out some.ipynb: there is no folder some_photos" in capsys.readouterr().out
