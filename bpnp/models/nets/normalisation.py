"""Statistics of padded sets, which see no padded point: means, batch norm, and frames of sets with much clutter."""

from collections.abc import Callable

import torch
import torch.distributed as dist
import torch.distributed.nn.functional as collectives
from jaxtyping import Bool, Float
from torch import Tensor, nn

from bpnp.models.nets.pointwise import gram, pointwise
from bpnp.precision import full_precision

ROUNDS = 20  # of reweighting, towards the point with the smallest sum of distances
NEAR = 2.0  # median distances from the centre at which a point's weight is a quarter
FARTHEST = 3.0  # median distances; a point beyond counts as much as one there for the direction of an axis


def centred(x: Float[Tensor, "b k c"], mask: Bool[Tensor, "b k"]) -> Float[Tensor, "b k c"]:
    """x - mean over the real points of each set, per channel."""
    weight = mask.unsqueeze(-1).to(x.dtype)
    return x - (x * weight).sum(1, keepdim=True) / weight.sum(1, keepdim=True)


class MaskedBatchNorm(nn.BatchNorm1d):
    """Batch norm over the real points of (b, k, c), or over the samples of (b, c).

    In training the statistics cover the batches of all processes, so that splitting a batch over processes changes
    nothing; a batch with a single value per channel has no variance and uses the running statistics.
    """

    running_mean: Tensor
    running_var: Tensor
    num_batches_tracked: Tensor
    momentum: float

    def forward(self, x: Tensor, mask: Bool[Tensor, "b k"] | None = None) -> Tensor:
        if not self.training or (x.is_cpu and not dist.is_initialized() and not torch.compiler.is_compiling()):
            return self._of_real_points(x, mask)
        weight = torch.ones_like(x[..., :1]) if mask is None else mask.unsqueeze(-1).to(x.dtype)
        axes = tuple(range(x.ndim - 1))
        total = (x * weight).sum(axes)
        scale, shift = self.factors(weight.sum().reshape(1), total, lambda mean: (((x - mean) * weight) ** 2).sum(axes))
        return torch.addcmul(shift, x, scale)

    def _of_real_points(self, x: Tensor, mask: Bool[Tensor, "b k"] | None) -> Tensor:
        """torch's own batch norm, several times quicker; in training it sees the real points only."""
        real = None if mask is None or not self.training or bool(mask.all()) else mask
        points = x.flatten(0, -2) if real is None else x[real]
        enough = self.training and len(points) > 1
        if enough:
            self.num_batches_tracked += 1
        out = nn.functional.batch_norm(
            points, self.running_mean, self.running_var, self.weight, self.bias, enough, self.momentum, self.eps
        )
        return out.view_as(x) if real is None else torch.zeros_like(x).masked_scatter(real.unsqueeze(-1), out)

    def factors(
        self, count: Tensor, total: Float[Tensor, " c"], scatter: Callable[[Tensor], Tensor]
    ) -> tuple[Float[Tensor, " c"], Float[Tensor, " c"]]:
        """Factor and summand of the norm; in training from the values' number, sum, and sum of squares about a mean."""
        mean, variance = self.running_mean, self.running_var
        if self.training:
            mean, variance = self._statistics(count, total, scatter)
        scale = torch.rsqrt(variance + self.eps) * self.weight
        return scale, self.bias - mean * scale

    def _statistics(
        self, count: Tensor, total: Tensor, scatter_about: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor]:
        if dist.is_initialized():
            count, total = collectives.all_reduce(count), collectives.all_reduce(total)
        mean = total / count
        scatter = scatter_about(mean)
        if dist.is_initialized():
            scatter = collectives.all_reduce(scatter)
        enough = count > 1
        with torch.no_grad():
            rate = self.momentum * enough.to(self.running_mean.dtype)
            self.running_mean.lerp_(mean.to(self.running_mean.dtype), rate)
            self.running_var.lerp_((scatter / (count - 1).clamp_min(1)).to(self.running_var.dtype), rate)
            self.num_batches_tracked += 1
        return torch.where(enough, mean, self.running_mean), torch.where(enough, scatter / count, self.running_var)


def highest_normed(
    x: Float[Tensor, "b k c"], linear: nn.Linear, norm: MaskedBatchNorm, mask: Bool[Tensor, "b k"] | None
) -> Float[Tensor, "b d"]:
    """Largest value of norm(linear(x)) over the real points of each set, per channel; mask None: nothing is padded.

    Only the largest values are kept for the gradient, no values of d channels of each point: z = W x + b has the mean
    W s + b and the variance diag(W C W^T), s and C the mean and the covariance of x. z is largest where the norm is, or
    smallest if the norm's factor is negative.
    """
    weight, bias = linear.weight, linear.bias
    with torch.autocast(x.device.type, enabled=False):
        x = x.to(weight.dtype)
        with torch.no_grad():
            z = pointwise(x, torch.where(norm.weight < 0, -1, 1).unsqueeze(-1) * weight, None)
            z = z if mask is None else z.masked_fill(~mask.unsqueeze(-1), -torch.inf)
            place = nn.functional.adaptive_max_pool2d_with_indices(z.mT.unsqueeze(2), 1)[1].flatten(1)
        points = x.flatten(0, 1)
        first = x.shape[1] * torch.arange(len(x), device=x.device).unsqueeze(-1)
        highest = (nn.functional.embedding(place + first, points) * weight).sum(2) + bias
        count = x.new_full((1,), len(points)) if mask is None else mask.sum().to(x.dtype).reshape(1)
        seen = x if mask is None else x * mask.unsqueeze(-1)
        centre = seen.sum((0, 1)) / count
        mean = weight @ centre + bias

        def scatter(about: Tensor) -> Tensor:
            around = x - centre if mask is None else seen - centre * mask.unsqueeze(-1)
            return ((weight @ gram(around)) * weight).sum(1) + count * (mean - about) ** 2

        scale, shift = norm.factors(count, count * mean, scatter)
        return torch.addcmul(shift, highest, scale)


def robust_frame(
    points: Float[Tensor, "b k d"], mask: Bool[Tensor, "b k"]
) -> tuple[Float[Tensor, "b 1 d"], Float[Tensor, "b 1 1"]]:
    """Median of each coordinate and median distance from it: half of the points may be clutter. Padding is not seen.

    A set whose points coincide has radius one.
    """
    hidden = points.masked_fill(~mask.unsqueeze(-1), torch.nan)
    centre = hidden.nanmedian(1, keepdim=True).values
    return centre, _radius(torch.linalg.vector_norm(hidden - centre, dim=-1))


@full_precision
@torch.no_grad()
def principal_axes(points: Float[Tensor, "b k 3"], mask: Bool[Tensor, "b k"]) -> Float[Tensor, "b 3 3"]:
    """Columns: axes of the points' covariance about their geometric median, far points counting less; shortest first.

    They turn with the points. An axis points to where the points' tail is longer, but for the first, which makes the
    frame right-handed; without a tail, as in a symmetric set, the direction is arbitrary. Padding is not seen.
    """
    weight = mask.unsqueeze(-1).to(points.dtype)
    hidden = points.masked_fill(~mask.unsqueeze(-1), torch.nan)
    centre, radius = robust_frame(points, mask)
    for _ in range(ROUNDS):
        near = weight / torch.linalg.vector_norm(points - centre, dim=-1, keepdim=True).clamp_min(1e-3 * radius)
        centre = (points * near).sum(1, keepdim=True) / near.sum(1, keepdim=True)
    radius = _radius(torch.linalg.vector_norm(hidden - centre, dim=-1))
    offset = (points - centre) / radius * weight
    weight = weight * (1 + (offset**2).sum(-1, keepdim=True) / NEAR**2) ** -2
    axes = torch.linalg.eigh(((offset * weight).mT @ offset).double()).eigenvectors.to(points.dtype)
    tail = (weight * (offset @ axes).clamp(-FARTHEST, FARTHEST) ** 3).sum(1, keepdim=True)
    axes = torch.where(tail < 0, -axes, axes)
    return torch.cat([axes[:, :, :1] * torch.linalg.det(axes)[:, None, None], axes[:, :, 1:]], 2)


def _radius(distance: Float[Tensor, "b k"]) -> Float[Tensor, "b 1 1"]:
    """Median of each row but for NaN; one for zero."""
    radius = distance.nanmedian(1).values[:, None, None]
    return torch.where(radius > 0, radius, 1)
