"""How well each left pixel matches the right pixels of its row, looked up around the current estimate.

Level l of the pyramid averages 2^l neighbouring right pixels. Both forms give the same numbers: the pyramid computes every correlation
once and keeps H W^2 of them, on-demand keeps none and computes the few that a lookup asks for, each time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.checkpoint import checkpoint

Lookup = Callable[[Tensor], Tensor]


def correlation_pyramid(left: Tensor, right: Tensor, levels: int, radius: int) -> Lookup:
    """Correlates the features [B, C, H, W] of both views.

    Returns:
        A function from columns x [B, 1, H, W] of the right features to correlations [B, levels * (2 radius + 1), H, W]: level by
        level, offset by offset from -radius to radius; 0 beside the image.
    """
    volume = torch.einsum("bchx,bchy->bhxy", left, right) / left.shape[1] ** 0.5
    pyramid = [volume]
    for _ in range(levels - 1):
        pyramid.append(F.avg_pool2d(pyramid[-1], (1, 2)))

    def lookup(x: Tensor) -> Tensor:
        x = x[:, 0]
        found = [interpolate(level, x / 2**i, radius) for i, level in enumerate(pyramid)]
        return torch.cat(found, dim=-1).permute(0, 3, 1, 2)

    return lookup


def correlation_on_demand(left: Tensor, right: Tensor, levels: int, radius: int) -> Lookup:
    """As `correlation_pyramid`, in memory that grows with H W instead of H W^2, in the backward pass too."""
    pyramid = [right]
    for _ in range(levels - 1):
        pyramid.append(F.avg_pool2d(pyramid[-1], (1, 2)))

    def correlate(x: Tensor) -> Tensor:
        found = []
        for i, features in enumerate(pyramid):
            columns, weight = neighbours((x / 2**i)[:, 0], radius)
            width = features.shape[-1]
            dots = []
            for column in columns.unbind(-1):
                index = column.clamp(0, width - 1)[:, None].expand_as(left)
                dot = (left * features.gather(3, index)).sum(1) / left.shape[1] ** 0.5
                dots.append(torch.where((column >= 0) & (column < width), dot, 0.0))
            values = torch.stack(dots, dim=1)
            found.append(torch.lerp(values[:, :-1], values[:, 1:], weight[:, None]))
        return torch.cat(found, dim=1)

    def lookup(x: Tensor) -> Tensor:
        # Without the checkpoint the backward pass would hold the gathered features of every offset, far more than the volume.
        return cast(Tensor, checkpoint(correlate, x, use_reentrant=False, preserve_rng_state=False))

    return lookup


def interpolate(volume: Tensor, x: Tensor, radius: int) -> Tensor:
    """Values of each row of `volume` [..., N] at x - radius, ..., x + radius, linear in between and 0 beside it.

    x is [...], or has axes of 1 where rows share it.
    """
    columns, weight = neighbours(x, radius)
    size = volume.shape[-1]
    values = volume.gather(-1, columns.clamp(0, size - 1).expand(*volume.shape[:-1], -1))
    values = torch.where((columns >= 0) & (columns < size), values, 0.0)
    return torch.lerp(values[..., :-1], values[..., 1:], weight[..., None])


def neighbours(x: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """The 2 radius + 2 whole columns [..., 2 radius + 2] around x [...], and the weight [...] of each one's right neighbour."""
    before = x.floor()
    offsets = torch.arange(-radius, radius + 2, device=x.device)
    return before.long()[..., None] + offsets, x - before
