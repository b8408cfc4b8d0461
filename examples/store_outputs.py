"""Run the notebooks of this folder and store their outputs in them.

    python examples/store_outputs.py [NOTEBOOK...]

It needs `nbclient` and `ipykernel`, which `make install` installs. A notebook whose metadata name a folder of photos
(`"bpnp": {"photos": "sacre_coeur"}`) runs only if the working directory has this folder; otherwise its stored outputs
stay. Cells with the tag `photo` are stored without their pictures, which would make the repository large.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import nbformat
from nbclient import NotebookClient

COMPILING = "compiling bpnp's loops"  # once an installation


def store_outputs(path: Path) -> bool:
    """Run a notebook from the first cell to the last, and write it with its outputs.

    Args:
        path: Notebook, which is overwritten.

    Returns:
        False if the notebook was not run, because its folder of photos is missing.
    """
    notebook = nbformat.read(path, as_version=4)
    own = notebook.metadata.get("bpnp", {})
    if "photos" in own and not Path(own["photos"]).is_dir():
        print(f"left out {path}: there is no folder {own['photos']}")
        return False
    NotebookClient(notebook, timeout=1200, record_timing=False).execute()
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if not output.get("text", "").startswith(COMPILING)]
        if "photo" in cell.metadata.get("tags", []):
            for output in cell.outputs:
                output.get("data", {}).pop("image/png", None)
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
        **({"bpnp": own} if own else {}),
    }
    path.write_text(nbformat.writes(notebook, indent=1) + "\n", encoding="utf-8")
    return True


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the given notebooks, all of them by default."""
    names = sys.argv[1:] if arguments is None else arguments
    for path in [Path(name) for name in names] or sorted(Path(__file__).parent.glob("*.ipynb")):
        if store_outputs(path):
            print(f"stored the outputs of {path}")


if __name__ == "__main__":
    main()
