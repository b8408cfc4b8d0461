"""Checkpoints of networks that had all options in one constructor, in the form of networks made of parts."""

from collections.abc import Iterator, Mapping
from typing import Any

POSE = {
    "ransac_backend": "ransac.backend",
    "ransac_iterations": "ransac.max_iterations",
    "threshold": "ransac.threshold",
    "pairs_factor": "ransac.pairs_factor",
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
    "rounds": "rounds",
}
BOTH_SIDES = {"channels": "channels", "blocks": "depth", "batch_norm": "batch_norm", "centre_features": "centre"}
MATCHER = {name: name for name in ("channels", "heads", "neighbours", "mu")} | {
    "blocks": "depth",
    "sinkhorn_tolerance": "tolerance",
}
CLASSES = {
    "features2d": "ImageFeatures",
    "features3d": "SceneFeatures",
    "transport": "Sinkhorn",
    "ransac": "RansacPnP",
    "pnp": "WeightedPnP",
    "refinement": "Refinement",
}
WEIGHTS = {"solver.align.": "solver.features3d.align.", "solver.sinkhorn.": "solver.transport."}


def brought_up_to_date(content: dict[str, Any]) -> dict[str, Any]:
    """The content of a checkpoint, with the solver's settings and the names of its weights as they are now.

    An option that the older constructor did not have yet has its default. The order of the parameters, which an
    optimiser's state depends on, is the same. Raises ValueError for an option that there never was.
    """
    solver = content.get("solver")
    if not isinstance(solver, Mapping) or not isinstance(solver.get("settings"), Mapping) or not _is_older(solver):
        return content
    settings: dict[str, Any] = {}
    for place, value in _places(solver["class"], solver["settings"]):
        part, _, option = place.rpartition(".")
        inside = settings.setdefault(part, {"class": CLASSES[part], "settings": {}})["settings"] if part else settings
        inside[option] = value
    weights = {_renamed(key): value for key, value in content["state_dict"].items()}
    return content | {"solver": {"class": solver["class"], "settings": settings}, "state_dict": weights}


def _is_older(solver: Mapping[str, Any]) -> bool:
    """All options of BPnPNet are now in its parts, but for the rounds; Matcher had `pose`."""
    settings = solver["settings"].keys()
    return solver.get("class") == "BPnPNet" and bool(settings & (BPNPNET.keys() | BOTH_SIDES) - {"rounds"}) or (
        solver.get("class") == "Matcher" and bool(settings & {"blocks", "pose", "sinkhorn_tolerance"})
    )  # fmt: skip


def _places(name: str, settings: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Where each option is now, and its value."""
    known = BPNPNET if name == "BPnPNet" else MATCHER
    for option, value in settings.items():
        if option in known:
            yield known[option], value
        elif name == "BPnPNet" and option in BOTH_SIDES:
            yield f"features2d.{BOTH_SIDES[option]}", value
            yield f"features3d.{BOTH_SIDES[option]}", value
        elif name == "Matcher" and option == "pose":
            yield from ((POSE[inner], each) for inner, each in (value or {}).items())
        else:
            raise ValueError(f"expected options of {name}, got {option!r}; try a checkpoint of `bpnp fit`")


def _renamed(key: str) -> str:
    for old, new in WEIGHTS.items():
        if key.startswith(old):
            return new + key.removeprefix(old)
    return key
