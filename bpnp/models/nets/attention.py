"""Attention within and between two padded point sets; a point's result depends on no padded point."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention


class Attention(nn.Module):
    """x + out(softmax(q k^T / sqrt(d)) v), with q of the points x and k, v of the points it looks at, both normalised.

    channels: width, a multiple of heads.
    """

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        if channels % heads:
            raise ValueError(f"expected `channels` a multiple of `heads`, got {channels} and {heads}")
        self.heads = heads
        self.norm = nn.LayerNorm(channels)
        self.query = nn.Linear(channels, channels)
        self.key_value = nn.Linear(channels, 2 * channels)
        self.out = nn.Linear(channels, channels)

    def forward(
        self, x: Float[Tensor, "b k c"], seen: Float[Tensor, "b l c"], mask: Bool[Tensor, "b l"]
    ) -> Float[Tensor, "b k c"]:
        """mask: True at the real points of `seen`."""
        q = self._split(self.query(self.norm(x)))
        k, v = (self._split(part) for part in self.key_value(self.norm(seen)).chunk(2, -1))
        z = scaled_dot_product_attention(q, k, v, attn_mask=mask[:, None, None, :])
        return x + self.out(z.transpose(1, 2).flatten(2))

    def _split(self, x: Float[Tensor, "b k c"]) -> Float[Tensor, "b h k d"]:
        return x.unflatten(-1, (self.heads, -1)).transpose(1, 2)


class FeedForward(nn.Module):
    """x + linear(gelu(linear(norm(x)))), each point for itself."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(channels)
        self.enter = nn.Linear(channels, 2 * channels)
        self.out = nn.Linear(2 * channels, channels)

    def forward(self, x: Float[Tensor, "b k c"]) -> Float[Tensor, "b k c"]:
        return x + self.out(nn.functional.gelu(self.enter(self.norm(x))))


class ExchangeBlock(nn.Module):
    """Each set looks at itself, then at the other; the weights of the two directions are the same."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.within = Attention(channels, heads)
        self.between = Attention(channels, heads)
        self.feed = FeedForward(channels)

    def forward(
        self,
        x2d: Float[Tensor, "b m c"],
        x3d: Float[Tensor, "b n c"],
        mask2d: Bool[Tensor, "b m"],
        mask3d: Bool[Tensor, "b n"],
    ) -> tuple[Float[Tensor, "b m c"], Float[Tensor, "b n c"]]:
        x2d, x3d = self.within(x2d, x2d, mask2d), self.within(x3d, x3d, mask3d)
        x2d, x3d = self.between(x2d, x3d, mask3d), self.between(x3d, x2d, mask2d)
        return self.feed(x2d), self.feed(x3d)


class Neighbourhood(nn.Module):
    """What lies around each point: the largest response, by channel, to the offsets of its nearest neighbours.

    The offsets are in units of the set's mean distance to the neighbours, so that a denser sample of the same shape
    looks alike. A point without a neighbour gets zeros.
    """

    def __init__(self, coordinates: int, channels: int, *, neighbours: int) -> None:
        super().__init__()
        self.neighbours = neighbours
        self.enter = nn.Linear(coordinates + 1, channels)
        self.out = nn.Linear(channels, channels)

    def forward(self, points: Float[Tensor, "b k d"], mask: Bool[Tensor, "b k"]) -> Float[Tensor, "b k c"]:
        k = min(self.neighbours, points.shape[1] - 1)
        if k < 1:
            return points.new_zeros(*points.shape[:2], self.out.out_features)
        far = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
        far = far.masked_fill(~mask.unsqueeze(1), torch.inf)
        far.diagonal(dim1=1, dim2=2).fill_(torch.inf)
        distance, index = far.topk(k, largest=False)
        real = distance.isfinite() & mask.unsqueeze(-1)
        distance = torch.where(real, distance, 0)
        unit = distance.sum((1, 2), keepdim=True) / real.sum((1, 2), keepdim=True).clamp_min(1)
        unit = torch.where(unit > 0, unit, 1)
        around = points.gather(1, index.flatten(1).unsqueeze(-1).expand(-1, -1, points.shape[-1]))
        offset = around.unflatten(1, index.shape[1:]) - points.unsqueeze(2)
        edges = torch.cat([offset, distance.unsqueeze(-1)], -1) / unit.unsqueeze(-1)
        response = torch.relu(self.enter(edges)).masked_fill(~real.unsqueeze(-1), 0).amax(2)
        return self.out(response)
