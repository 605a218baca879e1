"""What the geometry encoding volume and the plain correlation of all pairs say around the current disparity."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from trainers.models.correlation import Lookup, interpolate


def look_up(pyramid: Sequence[tuple[Tensor, Tensor]], disparity: Tensor, radius: int) -> Tensor:
    """Both kinds of values around disparities [B, 1, H, W], as `geometry_encoding` says.

    Level l of the pyramid is [B, H, W, C, D / 2^l] of the volume and [B, H, W, 1, W / 2^l] of the correlation.
    """
    disparity = disparity[:, 0, :, :, None]  # [B, H, W, 1], shared by the channels
    columns = torch.arange(disparity.shape[2], device=disparity.device, dtype=disparity.dtype)[:, None]
    found = []
    for level, (geometry, correlation) in enumerate(pyramid):
        found.append(interpolate(geometry, disparity / 2**level, radius))
        found.append(interpolate(correlation, (columns - disparity) / 2**level, radius))
    return torch.cat([values.flatten(3) for values in found], dim=-1).permute(0, 3, 1, 2).contiguous()


def geometry_encoding(
    volume: Tensor,
    left: Tensor,
    right: Tensor,
    levels: int,
    radius: int,
    look_up: Callable[[Sequence[tuple[Tensor, Tensor]], Tensor, int], Tensor] = look_up,
) -> Lookup:
    """Combines two pyramids: level l averages 2^l neighbouring disparities of the volume, and 2^l right columns of the correlation.

    Args:
        volume: geometry encoding [B, C, D, H, W] of the disparities 0, ..., D - 1.
        left, right: features [B, F, H, W], correlated by their scalar product.
        levels, radius: of the pyramid, and how far a lookup sees to each side.
    Returns:
        A function from disparities [B, 1, H, W] to [B, levels * (C + 1) * (2 radius + 1), H, W]: at each level the channels of the
        volume, then the correlation, each offset by offset from -radius to radius (of the disparity for the volume, of the right
        column for the correlation); 0 beyond their ends.
    """
    geometry = volume.permute(0, 3, 4, 1, 2).contiguous()
    correlation = torch.einsum("bchx,bchy->bhxy", left, right)[..., None, :]
    pyramid = [(geometry, correlation)]
    for _ in range(levels - 1):
        geometry, correlation = halve_last(geometry), halve_last(correlation)
        pyramid.append((geometry, correlation))
    return lambda disparity: look_up(pyramid, disparity, radius)


def halve_last(x: Tensor) -> Tensor:
    """[B, H, W, C, N] to [B, H, W, C, N // 2]: means of two neighbours, an odd last one dropped."""
    return F.avg_pool1d(x.flatten(0, 2), 2).unflatten(0, x.shape[:3])
