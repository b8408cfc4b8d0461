"""The packaged configurations: `bpnp fit --config quickstart` finds `quickstart.yaml` here, from any folder."""

from pathlib import Path

FOLDER = Path(__file__).parent


def packaged_config(name: str) -> str:
    """The file of a configuration: a path that is a file as it is, or of a name such as `quickstart` the packaged one.

    >>> from pathlib import Path
    >>> Path(packaged_config("quickstart")).name
    'quickstart.yaml'
    """
    inside = name.removeprefix("configs/").removeprefix("bpnp/configs/").removesuffix(".yaml")
    path = FOLDER / f"{inside}.yaml"
    return str(path) if path.is_file() and not Path(name).is_file() else name


def config_names() -> list[str]:
    """The names that `packaged_config` takes."""
    return sorted(str(path.relative_to(FOLDER).with_suffix("")) for path in FOLDER.rglob("*.yaml"))
