"""Aliasing: poses elsewhere in a map that explain the same image points, such as those of a similar building.

A confident pose is compared with three kinds of proposals: poses that were found with the points of other views; its
images under motions that map the scene onto itself (`bpnp.search.propose.repetitions`); and poses that short searches
near views of other points find for the image points that it explains. They are refined on all points of the map,
scored by how well they explain the image points, and the pose is judged against the best of them.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bpnp.arrays import Array, PoseArrays
from bpnp.maps.photo_problem import Photo
from bpnp.maps.viewed_points import Region
from bpnp.matching import count_one_to_one
from bpnp.poses import SAME, rotation_angle, same_pose
from bpnp.runtime import NEVER, Deadline, one_blas_thread
from bpnp.search.assemble import Solved, candidates_of
from bpnp.search.hypotheses import Hypotheses, to_problem_frame
from bpnp.search.kernels.density_map import DensityMap
from bpnp.search.problem import Problem
from bpnp.search.propose.density_map import LOCAL, search_around, search_near
from bpnp.search.propose.repetitions import repeated_poses, repetition_margins
from bpnp.search.refine.annealing import anneal_to_end, finish
from bpnp.search.search_frame import SearchFrame
from bpnp.search.settings import DEFAULT, DensitySearch, DensityShape, Draws, Narrowing, Preselection
from bpnp.search.solution import Candidate, Solution
from bpnp.search.starts import PosePrior
from bpnp.search.verdict.competitors import sign_margins
from bpnp.search.verdict.decide import add_false_alarms, rank_poses
from bpnp.search.verdict.limits import LEAST_MARGIN
from bpnp.search.verdict.reasons import Unfinished, objection

MOST_VIEWS = 8  # largest number of views [views; cost]
LEAST_OTHER = 0.5  # least fraction of a view's points that the pose does not see [fraction; not tuned]
FEWEST_OTHER_POINTS = 12  # least number of such points, and of image points that the pose explains [points; not tuned]
# Few of the explained image points are outliers for a competing pose. So fewer, more smoothed initial poses suffice
# than near a view that is tried.
IN_OTHER_VIEW = DensitySearch(  # search near each view [`DensitySearch`; calibration]
    Draws(2**13, least_starts=2**13),
    Preselection((50, 300), (2**11, 2**8)),
    Narrowing(0.1, 0.015, steps=6, points=300),
    annealed=6,
)


@dataclass(frozen=True, eq=False)
class Competitor:
    """The best competing pose elsewhere in a map."""

    margin: float  # decades by which it explains the image points worse than the pose; negative if better
    pose: Candidate


@one_blas_thread
def best_competitor(
    photo: Photo,
    region: Region,
    solution: Solution,
    earlier: Sequence[Candidate],
    regions: Iterable[Region],
    deadline: Deadline = NEVER,
) -> Competitor | None:
    """Return the pose elsewhere in a map with the smallest margin to a confident solution, or None if there is none.

    Proposals are `earlier` (significant poses of other views) and those found near `regions`, ranked for the explained
    image points; all are compared on the points of `region`, where the solution was found. After the deadline the rest
    is left out, and its `unfinished` names the competing poses.
    """
    problem = replace(photo, view_count=1).problem(region, solution.camera, photo.prior)
    proposals = propose_elsewhere(photo, problem, region, solution, earlier, regions, deadline)
    competing = refine_elsewhere(problem, solution, proposals, photo.seed, deadline)
    if not len(competing):
        return None
    margins = margins_elsewhere(problem, solution, competing)
    k = int(np.argmin(margins))
    return Competitor(float(margins[k]), _candidate(problem, solution, competing[k : k + 1], float(margins[k])))


def margins_elsewhere(problem: Problem, solution: Solution, competing: Hypotheses) -> Array:
    """Return the margins (c,), in decades, by which poses elsewhere explain the image points worse than a solution.

    A map lacks points, and other ones of each place. Where each pose explains image points that the other one does not,
    the difference has to be significant by a sign test (`sign_margins`). A prior adds the ratio of the fractions of
    poses that are as near to it.
    """
    best, scale = _pose_of(problem, solution), _scale_of(problem, solution)
    poses = competing.rotation, competing.translation
    margins = repetition_margins(problem, best, poses, poses, scale)
    leader = Hypotheses.from_poses(best[0][None], best[1][None], scale=np.array([scale]))
    candidates = add_false_alarms(Hypotheses.concatenate([leader, competing]), problem)
    signs = sign_margins([(candidates, problem)])[1:]
    margins = np.where(np.abs(signs) < np.abs(margins), signs, margins)
    fractions = [problem.log10_prior_fraction(*pose) for pose in zip(*poses, strict=True)]
    return margins + fractions - problem.log10_prior_fraction(*best)


def propose_elsewhere(
    photo: Photo,
    problem: Problem,
    region: Region,
    solution: Solution,
    earlier: Sequence[Candidate],
    regions: Iterable[Region],
    deadline: Deadline,
) -> list[PoseArrays]:
    """Return unrefined poses elsewhere in the map that may explain the image points of a solution.

    `problem` has the points of `region`. Of the `regions`, ranked for the explained image points, the first ones with
    other points are searched until the deadline.
    """
    scale = _scale_of(problem, solution)
    best = _pose_of(problem, solution)
    repeated = repeated_poses(problem, *best, scale, deadline=deadline).poses
    return [
        *(_pose_of(problem, one) for one in earlier),
        *zip(repeated.rotation, repeated.translation, strict=True),
        *_find_poses_in(_other_regions(regions, region, problem, solution), photo, problem, solution, deadline),
    ]


def refine_elsewhere(
    problem: Problem, solution: Solution, proposals: Sequence[PoseArrays], seed: int, deadline: Deadline
) -> Hypotheses:
    """Return the proposals that differ from a solution before and after their refinement, refined."""
    best = _pose_of(problem, solution)
    centroid = np.median(problem.points_from_user(solution.points3d[solution.matches[:, 1]]), 0)

    def differ(rotations: Array, translations: Array) -> NDArray[np.bool_]:
        return ~same_pose(best, rotations, translations, centroid, SAME)

    rotations = np.array([rotation for rotation, _ in proposals]).reshape(-1, 3, 3)
    translations = np.array([translation for _, translation in proposals]).reshape(-1, 3)
    other = differ(rotations, translations)
    if not other.any():
        return Hypotheses.from_poses(rotations[other], translations[other])
    scene = SearchFrame(problem, seed, DEFAULT, deadline)
    refined = anneal_to_end(scene, rotations[other], translations[other], _scale_of(problem, solution))
    deadline.passed(Unfinished.competing_poses)  # noted: then not all of them were refined
    return refined[differ(refined.rotation, refined.translation)]


def judge_against(own: Solved, competitor: Competitor | None) -> Solved:
    """Return a solution, against a competing pose elsewhere that is within the margin.

    It then has both poses as its first candidates.
    """
    least_margin, solution = LEAST_MARGIN, own.solution
    if competitor is None or competitor.margin >= least_margin:
        return own
    other, margin = competitor.pose, competitor.margin
    values = {
        "distance": float(np.linalg.norm(other.centre - solution.centre)),
        "degrees": math.degrees(rotation_angle(solution.rotation, other.rotation)),
        "better": -margin,
    }
    code = "better_place" if margin <= -least_margin else "competing_place"
    case, doubtful = own.against(objection(code, margin, **values))
    return Solved(case, replace(doubtful, candidates=(solution.candidates[0], other, *solution.candidates[1:])))


def significant(solution: Solution) -> list[Candidate]:
    """Return the candidates of a solution that fit better than chance (log10 NFA below 0)."""
    return [one for one in solution.candidates if one.log10_false_alarms < 0]


def explained_keypoints(photo: Photo, solution: Solution) -> Array:
    """Return the keypoints (k, 2), pixels, that a solution explains."""
    return photo.keypoints[np.sort(solution.matches[:, 0])]


def _pose_of(problem: Problem, pose: Solution | Candidate) -> PoseArrays:
    return problem.from_user(pose.rotation, pose.translation)


def _scale_of(problem: Problem, solution: Solution) -> float:
    return max(solution.stats.residual, float(problem.image.scales[0]))


def _candidate(problem: Problem, solution: Solution, pose: Hypotheses, margin: float) -> Candidate:
    """Return a competing pose (1,) as a candidate in the user's frame."""
    seen = problem.project_scene(*pose.pose())
    inliers = count_one_to_one(problem.measured.points, seen, solution.inlier_threshold)
    rotation, translation = problem.to_user(pose.rotation, pose.translation)
    alarms = np.array([solution.log10_false_alarms + margin])
    return candidates_of(
        replace(pose, rotation=rotation, translation=translation, log10_false_alarms=alarms), [inliers]
    )[0]


def _other_regions(regions: Iterable[Region], own: Region, problem: Problem, solution: Solution) -> Iterator[Region]:
    """Yield the first regions with mostly points that are not visible from the pose of a solution."""
    if len(solution.matches) < FEWEST_OTHER_POINTS:
        return
    assert problem.measured.camera is not None
    pose = solution.rotation, solution.translation
    seen, count = own.point_ids[own.in_view(*pose, problem.measured.camera, problem.measured.points)], 0
    for region in regions:
        other = ~np.isin(region.point_ids, seen)
        if other.sum() >= FEWEST_OTHER_POINTS and other.mean() >= LEAST_OTHER:
            yield region
            count += 1
        if count == MOST_VIEWS:
            return


def _find_poses_in(
    regions: Iterable[Region], photo: Photo, problem: Problem, solution: Solution, deadline: Deadline
) -> Iterator[PoseArrays]:
    """Yield the poses that short searches in other regions find for the explained image points of a solution."""
    explained = replace(photo, keypoints=explained_keypoints(photo, solution), view_count=1)
    density_maps: dict[tuple[DensityShape, float], DensityMap] = {}  # shared, since the image points are the same
    for region in regions:
        if deadline.passed(Unfinished.competing_poses):
            return
        near = explained.problem(region, solution.camera, region.prior())
        scene = SearchFrame(near, photo.seed, DEFAULT, deadline)
        scene.density_maps = density_maps
        assert near.prior is not None
        prior = scene.enter_prior(near.prior)
        assert isinstance(prior, PosePrior)
        found = _likeliest(finish(scene, search_near(scene, prior, IN_OTHER_VIEW)), scene, near)
        if len(found) and found.log10_false_alarms[0] < 0:
            start = Hypotheses.from_poses(*scene.enter(found.rotation, found.translation))
            local = _likeliest(finish(scene, search_around(scene, start, LOCAL)), scene, near)
            for one in (found, local):
                yield problem.from_user(*near.to_user(*one.pose()))


def _likeliest(poses: Hypotheses, scene: SearchFrame, problem: Problem) -> Hypotheses:
    """Return the pose (1,) with the fewest false alarms, in the frame of the problem."""
    return rank_poses(to_problem_frame(poses, scene), problem)[:1]
