"""Poses that are sought on purpose to contest a confident one: those that a repeated structure confuses with it, and
those beside it at other focal lengths."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bpnp.search.annealing import anneal_on_points, polished
from bpnp.search.candidates import Candidates, in_user_frame
from bpnp.search.evidence.alternatives import of_misfit
from bpnp.search.evidence.false_alarms import alarms_of
from bpnp.search.evidence.partners import Zoomed, with_focal_length
from bpnp.search.evidence.repetitions import decades_behind, repeated_poses
from bpnp.search.evidence.settings import Evidence
from bpnp.search.evidence.uncertainty import misfit_of
from bpnp.search.point_sets import PointSets, UnknownFocal
from bpnp.search.scene import Scene
from bpnp.search.sources.raster import search_beside
from bpnp.search.verdict import SearchResult, judged, match_count, with_false_alarms

Array = NDArray[np.float64]


def against_rivals(
    result: SearchResult,
    sets: PointSets,
    entered: Callable[[], Scene],
    rule: Evidence,
    *,
    looks: int = 0,
    exhaustive: bool = False,
) -> SearchResult:
    """A confident result once more, beside the poses that a repeated structure would confuse with it, and beside those
    at other focal lengths; if one of the former is better, so is that one.

    The camera is believed as it was given unless another focal length, which is paid for as an unknown, has fewer false
    alarms by the factor `rule.focal_chance`."""
    result = _against_repetitions(result, sets, entered, rule, looks, exhaustive)
    if result.verdict != "confident" or sets.focal is not None:
        return result
    count = match_count(result.candidates, sets)
    if count < rule.zoomed.fewest:
        return result
    rotation, translation = result.best
    middle = rotation @ sets.middle + translation
    most = result.log10_false_alarms + math.log10(rule.focal_chance)
    for other in _at_other_focal_lengths(result, sets, middle, entered, rule):
        if other is not None and _alarms(sets, other, rule) < most:
            better = of_misfit(misfit_of(rotation, middle, other), rule)
            if better is not None:
                chance = result.reason.split(", and no alternative")[0]
                return replace(result, verdict="ambiguous", reason=f"{chance}, but {better.what}")
    return result


def _at_other_focal_lengths(
    result: SearchResult, sets: PointSets, middle: Array, entered: Callable[[], Scene], rule: Evidence
) -> Iterator[Zoomed | None]:
    """Poses with the focal lengths that fit them best: of Gauss-Newton steps from the best pose itself, and from the
    likeliest of those that annealing reaches from it at other focal lengths.

    The latter only where three matches may be coincidences: else the steps meet what there is. Where they rather are
    than not, poses are looked for around it there. middle: (3,) of the scene, seen from the camera.
    """
    rotation, scale = result.best[0], max(result.residual, sets.image.scales[0])
    yield with_focal_length(sets, rotation, middle, scale)
    decades = -result.log10_false_alarms / match_count(result.candidates, sets)
    if -rule.independent * decades > rule.missed:
        scene = entered()
        vague = 10 ** (-rule.independent * decades) > 0.5
        zooms = [
            (zoom, *near_focal_length(sets, rotation, middle, zoom, scale, scene, looks=vague))
            for zoom in rule.zoomed.zooms
        ]
        zoom, there, poses = max(zooms, key=lambda one: _likelihood(*one[1:]))
        if not len(poses):  # after the deadline
            return
        seen = poses.rotation[0] @ sets.middle + poses.translation[0]
        fitted = with_focal_length(there, poses.rotation[0], seen, max(float(poses.scale[0]), there.image.scales[0]))
        yield None if fitted is None else fitted._replace(zoom=zoom * fitted.zoom)


def near_focal_length(
    sets: PointSets, rotation: Array, middle: Array, zoom: float, scale: float, scene: Scene, *, looks: bool = False
) -> tuple[PointSets, Candidates]:
    """The points at `zoom` times the focal length, and the pose that annealing reaches there from the one that sees the
    scene as large, by some of the bearings, or the likeliest of those that a look around that one meets; none after the
    deadline.

    middle: (3,) of the scene, seen from the camera. scale: of the residuals, radians. scene: whose settings and
    deadline hold.
    """
    zoomed, settings = at_focal_length(sets, zoom), scene.settings
    rule = settings.evidence.zoomed
    few = replace(settings, fine=replace(settings.fine, bearings=rule.bearings))
    there = Scene(zoomed, 0, settings if looks else few, scene.deadline)
    wide = max(scale, rule.width * abs(math.log(zoom)) * sets.image.spread)
    poses = rotation[None], (middle * (1, 1, zoom) - rotation @ sets.middle)[None]
    start = Candidates.unscored(*there.enter(*poses))
    ends = search_beside(there, start, settings.beside) if looks else anneal_on_points(there, start, 2 * wide)
    return zoomed, in_user_frame(ends[:1], there)


def _likelihood(sets: PointSets, poses: Candidates) -> float:
    """Of the bearings under the first pose, nats each, against an even density over the view; -inf without a pose."""
    return float(poses.score[0]) + math.log(sets.image.solid_angle) if len(poses) else -math.inf


def _alarms(sets: PointSets, other: Zoomed, rule: Evidence) -> float:
    """log10 of the false alarms of a pose whose focal length is a seventh unknown."""
    span = math.log(max(rule.zoomed.zooms) / min(rule.zoomed.zooms))
    zoomed = replace(at_focal_length(sets, other.zoom), focal=UnknownFocal(span))
    translation = other.middle - other.rotation @ sets.middle
    return float(alarms_of(zoomed, other.rotation[None], translation[None]).own[0])


def at_focal_length(sets: PointSets, zoom: float) -> PointSets:
    """The same image points, seen with `zoom` times the focal length."""
    bearings = sets.bearings * (1 / zoom, 1 / zoom, 1)
    return replace(sets, bearings=bearings / np.linalg.norm(bearings, axis=-1, keepdims=True))


def _against_repetitions(
    result: SearchResult,
    sets: PointSets,
    entered: Callable[[], Scene],
    rule: Evidence,
    looks: int,
    exhaustive: bool,
) -> SearchResult:
    if result.verdict != "confident":
        return result
    best, scale = result.best, max(result.residual, sets.image.scales[0])
    repeated, compared = repeated_poses(sets, *best, scale, rule)
    if not len(repeated[0]):
        return result
    rivals = with_false_alarms(polished(entered(), *repeated, scale), sets)
    behind = decades_behind(sets, best, repeated, (rivals.rotation, rivals.translation), scale, rule.repetitions)
    behind = np.maximum(behind, 0) if compared else np.zeros(len(rivals))
    alarms = np.minimum(rivals.log10_false_alarms, result.log10_false_alarms + behind)
    candidates = Candidates.concatenated([result.candidates, replace(rivals, log10_false_alarms=alarms)])
    beside = judged(candidates, sets, batches=result.batches, looks=looks, exhaustive=exhaustive, rule=rule)
    if np.array_equal(beside.best[1], best[1]):
        return beside
    return _against_repetitions(beside, sets, entered, rule, looks, exhaustive)
