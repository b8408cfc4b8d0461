"""Which part of a map to try first: the points of given views, or of views that together see most of the map."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bpnp.maps.views import View, ViewedPoints
from bpnp.search.starts import PosePrior

VIEW_DEGREES = 15.0  # about the largest angle per axis between photos of which one sees a third of the other's points
VIEW_SHARE = 0.2  # the same of the shift of what they look at, in distances to it


@dataclass(frozen=True, eq=False)
class Region:
    """Points of the map, by their places in `points3d`, that one view, or several, see, and the view to look near."""

    view: View
    points: NDArray[np.int32]

    def prior(self, scene: ViewedPoints) -> PosePrior:
        """The view's pose, as wide as photos of one place lie apart."""
        camera = scene.points3d[self.view.points] @ self.view.rotation.T + self.view.translation
        distance = float(np.median(np.linalg.norm(camera, axis=-1)))
        return PosePrior(self.view.rotation, self.view.translation, VIEW_DEGREES, VIEW_SHARE * distance)


def regions_of_views(scene: ViewedPoints, names: Iterable[str]) -> list[Region]:
    """The points that any of these views sees, near each of them in the order given.

    All of them at once, since they show one place: a pose near one view sees points that only others see.
    Raises ValueError for unknown names, or if there is none.
    """
    views = scene.named(names)
    if not views:
        raise ValueError("expected names of views to try, got none; try views=None for all of the map")
    points = np.unique(np.concatenate([view.points for view in views]))
    return [Region(view, points) for view in views if len(view.points)]


def covering_regions(scene: ViewedPoints) -> Iterator[Region]:
    """The points of one view after the other, each time of the one that sees most points that none before saw.

    Greedy maximum coverage; views that see nothing new follow, largest first.
    """
    visibility = scene.visibility
    new = np.diff(visibility.indptr).astype(np.int64)
    size, left, unseen = new.copy(), np.ones(len(new), bool), np.ones(len(scene.points3d), bool)
    for _ in scene.views:
        best = int(np.lexsort((size, new, left))[-1])
        left[best] = False
        view = scene.views[best]
        if not len(view.points):
            continue
        fresh = view.points[unseen[view.points]]
        unseen[fresh] = False
        new = new - np.asarray(visibility[:, fresh].sum(1)).ravel()
        yield Region(view, view.points)


def read_pairs(path: str | Path) -> dict[str, list[str]]:
    """The views to try for each photo, from a text file of pairs `photo view`, one a line, as hloc's retrieval writes.

    Raises ValueError for a file that cannot be read or a line without two names.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"expected a text file of pairs of names, got {error}") from error
    pairs: dict[str, list[str]] = {}
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        names = line.split()
        if len(names) != 2:
            raise ValueError(f"expected two names, a photo's and a view's, got {line!r} at line {number} of {path}")
        pairs.setdefault(names[0], []).append(names[1])
    return pairs
