"""Checkpoints of networks that had all options in one constructor, in the form of networks made of parts."""

from collections.abc import Mapping
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
# Where each option is now.
PLACES = {
    "BPnPNet": POSE
    | {
        "channels": "features2d.channels features3d.channels",
        "blocks": "features2d.depth features3d.depth",
        "batch_norm": "features2d.batch_norm features3d.batch_norm",
        "centre_features": "features2d.centre features3d.centre",
        "image_scale": "features2d.scale",
        "normalise_scene": "features3d.normalise",
        "mu": "transport.mu",
        "learn_mu": "transport.learn_mu",
        "dustbin": "transport.dustbin",
        "sinkhorn_tolerance": "transport.tolerance",
        "rounds": "rounds",
    },
    "Matcher": POSE
    | {name: name for name in ("channels", "heads", "neighbours", "mu")}
    | {"blocks": "depth", "sinkhorn_tolerance": "tolerance"},
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
    if not isinstance(solver, Mapping) or not isinstance(solver.get("settings"), Mapping):
        return content
    name, options = solver.get("class"), dict(solver["settings"])
    places = PLACES.get(str(name), {})
    options |= options.pop("pose", None) or {}  # in the Matcher these were together
    if all(places.get(option, option) == option for option in options):
        return content
    settings: dict[str, Any] = {}
    for option, value in options.items():
        if option not in places:
            raise ValueError(f"expected options of {name}, got {option!r}; try a checkpoint of `bpnp fit`")
        for place in places[option].split():
            part, _, own = place.rpartition(".")
            if part:
                settings.setdefault(part, {"class": CLASSES[part], "settings": {}})["settings"][own] = value
            else:
                settings[own] = value
    weights = content["state_dict"]
    for old, new in WEIGHTS.items():
        weights = {key.replace(old, new): value for key, value in weights.items()}
    return content | {"solver": {"class": name, "settings": settings}, "state_dict": weights}
