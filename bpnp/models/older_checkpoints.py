"""Conversion of checkpoints of earlier versions.

In version 0.1 the network's constructor had all options; now its parts have them. Some options have been renamed or
removed since.
"""

from collections.abc import Iterator, Mapping
from typing import Any

POSE = {
    "ransac_backend": "ransac.backend",
    "ransac_iterations": "ransac.max_iterations",
    "threshold": "ransac.threshold",
    "pairs_factor": "ransac.matches_factor",
    "pnp_method": "pnp.method",
    "pnp_iterations": "pnp.max_iterations",
    "refine": "refinement.enabled",
    "hypotheses": "refinement.hypotheses",
}
BPNPNET = POSE | {
    "image_scale": "features2d.scale",
    "normalise_scene": "features3d.normalise",
    "mu": "transport.mu",
    "learn_mu": "transport.learn_mu",
    "dustbin": "transport.dustbin",
    "sinkhorn_tolerance": "transport.tolerance",
}
BOTH_SIDES = {"channels": "channels", "blocks": "depth", "batch_norm": "batch_norm", "centre_features": "centre"}
MATCHER = {"blocks": "depth", "sinkhorn_tolerance": "tolerance"}
CLASSES = {
    "features2d": "ImageFeatures",
    "features3d": "SceneFeatures",
    "transport": "Sinkhorn",
    "ransac": "RansacPnP",
    "pnp": "WeightedPnP",
    "refinement": "Refinement",
}
WEIGHTS = {"solver.align.": "solver.features3d.align.", "solver.sinkhorn.": "solver.transport."}
RENAMED = {"pairs_factor": "matches_factor"}  # settings of parts
# Removed settings of parts, with the only value that was in use.
REMOVED = {"batch_norm": False, "principal": False, "method": "newton"}


def upgrade(content: dict[str, Any]) -> dict[str, Any]:
    """Convert the content of a checkpoint to this version.

    An option that the older network did not have gets its default when the network is built. The order of the
    parameters, which the state of an optimiser depends on, is unchanged.

    Args:
        content: Content of a checkpoint of any version. That of another program is returned unchanged.

    Returns:
        The content with current settings under "solver" and current names under "state_dict".
    """
    solver = content.get("solver")
    if not isinstance(solver, Mapping) or not isinstance(solver.get("settings"), Mapping):
        return content
    if not _has_one_constructor(solver):
        return content | {"solver": _upgrade_part(solver)}
    settings: dict[str, Any] = {}
    for place, value in _places(solver["class"], solver["settings"]):
        part, _, option = place.rpartition(".")
        inside = settings.setdefault(part, {"class": CLASSES[part], "settings": {}})["settings"] if part else settings
        inside[option] = value
    weights = {_rename_weight(key): value for key, value in content["state_dict"].items()}
    upgraded = _upgrade_part({"class": solver["class"], "settings": settings})
    return content | {"solver": upgraded, "state_dict": weights}


def _has_one_constructor(solver: Mapping[str, Any]) -> bool:
    """Return True for a description of version 0.1, in which the network has the settings of its parts."""
    names = solver["settings"].keys()
    return "blocks" in names and solver.get("class") in ("BPnPNet", "Matcher")


def _places(name: str, settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the current path and the value of each option of version 0.1.

    An option that never existed is left for the constructor to reject.
    """
    for option, value in settings.items():
        if name == "BPnPNet" and option in BOTH_SIDES:
            yield f"features2d.{BOTH_SIDES[option]}", value
            yield f"features3d.{BOTH_SIDES[option]}", value
        elif name == "Matcher" and option == "pose":
            yield from ((POSE.get(inner, inner), each) for inner, each in (value or {}).items())
        else:
            yield (BPNPNET if name == "BPnPNet" else MATCHER).get(option, option), value


def _upgrade_part(value: Any) -> Any:
    """Rename the settings of a description, and remove those that no longer exist."""
    if not isinstance(value, Mapping) or not isinstance(value.get("settings"), Mapping):
        return value
    settings = {
        RENAMED.get(key, key): _upgrade_part(each)
        for key, each in value["settings"].items()
        if key not in REMOVED or each != REMOVED[key]
    }
    return {**value, "settings": settings}


def _rename_weight(key: str) -> str:
    for old, new in WEIGHTS.items():
        if key.startswith(old):
            return new + key.removeprefix(old)
    return key
