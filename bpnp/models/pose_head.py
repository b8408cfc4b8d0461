"""From an assignment to poses: RANSAC on its best pairs, weighted PnP on all of them."""

from jaxtyping import Float
from torch import Tensor, nn

from bpnp.geometry import bearings
from bpnp.types import Batch, Pose


def ransac_pose(ransac: nn.Module, assignment: Float[Tensor, "b m n"], batch: Batch) -> Pose:
    """A robust first pose from the most probable pairs; no gradient reaches the assignment.

    ransac: a module with the arguments of `bpnp.layers.RansacPnP`.
    """
    return Pose(*ransac(assignment.detach(), batch.points2d, batch.points3d, batch.mask2d, batch.mask3d))


def pnp_pose(pnp: nn.Module, assignment: Float[Tensor, "b m n"], batch: Batch, start: Pose) -> Pose:
    """The pose that best explains the whole assignment, from a start; differentiable in the assignment.

    pnp: a module with the arguments of `bpnp.layers.WeightedPnP`.
    """
    rays = bearings(batch.points2d)
    return Pose(*pnp(assignment, rays, batch.points3d, start.rotation, start.translation))
