"""Reasons of a verdict: their codes (`Solution.reason_code`) and sentences (`Solution.reason`), all in one table."""

import math
from typing import NamedTuple

from bpnp import matching

SHOWN_DECADES = 0.05  # logarithm of a number of false alarms below which 0.0 is shown [decades; convention]

MIRRORED = "the mirror image of the scene has a significant pose: check the directions of its axes"
TRUSTED_CAMERA = "the scene is flat, so a wrong focal length would not show"
CONFIDENT = "confident"  # code of a pose without an objection
FAILURES = {"no_pose", "degenerate", "chance"}  # codes of a problem without a pose, or with one that is not significant
UNTESTED = {"untested", "camera_untested"}  # codes of poses for whose competitors there was no time
CLAUSES = {
    # There is no pose, or it is not significant.
    "no_pose": "no pose was found",
    "degenerate": "{why}",
    "chance": "{what} better than chance",
    "insignificant": "not significant: {alarms}, and at most {most:g} is needed",
    # Another pose may be the right one.
    "competing_pose": "a competing pose {away} away fits about as well (margin {margin:.1f} decades)",
    "competing_place": "a pose {distance:.3g} scene units and {degrees:.0f} deg away, elsewhere in the map, explains "
    "the image points about as well (margin {margin:.1f} decades)",
    "better_place": "a pose {distance:.3g} scene units and {degrees:.0f} deg away, elsewhere in the map, explains "
    "the image points better (by {better:.1f} decades)",
    "better_pose": "a pose {away} away fits better (by {margin:.1f} decades)",
    "better_nearby": "the nearest optimum, {degrees:.2g} deg away, fits better (by {margin:.1f} decades)",
    "other_points": "a pose {away} away explains other points, and the difference may be chance",
    "contradicts_prior": "it is {sigmas:.0f} standard deviations from the given prior",
    "second_body": "two bodies: {first} and {second} of {count} image points fit different poses, {away} apart",
    "one_part": "its {count} matches are all in one part of the scene: {left} image points and {others} scene points "
    "are left, and another body may be among them",
    "other_content": "{count} image points lie where the scene would repeat: another content, or another part, of the "
    "same lattice",
    "mirrored_image": "the image is mirrored: flipped, x = width - x, it fits better (by {better:.1f} decades)",
    "rough_residuals": "the points fit better with residuals far larger than those of the matches: try "
    "inlier_threshold={threshold:.2g}",
    "untested": "there was no time to test its competing poses",
    "incomplete": "a better {what} may exist (miss probability up to {probability})",
    # Another camera, or another scene, may be the right one.
    "other_camera": "with {camera} the points fit significantly better, by a pose {degrees:.0f} deg and "
    "{percent:.0f} % of the distance away",
    "other_focal_length": "with {zoom:.2f} times the focal length a pose {degrees:.0f} deg away fits about as well "
    "(margin {margin:.1f} decades)",
    "other_extrinsics": "the points of camera {camera} fit another pose, {away} away: check the extrinsics",
    "camera_untested": "there was no time to try other focal lengths",
    # The points do not determine an unknown.
    "rotation_not_fixed": "its {count:.0f} matches do not fix {what}",
    "focal_length_not_fixed": "the points do not fix the focal length: it and the distance may be {off}",
    "scale_not_fixed": "the points do not fix the scale of the scene: it may be more than {percent:.0f} % off",
}


class Unfinished:
    """Stages that a time limit may cut short, as `SolutionStats.unfinished` names them."""

    search = "search"
    matcher = "matcher"
    refinement = "refinement"
    focal_lengths = "focal lengths"
    competing_poses = "competing poses"
    views = "views"
    matches = matching.UNFINISHED


TESTS = {Unfinished.competing_poses, Unfinished.focal_lengths}  # stages without which no pose is confident


class Objection(NamedTuple):
    """Reason against a pose."""

    # Decades by which the pose is likelier than what contradicts it, negative if it is less likely; -inf if nothing was
    # compared.
    margin: float
    code: str  # kind of the reason, a key of `CLAUSES`
    clause: str

    def sentence(self, log10_false_alarms: float) -> str:
        """Return the reason of a pose with this log10 NFA."""
        clause = f"{self.clause[0].upper()}{self.clause[1:]}"
        return clause if self.code == "insignificant" else f"{clause}; {nfa(log10_false_alarms)}"


def objection(code: str, margin: float = -math.inf, **values: object) -> Objection:
    """Return a reason against a pose from a key of `CLAUSES`, the values of the clause and a margin, as in `Objection`.

    >>> objection("rotation_not_fixed", count=4, what="the rotation").sentence(-5.02)
    'Its 4 matches do not fix the rotation; log10 NFA -5.0'
    """
    return Objection(margin, code, CLAUSES[code].format(margin=margin, **values))


NO_POSE = objection("no_pose")


def focal_length_not_fixed(bound: float) -> Objection:
    """Return the objection that the points do not fix the focal length; `bound` is its 99.9 % bound, a fraction."""
    return objection("focal_length_not_fixed", off=f"{100 * bound:.0f} % off" if bound < 10 else "anything")


def confident(log10_false_alarms: float, margin: float, bound_deg: float, focal: float = 0.0) -> str:
    """Return the reason of a confident pose, which has no competing pose within `margin` decades.

    The 99.9 % bounds are those of the rotation in degrees, and of the focal length as a fraction, 0 if it is given.

    >>> confident(-69.1, 3.0, 0.213)
    'No competing pose within 3 decades; log10 NFA -69.1; rotation known to 0.2 deg (99.9 %)'
    >>> confident(-9.1, 3.0, 5.2, 0.634)
    'No competing pose within 3 decades; log10 NFA -9.1; rotation known to 5 deg, focal length to 63 % (99.9 %)'
    """
    precision = f"rotation known to {rounded(bound_deg)} deg"
    if focal:
        precision += f", focal length to {rounded(100 * focal)} %"
    return f"No competing pose within {margin:g} decades; {nfa(log10_false_alarms)}; {precision} (99.9 %)"


def miss_probability(log10_missed: float) -> str:
    """Format a miss probability, given as log10."""
    return number(min(log10_missed, 0.0))


def undecided(reason: str, seconds: float) -> str:
    """Return the reason of a pose that is undecided at the time limit of the search."""
    return f"{reason}; not decided in {seconds:.3g} s, a longer time limit may decide it"


def unfinished(reason: str, seconds: float, tried: int, views: int) -> str:
    """Return the reason of a photo whose views were not all tried, or not all long enough, within the time limit.

    >>> unfinished("no pose was found", 60.0, 213, 10000)
    'Not decided in 60 s, with 213 of 10,000 views tried. Best pose: no pose was found'
    """
    return f"Not decided in {seconds:.3g} s, with {tried:,} of {views:,} views tried. Best pose: {reason}"


def rounded(bound: float) -> str:
    """Format a bound: one digit below ten, whole numbers above."""
    return f"{bound:.1g}" if bound < 9.5 else f"{bound:.0f}"


def nfa(log10_false_alarms: float) -> str:
    """Format the logarithm of a number of false alarms."""
    shown = 0.0 if abs(log10_false_alarms) < SHOWN_DECADES else log10_false_alarms
    return f"log10 NFA {shown:.1f}"


def number(log10: float) -> str:
    """Format 10^x as a short number."""
    return f"{10**log10:.2g}" if -3 < log10 < 5 else f"1e{log10:.0f}"
