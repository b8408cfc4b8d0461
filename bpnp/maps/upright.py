"""Direction up in a map and in a photo: quarter turns of the views that match the orientation of a photo.

The EXIF orientation (tag 0x0112) gives the upper side of a stored photo, to a quarter turn. COLMAP does not rotate
photos. So the pose of a photo that is stored on its side is 90 degrees away from those of upright views of the place.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bpnp.arrays import Array
from bpnp.maps.views import View
from bpnp.poses import common_up

# A steeper view has no upright side.
LEAST_IN_PLANE = 0.5  # least length of the direction up in the image plane [1; not tuned]


def count_quarter_turns(views: Sequence[View], up_camera: Array) -> NDArray[np.int64]:
    """Return the number of quarter turns (v,), 0 to 3, that rotate each view to the orientation of a photo.

    Turns are about the optical axis, from x towards y; `up_camera` (3,) is the direction up in the photo's camera
    frame. It is 0 for views that point steeply up or down, and for all views if the direction up in the map is unknown.
    """
    up = common_up(np.array([view.rotation for view in views]))
    if up is None or np.hypot(*up_camera[:2]) < LEAST_IN_PLANE * np.linalg.norm(up_camera):
        return np.zeros(len(views), np.int64)
    ups = np.array([view.rotation @ up for view in views])
    angles = np.arctan2(up_camera[1], up_camera[0]) - np.arctan2(ups[:, 1], ups[:, 0])
    quarters = np.round(angles / (np.pi / 2)).astype(np.int64) % 4
    return np.where(np.hypot(ups[:, 0], ups[:, 1]) < LEAST_IN_PLANE, 0, quarters)


def rotate_view(view: View, quarters: int) -> View:
    """Return a view with its camera rotated about the optical axis by quarter turns, from x towards y; same centre."""
    cosine, sine = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters]
    quarter_rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return replace(view, rotation=quarter_rotation @ view.rotation, translation=quarter_rotation @ view.translation)
