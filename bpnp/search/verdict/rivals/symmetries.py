"""Poses that the motions of the scene confuse with the best one, such as those of a facade shifted by a window."""

from dataclasses import replace

import numpy as np

from bpnp.runtime import NEVER, Deadline
from bpnp.search.hypotheses import Hypotheses
from bpnp.search.propose.repetitions import MOST_MISSING, SYMMETRIC, repeated_poses, repetition_margins
from bpnp.search.refine.annealing import anneal_to_end
from bpnp.search.verdict.decide import Case, add_false_alarms
from bpnp.search.verdict.false_alarms import likeliest_scale
from bpnp.search.verdict.limits import LEAST_MARGIN
from bpnp.search.verdict.reasons import Unfinished, objection
from bpnp.search.verdict.rivals import SceneOf

# Fraction of the matched points that a motion which was not compared has to map to hide a better pose. A motion maps at
# least 0.9 of the matches of a wrong pose onto those of the correct one.
HIDING = 0.8  # [fraction; calibration]


def symmetries(case: Case, *, scene_of: SceneOf, deadline: Deadline = NEVER, enumerated: bool = False) -> Case:
    """Return a case with the competing poses of a repeated structure.

    If the deadline passes before all of them are refined, this is the objection. The leader has no objection. The scene
    is made only if a refinement needs it, and nothing is tested after the end of the deadline. Poses of an enumeration
    are among the candidates already.
    """
    if deadline.ended(Unfinished.competing_poses):
        return case.against(objection("untested"))
    rivals = _repeated(case, scene_of, deadline, enumerated=enumerated)
    if not len(rivals):
        late = Unfinished.competing_poses in deadline.unfinished
        return case.against(objection("untested")) if late else case
    contested = case.among(rivals)
    late = not enumerated and deadline.passed(Unfinished.competing_poses)  # then not all of them were refined
    return contested.against(objection("untested")) if late else contested


def _repeated(case: Case, scene_of: SceneOf, deadline: Deadline, *, enumerated: bool) -> Hypotheses:
    """Return the competing poses of a repeated structure, refined, with their NFA; none if nothing depends on them.

    Their NFA is at most that of the leader times the factor by which they explain the image points worse
    (`repetition_margins`). Poses that were enumerated are refined already, but for those that a prior excluded. They
    are scored again under the assumption that the map may end anywhere, which makes them likelier.
    """
    problem = case.problem
    if enumerated and not case.symmetry.is_symmetric(case.candidates):
        return Hypotheses.empty()
    best = case.pose
    # The scale at which the annealing ended may be coarser than that of the residuals.
    scale = case.residual if enumerated else min(case.residual, likeliest_scale(problem, *best))
    scale = max(scale, problem.image.scales[0])
    least = SYMMETRIC if enumerated else 0.0
    repeated, sizes, motions = repeated_poses(problem, *best, scale, least=least, deadline=deadline)
    if not len(repeated) or deadline.ended(Unfinished.competing_poses):
        return repeated[:0]
    poses, rigid = (repeated.rotation, repeated.translation), sizes == 1
    most_missing = 1e-12 if enumerated else MOST_MISSING
    if enumerated and problem.prior is None:
        refined = repeated
    else:
        refined = add_false_alarms(anneal_to_end(scene_of(), *poses, scale), problem)
    others, fraction = (refined.rotation, refined.translation), float(motions.fraction.min(initial=1.0))
    shifted = poses[0][rigid], poses[1][rigid]
    behind = repetition_margins(problem, best, shifted, others, scale, most_missing, fraction=fraction)
    # If the pose is wrong, a motion maps nearly all of its matches; of a lattice it may not be among these.
    behind = np.maximum(behind, 0) if motions.left_out < HIDING else np.zeros(len(refined))
    fractions = np.array([problem.log10_prior_fraction(*pose) for pose in zip(*others, strict=True)])
    behind = behind + fractions - problem.log10_prior_fraction(*best)
    if enumerated and (behind >= LEAST_MARGIN).all():
        return Hypotheses.empty()
    alarms = np.minimum(refined.log10_false_alarms, case.log10_false_alarms + behind)
    return replace(refined, log10_false_alarms=alarms)
