"""Normalisation over sets of different sizes, padded: no statistic sees a padded point."""

import torch
import torch.distributed as dist
import torch.distributed.nn.functional as collectives
from jaxtyping import Bool, Float
from torch import Tensor, nn

CONTEXT_EPS = 1e-3  # as in the released code


def context_norm(x: Float[Tensor, "b k c"], mask: Bool[Tensor, "b k"]) -> Float[Tensor, "b k c"]:
    """(x - mean) / sqrt(var + 1e-3) over the points of each set, per channel, with the unbiased variance.

    The only exchange between points of a set. A set of one point has variance zero.
    """
    weight = mask.unsqueeze(-1).to(x.dtype)
    count = weight.sum(1, keepdim=True)
    mean = (x * weight).sum(1, keepdim=True) / count
    centred = (x - mean) * weight
    variance = (centred * centred).sum(1, keepdim=True) / (count - 1).clamp_min(1)
    return centred * torch.rsqrt(variance + CONTEXT_EPS)


class MaskedBatchNorm(nn.BatchNorm1d):
    """Batch norm over the real points of (b, k, c), or over the samples of (b, c).

    In training the statistics cover the batches of all processes, so that splitting a batch over processes changes
    nothing; a batch with a single value per channel has no variance and uses the running statistics.
    """

    def forward(self, x: Tensor, mask: Bool[Tensor, "b k"] | None = None) -> Tensor:
        weight = torch.ones_like(x[..., :1]) if mask is None else mask.unsqueeze(-1).to(x.dtype)
        mean, variance = self._statistics(x, weight) if self.training else self._running()
        return (x - mean) * torch.rsqrt(variance + self.eps) * self.weight + self.bias

    def _running(self) -> tuple[Tensor, Tensor]:
        assert self.running_mean is not None
        assert self.running_var is not None
        return self.running_mean, self.running_var

    def _statistics(self, x: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        axes = tuple(range(x.ndim - 1))
        count, total = weight.sum().reshape(1), (x * weight).sum(axes)
        if dist.is_initialized():
            count, total = collectives.all_reduce(count), collectives.all_reduce(total)
        mean = total / count
        scatter = (((x - mean) * weight) ** 2).sum(axes)
        if dist.is_initialized():
            scatter = collectives.all_reduce(scatter)
        running_mean, running_var = self._running()
        enough = count > 1
        with torch.no_grad():
            assert self.momentum is not None
            rate = self.momentum * enough.to(running_mean.dtype)
            running_mean.lerp_(mean.detach().to(running_mean.dtype), rate)
            running_var.lerp_((scatter / (count - 1).clamp_min(1)).detach().to(running_var.dtype), rate)
            if self.num_batches_tracked is not None:
                self.num_batches_tracked += 1
        return torch.where(enough, mean, running_mean), torch.where(enough, scatter / count, running_var)
