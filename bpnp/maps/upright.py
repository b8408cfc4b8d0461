"""The direction up in a map and in a photo: which views are turned against a photo by quarter turns of the camera.

The orientation of EXIF data (tag 0x0112) says which side of a stored photo is up, to a quarter turn. COLMAP does not
turn photos, so a photo that is stored on its side has a pose 90 degrees away from those of upright views of the same
place.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bpnp.maps.views import Array, View

AGREE = np.cos(np.radians(30.0))  # largest angle between the upward directions of upright views
LEAST_AGREEING = 0.5  # fraction of the views that agree on the direction up
IN_PLANE = 0.5  # least length of the direction up in the image plane: a steeper view has no upright side


def up_of_views(views: Sequence[View]) -> Array | None:
    """Return the direction up (3,) in the map, a unit vector, that most views agree on; None if too few agree.

    The y axis of an upright photo points down. Photos that are stored on their side are outvoted.
    """
    ups = -np.array([view.rotation[1] for view in views])
    agree = ups @ ups[:: -(-len(ups) // 200)].T > AGREE  # with each of 200 views at most
    best = agree[:, int(agree.sum(0).argmax())]
    if best.mean() < LEAST_AGREEING:
        return None
    mean = ups[best].mean(0)
    return np.asarray(mean / np.linalg.norm(mean))


def quarter_turns(views: Sequence[View], up_camera: Array) -> NDArray[np.int64]:
    """Return the number of quarter turns about the optical axis (v,), 0 to 3, that take each view to a photo's upright.

    Args:
        views: Of a map.
        up_camera: (3,) direction up in the camera of the photo.

    Returns:
        Turns, from x towards y; 0 for views that look steeply up or down, and for all if the map's up is unknown.
    """
    up = up_of_views(views)
    if up is None or np.hypot(*up_camera[:2]) < IN_PLANE * np.linalg.norm(up_camera):
        return np.zeros(len(views), np.int64)
    seen = np.array([view.rotation @ up for view in views])
    angles = np.arctan2(up_camera[1], up_camera[0]) - np.arctan2(seen[:, 1], seen[:, 0])
    turns = np.round(angles / (np.pi / 2)).astype(np.int64) % 4
    return np.where(np.hypot(seen[:, 0], seen[:, 1]) < IN_PLANE, 0, turns)


def turned_view(view: View, turns: int) -> View:
    """Return a view whose camera is turned about its optical axis by quarter turns, from x towards y; same centre."""
    cosine, sine = ((1, 0), (0, 1), (-1, 0), (0, -1))[turns]
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return replace(view, rotation=turn @ view.rotation, translation=turn @ view.translation)
