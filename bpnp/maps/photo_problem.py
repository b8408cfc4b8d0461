"""A photo to localise, and the problem of its keypoints and some points of a map."""

import math
from dataclasses import dataclass, replace
from typing import Any

from bpnp.arrays import Array
from bpnp.cameras import Camera, camera_from
from bpnp.maps.viewed_points import RankViews, Region
from bpnp.search.focal_length import UnknownCamera
from bpnp.search.inputs import problem_from
from bpnp.search.problem import Problem, UnknownFocal
from bpnp.search.solution import Solution


@dataclass(frozen=True, eq=False)
class Photo:
    """Keypoints and camera of a photo to localise, with the prior, seed and ranking of its search."""

    keypoints: Array  # (m, 2) pixels
    camera: Camera | UnknownCamera  # camera model, or its prior if the focal length is unknown
    prior: Any = None
    view_count: int = 1  # number of views that are tried, which the NFA counts as tests
    seed: int = 0
    # Function that scores the views, as for `SceneMap.localize`; None for the density of the points.
    rank_views: RankViews | None = None

    def problem(self, region: Region, camera: Any, prior: Any = None, focal: UnknownFocal | None = None) -> Problem:
        """Return the problem of the keypoints and the points of one region."""
        axes, cosines = region.cones
        arguments: dict[str, Any] = {"normals3d": axes, "cosines3d": cosines, "prior": prior, "focal": focal}
        problem = problem_from(self.keypoints, region.points3d, camera_from(camera), **arguments)
        return replace(problem, log10_views=math.log10(self.view_count))


def with_ids(solution: Solution, region: Region) -> Solution:
    """Return a solution with the point ids of a region and the name of its view."""
    return replace(solution, view=region.view.name, point_ids=region.point_ids)
