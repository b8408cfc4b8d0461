"""The pose of a photo from all points of the map that its camera sees, not from those of one view alone."""

from dataclasses import replace

import numpy as np

from bpnp.loops.parallel import one_blas_thread
from bpnp.maps.localize import Photo, counted, in_picture, problem_near, with_ids
from bpnp.maps.views import Cones
from bpnp.search.annealing import finish, polished
from bpnp.search.candidates import Candidates, in_user_frame
from bpnp.search.evidence.alternatives import Alternative, fits_as_well
from bpnp.search.evidence.rivals import against_rivals, doubted, other_camera
from bpnp.search.raster_search import search_beside
from bpnp.search.scene import Scene
from bpnp.search.settings import DEFAULT
from bpnp.search.verdict import judged
from bpnp.solving.matches import finished
from bpnp.solving.solution import Solution


@one_blas_thread
def on_all_points(solution: Solution, photo: Photo, tries: int) -> Solution:
    """A confident solution after so many views, fitted to all points of a photo's place that its camera sees, and
    judged by them; as it was but for a doubt where they explain the keypoints no better."""
    place, seen = photo.place, in_picture(photo.problem, solution)
    cones = Cones(place.cones.axes[seen], place.cones.cosines[seen])
    region = replace(place, points3d=place.points3d[seen], point_ids=place.point_ids[seen], cones=cones)
    if len(region.points3d) < len(solution.matches):
        return solution
    problem = problem_near(region, photo.keypoints, photo.camera, None)
    scene = Scene(problem.sets, photo.seed, DEFAULT)
    rotation, shift = solution.rotation, solution.translation + solution.rotation @ problem.origin
    scale = max(solution.stats.residual, problem.sets.image.scales[0])
    ends = polished(scene, rotation[None], shift[None], scale)
    if ends.scale[0] > solution.stats.residual:  # a coarse optimum: a finer one may be beside it
        start = Candidates.unscored(*scene.enter(rotation[None], shift[None]))
        beside = finish(scene, search_beside(scene, start, DEFAULT.beside), DEFAULT.finished)
        ends = Candidates.concatenated([ends, in_user_frame(beside, scene)])
    # That no better pose was missed is known of the one that is refined.
    rule = DEFAULT.evidence
    alone = judged(ends, problem.sets, batches=1, exhaustive=True)
    result = against_rivals(alone, problem.sets, lambda: scene, rule, exhaustive=True)
    rotations, shifts = np.stack([rotation, result.best[0]]), np.stack([shift, result.best[1]])
    if not problem.sets.same_pose(rotations, shifts, rule.other_deg, rule.other_shift)[1]:
        behind = result.log10_false_alarms - solution.log10_false_alarms
        return solution if behind >= rule.lead else _doubted(solution, fits_as_well(rotation, result.best[0], behind))
    if result.log10_false_alarms < solution.log10_false_alarms:
        fitted = finished(problem, result, solution.seconds, None)
        stats = replace(fitted.stats, iterations=solution.stats.iterations)
        candidates = (*fitted.candidates, *solution.candidates[1:])
        return counted(with_ids(replace(fitted, stats=stats, candidates=candidates), region), tries)
    if alone.verdict != "confident":  # which other cameras have not been asked of
        other = other_camera(alone, problem.sets, lambda: scene, rule)
        return solution if other is None else _doubted(solution, other)
    confident = result.verdict == "confident"
    return solution if confident else replace(solution, verdict=result.verdict, reason=result.reason)


def _doubted(solution: Solution, other: Alternative) -> Solution:
    return replace(solution, verdict="ambiguous", reason=doubted(solution.reason, other))
