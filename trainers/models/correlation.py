"""How well each left pixel matches the right pixels of its row, looked up around the current estimate.

Level l of the pyramid averages 2^l neighbouring right pixels. Both forms give the same numbers: the pyramid computes every correlation
once and keeps H W^2 of them; on-demand keeps none and computes them again for each lookup, a few rows at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.checkpoint import checkpoint

Lookup = Callable[[Tensor], Tensor]

ROWS_AT_ONCE_VALUES = 2**24  # correlations on demand: 64 MiB in float32, enough to keep a GPU busy


def look_up(volumes: Sequence[Tensor], x: Tensor, radius: int) -> Tensor:
    """Correlations around columns x [B, 1, H, W], as `correlation_pyramid` says; volume l is [B, H, W, columns / 2^l]."""
    x = x[:, 0]
    found = [interpolate(volume, x / 2**level, radius) for level, volume in enumerate(volumes)]
    return torch.cat(found, dim=-1).permute(0, 3, 1, 2)


def correlation_pyramid(
    left: Tensor, right: Tensor, levels: int, radius: int, look_up: Callable[[Sequence[Tensor], Tensor, int], Tensor] = look_up
) -> Lookup:
    """Correlates the features [B, C, H, W] of both views.

    Returns:
        A function from columns x [B, 1, H, W] of the right features to correlations [B, levels * (2 radius + 1), H, W]: level by
        level, offset by offset from -radius to radius; 0 beside the image.
    """
    volumes = [correlate_rows(left, right)]
    for _ in range(levels - 1):
        volumes.append(F.avg_pool2d(volumes[-1], (1, 2)))
    return lambda x: look_up(volumes, x, radius)


def correlation_on_demand(left: Tensor, right: Tensor, levels: int, radius: int) -> Lookup:
    """As `correlation_pyramid`, in memory that grows with H W instead of H W^2, in the backward pass too."""
    rows = max(1, ROWS_AT_ONCE_VALUES // (left.shape[0] * left.shape[-1] * right.shape[-1]))

    def look_up_rows(left: Tensor, right: Tensor, x: Tensor) -> Tensor:
        return correlation_pyramid(left, right, levels, radius)(x)

    def look_up_all(x: Tensor) -> Tensor:
        parts = zip(left.split(rows, dim=2), right.split(rows, dim=2), x.split(rows, dim=2), strict=True)
        # Without the checkpoint the backward pass would hold all correlations.
        found = [checkpoint(look_up_rows, *part, use_reentrant=False, preserve_rng_state=False) for part in parts]
        return torch.cat(cast(list[Tensor], found), dim=2)

    return look_up_all


def correlate_rows(left: Tensor, right: Tensor) -> Tensor:
    """Scalar products of each left pixel with all right pixels of its row: [B, C, H, W] and [B, C, H, N] to [B, H, W, N]."""
    return torch.einsum("bchx,bchy->bhxy", left, right) / left.shape[1] ** 0.5


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
