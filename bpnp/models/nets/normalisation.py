"""Normalisation over sets of different sizes, padded: no statistic sees a padded point."""

import torch
import torch.distributed as dist
import torch.distributed.nn.functional as collectives
from jaxtyping import Bool, Float
from torch import Tensor, nn


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
        mean, variance = self._statistics(x, weight)
        scale = torch.rsqrt(variance + self.eps) * self.weight
        return torch.addcmul(self.bias - mean * scale, x, scale)

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

    def _statistics(self, x: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        axes = tuple(range(x.ndim - 1))
        count, total = weight.sum().reshape(1), (x * weight).sum(axes)
        if dist.is_initialized():
            count, total = collectives.all_reduce(count), collectives.all_reduce(total)
        mean = total / count
        scatter = (((x - mean) * weight) ** 2).sum(axes)
        if dist.is_initialized():
            scatter = collectives.all_reduce(scatter)
        enough = count > 1
        with torch.no_grad():
            rate = self.momentum * enough.to(self.running_mean.dtype)
            self.running_mean.lerp_(mean.to(self.running_mean.dtype), rate)
            self.running_var.lerp_((scatter / (count - 1).clamp_min(1)).to(self.running_var.dtype), rate)
            self.num_batches_tracked += 1
        return torch.where(enough, mean, self.running_mean), torch.where(enough, scatter / count, self.running_var)
