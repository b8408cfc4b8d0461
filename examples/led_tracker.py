"""Track a device with LEDs at 60 frames per second: the last poses give a prior, and a search is the fallback.

    python examples/led_tracker.py [--seconds 10] [--seed 0]

Copy `LedTracker` and call it with the detected points of each frame. The run here is simulated: a controller rotates in
front of a camera with three other lights, and is hidden for half a second. The program prints the fraction of tracked
frames, the errors, and the median (p50) and 99th percentile (p99) of the time per frame, both elapsed and CPU time.
"""

import argparse
import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from constellation import CAMERA, RATE, controller, picture
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import bpnp

Array = NDArray[np.float64]
FEWEST = 4  # points that determine a pose


class LedTracker:
    """Tracker of the pose of a device in a stream of frames.

    Args:
        points3d: (n, 3) LEDs, metres.
        normals3d: (n, 3) outward unit normals of the LEDs.
        camera: As for `bpnp.solve`.
        rotation_sigma_deg: Standard deviation of the predicted rotation about each axis, degrees.
        translation_sigma: Standard deviation of the predicted translation along each axis, metres.
        check_every: One of this number of frames is solved without the prediction, so that a wrong pose cannot confirm
            itself.
        time_limit: Seconds per frame. If the search takes longer, the frame has no pose.

    Attributes:
        searched: True if the last frame was searched without a prediction, since the device was lost or for the check.
    """

    def __init__(
        self,
        points3d: Array,
        normals3d: Array,
        camera: Any,
        *,
        rotation_sigma_deg: float = 3.0,
        translation_sigma: float = 0.012,
        check_every: int = 30,
        time_limit: float = 0.2,
    ) -> None:
        self.device: dict[str, Any] = {"points3d": points3d, "camera": camera, "normals3d": normals3d}
        self.sigmas = rotation_sigma_deg, translation_sigma
        self.check_every, self.time_limit = check_every, time_limit
        self.poses: list[tuple[Array, Array]] = []  # the last two, without a gap
        self.frames, self.searched = 0, False

    def update(self, dots: Array) -> bpnp.Solution | None:
        """Return the pose of the device in the next frame, camera = R p + t; None if it was not found.

        Args:
            dots: (m, 2) bright dots, pixels.
        """
        prior, solution = self.prediction(), None
        self.searched = prior is None or self.frames % self.check_every == 0
        self.frames += 1
        if len(dots) >= FEWEST:
            if self.searched:
                solution = self._solved(dots, None)
            if prior is not None and solution is None:  # searches elsewhere too if the prediction does not hold
                solution = self._solved(dots, prior)
        self.poses = [] if solution is None else [*self.poses[-1:], (solution.rotation, solution.translation)]
        return solution

    def prediction(self) -> bpnp.PosePrior | None:
        """Return the last pose, moved on as it moved before; None if the device is lost."""
        if not self.poses:
            return None
        (rotation, translation), degrees, metres = self.poses[-1], *self.sigmas
        if len(self.poses) == 1:
            return bpnp.PosePrior(rotation, translation, 2 * degrees, 2 * metres)
        before, place = self.poses[-2]
        return bpnp.PosePrior(rotation @ before.T @ rotation, 2 * translation - place, degrees, metres)

    def _solved(self, dots: Array, prior: bpnp.PosePrior | None) -> bpnp.Solution | None:
        """Return a pose that is confident, or would be without its prior; with one also a likely pose near it."""
        solution = bpnp.solve(dots, **self.device, prior=prior, time_limit=self.time_limit)
        if solution.reason_code in ("confident", "contradicts_prior"):  # the device has jumped
            return solution
        if prior is None or solution.verdict == "failed" or prior.translation is None:
            return None
        turn = Rotation.from_matrix(solution.rotation @ np.asarray(prior.rotation).T).magnitude()
        shift = np.linalg.norm(solution.translation - np.asarray(prior.translation))
        near = math.degrees(turn) < 3 * prior.rotation_sigma_deg and shift < 3 * prior.translation_sigma
        return solution if near else None


def main(arguments: Sequence[str] | None = None) -> dict[str, float]:
    """Simulate a run, track it, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    rng = np.random.default_rng(options.seed)
    points, normals = controller(options.seed)
    count = round(options.seconds * RATE)
    frames = [picture(k / RATE, points, normals, rng) for k in range(count)]
    hidden = range(count // 2, min(count // 2 + RATE // 2, count))
    print(f"{count} frames; the device is hidden from frame {hidden.start} to {hidden.stop - 1}")
    bpnp.warm_up()
    tracker = LedTracker(points, normals, CAMERA)
    errors, times, searched = np.full((count, 2), math.nan), np.empty((count, 2)), np.zeros(count, bool)
    for k, frame in enumerate(frames):
        dots = frame.pixels if k not in hidden else frame.pixels[: FEWEST - 1]
        begun = time.perf_counter(), time.process_time()
        solution = tracker.update(dots)
        times[k] = 1000 * (time.perf_counter() - begun[0]), 1000 * (time.process_time() - begun[1])
        searched[k] = tracker.searched
        if solution is not None:
            turn = Rotation.from_matrix(solution.rotation @ frame.rotation.T).magnitude()
            errors[k] = math.degrees(turn), 1000 * np.linalg.norm(solution.translation - frame.translation)
    shown = np.array([k not in hidden for k in range(count)])
    seen = shown & [frame.leds > FEWEST for frame in frames]
    found = np.isfinite(errors[:, 0])
    again = next((k - hidden.stop for k in range(hidden.stop, count) if found[k]), math.nan)
    results = {
        "tracked, % of the frames with 5 LEDs or more": 100 * float(found[seen].mean()),
        "wrong by more than 3 degrees, % of all": 100 * float((errors[:, 0] > 3).mean()),
        "median error, degrees": float(np.nanmedian(errors[:, 0])),
        "median error, mm": float(np.nanmedian(errors[:, 1])),
        "found again after, frames": float(again),
        f"later than 1/{RATE} s, % of all": 100 * float((times[:, 0] > 1000 / RATE).mean()),
    }
    for kind, chosen in (("predicted", shown & ~searched), ("searched", shown & searched)):
        for column, clock in enumerate(("ms", "CPU ms")):
            for percent in (50, 99):
                results[f"p{percent} {clock} a frame, {kind}"] = float(np.percentile(times[chosen, column], percent))
    for name, value in results.items():
        print(f"{name:46s} {value:.4g}")
    return results


if __name__ == "__main__":
    main()
