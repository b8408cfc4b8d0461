"""Rivals of the best pose: each file proposes competing poses, or objects to it, in one way."""

from collections.abc import Callable

from bpnp.search.search_frame import SearchFrame
from bpnp.search.verdict.decide import Case

SceneOf = Callable[[], SearchFrame]
Rival = Callable[[Case], Case]  # the case with competing poses or an objection; the same one if there is none
