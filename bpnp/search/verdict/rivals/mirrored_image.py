"""A mirrored image, such as a selfie or a scanned slide: an object that is nearly its own mirror image fits it too.

A reflection that maps matched scene points onto others turns the best pose into one of the mirrored image.
"""

import numpy as np

from bpnp.runtime import NEVER, Deadline
from bpnp.search.propose.mirror import MIRROR, mirrored_scene
from bpnp.search.propose.repetitions import reflections
from bpnp.search.refine.annealing import anneal_to_end
from bpnp.search.search_frame import SearchFrame
from bpnp.search.settings import DEFAULT
from bpnp.search.verdict.decide import Case, add_false_alarms
from bpnp.search.verdict.reasons import Unfinished, objection
from bpnp.search.verdict.rivals import left_by

FEWEST_LEFT = 1  # number of image points and of scene points that the best pose leaves [points; derived]
# Decades by which the mirrored image has to fit better; that of a flat or mirror-symmetric scene fits as well.
BETTER = 0.3  # [decades; calibration]


def mirrored_image(case: Case, *, deadline: Deadline = NEVER) -> Case:
    """Return a case against which a better pose of the mirrored image speaks."""
    problem = case.problem
    if problem.cosines3d is not None or min(left_by(case)) < FEWEST_LEFT:
        return case
    motions = reflections(problem, *case.pose, max(case.residual, float(problem.image.scales[0])))
    if not len(motions.fraction):
        return case
    if deadline.ended(Unfinished.competing_poses):
        return case.against(objection("untested"))
    rotations, translations = motions.competitors(*case.pose)
    mirrored = mirrored_scene(problem)
    scene = SearchFrame(mirrored, 0, DEFAULT, deadline)
    poses = add_false_alarms(anneal_to_end(scene, rotations * MIRROR, translations, case.residual), mirrored)
    better = case.log10_false_alarms - float(np.min(poses.log10_false_alarms))
    return case if better < BETTER else case.against(objection("mirrored_image", -better, better=better))
