"""BPnPNet, blind PnP end to end, and the weights of its authors (``*.pth.tar``).

Source: Campbell, Liu, Gould, "Solving the Blind Perspective-n-Point Problem End-To-End With Robust Differentiable
Geometric Optimization", ECCV 2020. The names and shapes of the 185 tensors are those of its public code.
"""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from bpnp.checks import check_within
from bpnp.layers.assignment import Sinkhorn
from bpnp.layers.implicit import first_derivative
from bpnp.layers.pnp import WeightedPnP
from bpnp.layers.ransac.layer import Backend, RansacPnP
from bpnp.models.nets import ImageFeatures, SceneFeatures
from bpnp.models.pose_stages import (
    Axis,
    InitialMatch,
    StageClock,
    choose_tensors,
    match_again,
    pnp_pose,
    pose_support,
    ransac_pose,
    round_widths,
    turn_scene,
)
from bpnp.models.refinement import Refinement
from bpnp.models.weights import AnyModule, TrainedNet, module_or_default
from bpnp.precision import full_precision
from bpnp.types import Batch, Prediction

SQUARED_FLOOR = 1e-7  # rounding of the product of two float32 unit vectors
# A checkpoint may hold its best error as a numpy scalar. Its constructor has one name per numpy version.
_NUMPY_SCALAR = np.float64(0).__reduce__()[0]
_NUMPY_GLOBALS: list[Any] = [
    (_NUMPY_SCALAR, "numpy.core.multiarray.scalar"),
    (_NUMPY_SCALAR, "numpy._core.multiarray.scalar"),
    np.dtype,
    *(type(np.dtype(kind)) for kind in ("f2", "f4", "f8", "i4", "i8", "?")),
]
# Names of our modules, as patterns, and the authors' names.
_THEIRS = {
    r"features(\d)d\.enter": r"FeatureExtractor\1d.conv_in.0",
    r"features(\d)d\.blocks\.(\d+)\.linear_a": r"FeatureExtractor\1d.conv_\2.preconv.0",
    r"features(\d)d\.blocks\.(\d+)\.linear_b": r"FeatureExtractor\1d.conv_\2.conv1.0",
    r"features(\d)d\.blocks\.(\d+)\.linear_c": r"FeatureExtractor\1d.conv_\2.conv2.0",
    **{f"features3d.align.norms.{i}": f"stn.bn{i + 1}" for i in range(5)},
    **{f"features3d.align.linears.{i}": f"stn.conv{i + 1}" for i in range(3)},
    "features3d.align.linears.3": "stn.fc1",
    "features3d.align.linears.4": "stn.fc2",
    "features3d.align.out": "stn.fc3",
}


class BPnPNet(TrainedNet):
    """Network of the paper: features of both point sets, transport, RANSAC, and weighted PnP.

    The transport turns distances of features into an assignment. RANSAC estimates an initial pose from the most
    probable matches, and weighted PnP refines it on all of them. Every part is a module with its own options, and may
    be replaced by another with the same arguments and results. A part that is None is the class of this package with
    its default options. The options of the paper are in the files of
    configs/paper.

    Args:
        features2d: Maps image points (b, m, 2) and their mask to unit features (b, m, c). None for `ImageFeatures()`.
        features3d: Maps scene points (b, n, 3) and their mask to unit features (b, n, c). None for `SceneFeatures()`.
        transport: Maps a cost (b, m, n) and both masks to the assignment (b, m, n) and its `SolveStats`. None for
            `Sinkhorn()`.
        ransac: Maps assignment, points2d, points3d and both masks to rotation, translation and `SolveStats` of an
            initial pose. None for `RansacPnP()`.
        pnp: Maps assignment, bearings, points3d and the initial pose to a pose that is differentiable in the
            assignment. None for `WeightedPnP()`.
        refinement: Computes the third pose "refined" in evaluation. None for `Refinement()`.
        rounds: Number of times that the points are matched again under the last pose in evaluation, starting from that
            of RANSAC (`bpnp.models.pose_stages.match_again`). Default 0. A round adds the squared residuals, in units
            of a width, to the cost; the width decreases from round to round, to `ransac.threshold` in the last one.
            Rounds need a `ransac` with that attribute and a `transport` whose attribute `entropy` is the weight mu.
        headings: Number of headings in evaluation. With k, the scene is rotated about `vertical` by 0, 1, ..., k - 1
            times 360 / k degrees, and the network and `ransac` run for each; the assignment whose RANSAC pose explains
            the largest probability is kept. Poses are in the coordinates of the scene. Default 1.
        vertical: Axis of the scene that is vertical, for `headings`: "x", "y" or "z". Default "y".

    >>> import torch
    >>> from bpnp import Batch, BPnPNet
    >>> from bpnp.layers import Sinkhorn
    >>> net = BPnPNet(transport=Sinkhorn(mu=0.05)).eval()
    >>> prediction = net(Batch.from_arrays(torch.rand(20, 2), torch.rand(30, 3)))
    >>> tuple(prediction.assignment.shape), list(prediction.poses)
    ((1, 20, 30), ['ransac', 'pnp', 'refined'])
    """

    def __init__(
        self,
        features2d: ImageFeatures | AnyModule | None = None,
        features3d: SceneFeatures | AnyModule | None = None,
        transport: Sinkhorn | AnyModule | None = None,
        ransac: RansacPnP | AnyModule | None = None,
        pnp: WeightedPnP | AnyModule | None = None,
        *,
        refinement: Refinement | None = None,
        rounds: int = 0,
        headings: int = 1,
        vertical: Axis = "y",
    ) -> None:
        super().__init__()
        self.features2d = module_or_default(features2d, ImageFeatures)
        self.features3d = module_or_default(features3d, SceneFeatures)
        self.transport = module_or_default(transport, Sinkhorn)
        self.ransac = module_or_default(ransac, RansacPnP)
        self.pnp = module_or_default(pnp, WeightedPnP)
        self.refinement = Refinement() if refinement is None else refinement
        self.rounds = rounds
        self.widths = round_widths(rounds, self.ransac)
        check_within(1, math.inf, headings=headings)
        self.headings, self.vertical = headings, vertical

    def forward(self, batch: Batch) -> Prediction:
        """Return the assignment and the poses "ransac" and "pnp".

        In evaluation "pnp" is the pose after the rounds, and "refined" is added.

        Args:
            batch: Problems.

        Returns:
            Prediction with the assignment P (b, m, n), its stats and the poses.
        """
        clock = StageClock()
        initial = self._initial_match(batch)
        clock.record("ransac")
        pnp = pnp_pose(self.pnp, initial.assignment, batch, initial.pose)
        prediction = Prediction(initial.assignment, initial.stats, {"ransac": initial.pose, "pnp": pnp})
        if self.training:
            return prediction
        again = match_again(prediction, initial.cost, batch, transport=self.transport, pnp=self.pnp, widths=self.widths)
        clock.record("pnp")
        return clock.add_times(self.refinement(again, batch))

    def _initial_match(self, batch: Batch) -> InitialMatch:
        """Match the points and run RANSAC; in evaluation, for each heading, and keep the best."""
        features2d, features3d = self.features(batch)
        best = self._match_features(features2d, features3d, batch)
        if self.training or self.headings == 1:
            return best
        support = pose_support(best.assignment, batch, best.pose)
        for i in range(1, self.headings):
            turned = turn_scene(batch, self.vertical, 2 * math.pi * i / self.headings)
            features3d = self.features3d(turned.points3d.to(features2d), batch.mask3d)
            found = self._match_features(features2d, features3d, batch)
            better = (found_support := pose_support(found.assignment, batch, found.pose)) > support
            best, support = choose_tensors(better, found, best), torch.maximum(support, found_support)
        return best

    def _match_features(
        self, features2d: Float[Tensor, "b m c"], features3d: Float[Tensor, "b n c"], batch: Batch
    ) -> InitialMatch:
        """Match the points by their features, and run RANSAC in the coordinates of the scene."""
        cost = pairwise_distance(features2d, features3d)
        assignment, stats = self.transport(cost, batch.mask2d, batch.mask3d)
        return InitialMatch(cost, assignment, stats, ransac_pose(self.ransac, assignment, batch))

    def match(self, batch: Batch) -> Prediction:
        """Return the assignment without poses, which is all that training without the pose loss needs.

        Args:
            batch: Problems.

        Returns:
            Prediction with the assignment P (b, m, n) and its stats.
        """
        return Prediction(*self.transport(self.cost(batch), batch.mask2d, batch.mask3d))

    def cost(self, batch: Batch) -> Float[Tensor, "b m n"]:
        """Return the feature distances M_ij = ||z_i - z_j||_2, in [0, 2].

        Args:
            batch: Problems.

        Returns:
            M (b, m, n), in the dtype of the network.
        """
        return pairwise_distance(*self.features(batch))

    def features(self, batch: Batch) -> tuple[Float[Tensor, "b m c"], Float[Tensor, "b n c"]]:
        """Return the unit features of both sides.

        Args:
            batch: Problems.

        Returns:
            Features of the image points (b, m, c) and of the scene points (b, n, c), in the dtype of the network.
        """
        batch = batch.to(next((p.dtype for p in self.parameters()), batch.points2d.dtype))
        return self.features2d(batch.points2d, batch.mask2d), self.features3d(batch.points3d, batch.mask3d)


@full_precision
def pairwise_distance(a: Float[Tensor, "b m c"], b: Float[Tensor, "b n c"]) -> Float[Tensor, "b m n"]:
    """Return ||a_i - b_j||_2 of unit vectors, from one matrix product. The gradient at distance zero is zero."""
    return _PairwiseDistance.apply(a, b)


class _PairwiseDistance(torch.autograd.Function):
    """Distances D with the gradient dL/da = -(G / D) b, for which only D is stored; its products are exact."""

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor) -> Tensor:
        squared = torch.baddbmm(a.new_full((1, 1, 1), 2.0), a, b.mT, alpha=-2)
        distance = nn.functional.threshold(squared, SQUARED_FLOOR, 0.0, inplace=True).sqrt_()
        ctx.save_for_backward(a, b, distance)
        return distance

    @staticmethod
    @first_derivative
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        a, b, distance = ctx.saved_tensors
        weight = torch.ops.aten.threshold_backward(gradient / distance, distance, 0)  # zero where the distance is
        return weight @ -b, weight.mT @ -a


def tensor_maps() -> dict[str, tuple[tuple[int, ...], str]]:
    """Return the shape and our name of each tensor of the authors' network, by the authors' name.

    There are 185 tensors: 1,992,841 parameters and the buffers of the batch norms. The authors' 1x1 convolutions
    (out, in, 1) are our linear maps (out, in). Both apply the input transform from the right, points @ T.
    """
    with torch.device("meta"):
        weights = BPnPNet().state_dict()
    maps = {}
    for ours, value in weights.items():
        module, _, kind = ours.rpartition(".")
        authors = next(re.sub(old, new, module) for old, new in _THEIRS.items() if re.fullmatch(old, module))
        convolution = "conv" in authors and kind == "weight"
        maps[f"{authors}.{kind}"] = ((*value.shape, 1) if convolution else tuple(value.shape), ours)
    return maps


def load_authors_weights(path: str | Path, *, backend: Backend = "auto") -> BPnPNet:
    """Load a ``*.pth.tar`` file of the authors on the CPU, in evaluation mode.

    The network computes the same assignment as the authors' network for every problem. Only tensors, plain containers
    and numbers are unpickled. The backend is that of `bpnp.layers.RansacPnP`, which has no weights. Raise ValueError if
    the file is no checkpoint, or a tensor is missing, unexpected, not finite or of another shape.
    """
    file = Path(path)
    state = _read_state(file)
    maps = tensor_maps()
    problems = [f"no {key!r}" for key in maps.keys() - state.keys()]
    problems += [f"an unexpected {key!r}" for key in state.keys() - maps.keys()]
    for key in maps.keys() & state.keys():
        value = state[key]
        if not isinstance(value, Tensor):
            problems.append(f"{key!r} as a {type(value).__name__}, not a tensor")
        elif tuple(value.shape) != maps[key][0]:
            problems.append(f"{key!r} of shape {tuple(value.shape)}, not {maps[key][0]}")
        elif not value.isfinite().all():
            problems.append(f"{key!r} with NaN or infinity")
    if problems:
        more = f" and {len(problems) - 3} more problems" if len(problems) > 3 else ""
        raise ValueError(
            f"{file} does not hold the {len(maps)} tensors of the authors' BPnPNet: {'; '.join(sorted(problems)[:3])}"
            f"{more}. Use the authors' original file"
        )
    net = BPnPNet(ransac=RansacPnP(backend=backend))
    shapes = {name: value.shape for name, value in net.state_dict().items()}
    net.load_state_dict({ours: state[key].reshape(shapes[ours]) for key, (_, ours) in maps.items()})
    return net.eval()


def _read_state(file: Path) -> Mapping[str, Any]:
    """Read the `state_dict` of a checkpoint, in either of torch's file formats."""
    if not file.is_file():
        raise FileNotFoundError(f"there is no file of the authors' weights at {file}")
    try:
        with torch.serialization.safe_globals(_NUMPY_GLOBALS):
            content = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:
        refused = re.search(r"GLOBAL (\S+)", str(error))
        reason = f"{refused[1]} in it is refused" if refused else f"{type(error).__name__} while reading"
        raise ValueError(
            f"cannot read {file}: {reason}. Only tensors, numbers and plain containers are read; download it again"
        ) from error
    state = content.get("state_dict") if isinstance(content, dict) else None
    if not isinstance(state, Mapping):
        found = ", ".join(map(repr, list(content)[:6])) if isinstance(content, dict) else type(content).__name__
        raise ValueError(f"{file} has no `state_dict`; it holds {found or 'nothing'}")
    # DataParallel prefixes every name
    return {str(key).removeprefix("module."): value for key, value in state.items()}
