"""Rivals of the best pose: the next is asked while nothing speaks against it, and a better pose starts them again."""

from collections.abc import Sequence
from functools import partial

from bpnp.runtime import NEVER, Deadline
from bpnp.search.verdict.decide import Case
from bpnp.search.verdict.rivals import Rival, SceneOf
from bpnp.search.verdict.rivals.given import given
from bpnp.search.verdict.rivals.lens import lens
from bpnp.search.verdict.rivals.mirrored_image import mirrored_image
from bpnp.search.verdict.rivals.nearby import nearby
from bpnp.search.verdict.rivals.other_content import other_content
from bpnp.search.verdict.rivals.second_body import second_body
from bpnp.search.verdict.rivals.symmetries import symmetries


def rivals_of(scene_of: SceneOf, deadline: Deadline = NEVER, *, enumerated: bool = False) -> list[Rival]:
    """Return the rivals of a pose of one camera, in the order in which they are asked.

    The scene is made only if a refinement needs it, and nothing is tested after the end of the deadline; `enumerated`
    candidates are those of an enumeration.
    """
    return [
        partial(symmetries, scene_of=scene_of, deadline=deadline, enumerated=enumerated),
        other_content,
        partial(nearby, scene_of=scene_of, deadline=deadline),
        partial(second_body, deadline=deadline),
        partial(mirrored_image, deadline=deadline),
        partial(lens, scene_of=scene_of, deadline=deadline),
        given,
    ]


def contest(case: Case, rivals: Sequence[Rival]) -> Case:
    """Return a case after its rivals were asked, up to the first objection; a new leader is asked from the start."""
    asked = 0
    while asked < len(rivals) and case.objection is None:
        answer = rivals[asked](case)
        asked, case = asked + 1 if answer.has_leader_of(case) else 0, answer
    return case
