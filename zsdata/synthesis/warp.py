"""Forward warp: the right view of a rectified pair, and what it cannot see.

The geometry, exactly. A left pixel x with disparity d lands at x' = x - d and covers [x' - 1/2, x' + 1/2]. Two neighbours whose
disparities differ by at most 1 px are one surface, which also covers all that lies between them; across a larger step the surface is
torn. Right pixel u shows the nearest surface that covers its centre, at the very point of the surface that lands on u; where nothing
covers it, u is a hole.

Two facts make this one scatter per row. Among the sources that land on one u, the one with the larger x is the nearer, because
d = x - u; so the z-buffer is `amax` of the source's position. And with d = n + f (n whole, 0 <= f < 1; both exact in floating point) the
first column at or right of x' is x - n, so that every comparison is between disparities, never between rounded positions.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

CACHED_PX = 65_536  # warped at once on the CPU: what is between the steps stays in its cache, at half the time of the whole photo
LARGEST_STEP_PX = 1.0  # neighbours whose disparities differ by more are two surfaces


class Warped(NamedTuple):
    """What `forward_warp` returns; H and W are those of the left image.

    Attributes:
        right: [B, C, H, W], dtype of `left`: the right view, 0 in its holes.
        inpaint_mask: bool [B, 1, H, W], right frame: True where no left pixel lands (a hole).
        nonocclusion_mask: bool [B, 1, H, W], left frame: True where the right camera sees this point.
        right_disparity: float32 [B, 1, H, W], right frame, pixels: right (u, y) is left (u + d, y); 0 in holes.
    """

    right: Tensor
    inpaint_mask: Tensor
    nonocclusion_mask: Tensor
    right_disparity: Tensor


def forward_warp(left: Tensor, disparity: Tensor) -> Warped:
    """Moves each pixel of `left` by its disparity; the nearest one wins (paper, section "Overview": the warped image and both masks).

    Colours are resampled along the row by cubic convolution (Catmull-Rom) at the point of the surface that lands on the pixel's centre,
    with taps from that surface alone, so that nothing bleeds across a depth edge. Every pixel of the result depends on its own row only,
    and no sum depends on the batch: a sample's result is the same bit for bit in any batch. Differentiable in `left`; not in `disparity`.

    Args:
        left: float [B, C, H, W]; RGB 0..255 in the stream, any C and range here (the result is kept within the range of each image).
        disparity: float [B, 1, H, W], pixels, left frame, >= 0. Zero leaves the photo as it is. A non-finite value covers nothing.

    Raises:
        ValueError: for shapes that do not fit each other.
    """
    if left.ndim != 4 or disparity.ndim != 4 or disparity.shape != (left.shape[0], 1, *left.shape[2:]):
        raise ValueError(
            f"it takes left [B, C, H, W] and disparity [B, 1, H, W] of one size, got {list(left.shape)} and {list(disparity.shape)}"
        )
    batch, _, height, width = left.shape
    rows = height if left.device.type != "cpu" else max(1, CACHED_PX // max(1, batch * width))
    limits = left.amin((1, 2, 3), keepdim=True), left.amax((1, 2, 3), keepdim=True)  # cubic convolution overshoots
    bands = zip(left.split(rows, 2), disparity.detach().float().split(rows, 2), strict=True)
    return Warped(*(torch.cat(parts, 2) for parts in zip(*(_warp_band(*band, limits) for band in bands), strict=True)))


def _warp_band(left: Tensor, disparity: Tensor, limits: tuple[Tensor, Tensor]) -> Warped:
    """Some rows of the photo, kept within the range of the whole; no row depends on another."""
    batch, _, height, width = left.shape
    rows = disparity.reshape(batch * height, width)

    joined = (rows[:, 1:] - rows[:, :-1]).abs() <= LARGEST_STEP_PX
    winner = _nearest_source(rows, joined)
    hole = winner < 0

    # The surface point that lands on u: source pixel `first`, or between it and its right neighbour, `share` of the way.
    flat = rows.reshape(-1)
    column = torch.arange(width, device=rows.device, dtype=torch.int32)
    source = (winner.clamp(min=0) >> 1).long()
    between = (winner & 1).masked_fill_(hole, 0).to(flat.dtype)
    start = torch.arange(0, batch * height * width, width, device=rows.device).unsqueeze(1)
    first = (source + start).reshape(-1)
    second = first + between.reshape(-1).long()
    near_first = flat.index_select(0, first).reshape(rows.shape)
    near_second = flat.index_select(0, second).reshape(rows.shape)
    gap = (near_first + (column - source)) * between  # u - x' of the first pixel
    share = gap / (1 + near_first - near_second).clamp_(min=torch.finfo(gap.dtype).tiny)
    right_disparity = torch.lerp(near_first, near_second, share).masked_fill_(hole, 0)

    right = torch.minimum(torch.maximum(_resample_rows(left, first, second, share, joined), limits[0]), limits[1])
    right = right.masked_fill_(hole.reshape(batch, 1, height, width), 0)
    seen = _wins_where_it_lands(rows, right_disparity, hole)
    shape = (batch, 1, height, width)
    return Warped(right, hole.reshape(shape), seen.reshape(shape), right_disparity.reshape(shape))


def _nearest_source(rows: Tensor, joined: Tensor) -> Tensor:
    """The z-buffer: int32 [N, W], for each right pixel -1 (hole), 2 i (left pixel i alone) or 2 i + 1 (between pixels i and i + 1)."""
    count, width = rows.shape
    whole = rows.floor()
    fraction = rows - whole
    pixel = torch.arange(width, device=rows.device, dtype=torch.int32)
    ceiling = pixel - whole.to(torch.int32)  # the first column at or right of x'

    torn_right = torch.ones_like(rows, dtype=torch.bool)
    torn_right[:, :-1] = ~joined
    torn_left = torch.ones_like(torn_right)
    torn_left[:, 1:] = ~joined
    following = torch.empty_like(rows)  # the right neighbour's disparity
    following[:, :-1] = rows[:, 1:]
    following[:, -1] = torch.inf

    # A pair of joined neighbours covers the columns of [x'(i), x'(i + 1)), two at most; a torn surface goes on for half a pixel.
    pair = ~torn_right
    covers_ceiling = (pair & (following < whole + 1)) | (torn_right & (fraction <= 0.5))
    covers_next = pair & (following < whole)
    covers_floor = torn_left & (fraction >= 0.5)

    key = 2 * pixel + pair
    spare = width  # where what covers nothing is sent
    buffer = torch.full((count, width + 1), -1, device=rows.device, dtype=torch.int32)
    for covers, target, value in (
        (covers_ceiling, ceiling, key),
        (covers_next, ceiling + 1, key),
        (covers_floor, ceiling - 1, (2 * pixel).expand_as(key)),
    ):
        inside = covers & (target >= 0) & (target < width)
        index = target.masked_fill(~inside, spare).long()
        buffer.scatter_reduce_(1, index, value, "amax")
    return buffer[:, :width]


def _resample_rows(left: Tensor, first: Tensor, second: Tensor, share: Tensor, joined: Tensor) -> Tensor:
    """`left` at `share` of the way from pixel `first` to pixel `second`, by cubic convolution with taps of one surface."""
    batch, channels, height, width = left.shape
    linked = torch.zeros((joined.shape[0], width + 1), device=left.device, dtype=torch.int64)
    linked[:, 1:-1] = joined  # linked[i]: pixels i - 1 and i are one surface; the frame's edges are torn
    has_before = linked[:, :-1].reshape(-1).index_select(0, first)
    has_after = linked[:, 1:].reshape(-1).index_select(0, second)
    before, after = first - has_before, second + has_after
    ends_before = (1 - has_before).to(left.dtype).reshape(batch, height, width)
    ends_after = (1 - has_after).to(left.dtype).reshape(batch, height, width)

    t = share.reshape(batch, height, width)
    planes = []
    for channel in range(channels):
        plane = left[:, channel].reshape(-1)
        here, there, back, on = (plane.index_select(0, tap).reshape(t.shape) for tap in (first, second, before, after))
        step = there - here
        back, on = back - ends_before * step, on + ends_after * step  # past the end of a surface its colour goes on straight
        curve = 2 * back - 5 * here + 4 * there - on  # Horner's form: equal colours give exactly that colour
        planes.append(here + 0.5 * t * (there - back + t * (curve + t * (3 * (here - there) + on - back))))
    return torch.stack(planes, 1)


def _wins_where_it_lands(rows: Tensor, right_disparity: Tensor, hole: Tensor) -> Tensor:
    """bool [N, W]: True where round(x') lies in the image and the surface seen there is the pixel's own (disparity within 1 px)."""
    count, width = rows.shape
    whole = rows.floor()
    fraction = rows - whole
    column = torch.arange(width, device=rows.device, dtype=torch.int32) - whole.to(torch.int32)
    tie_to_odd = (fraction == 0.5) & (column % 2 == 1)  # round half to even, as torch.round does
    landing = column - ((fraction > 0.5) | tie_to_odd).to(torch.int32)
    inside = (landing >= 0) & (landing < width)
    start = torch.arange(0, count * width, width, device=rows.device).unsqueeze(1)
    index = (landing.clamp(0, width - 1).long() + start).reshape(-1)
    there = right_disparity.reshape(-1).index_select(0, index).reshape(rows.shape)
    covered = ~hole.reshape(-1).index_select(0, index).reshape(rows.shape)
    return inside & covered & ((there - rows).abs() <= LARGEST_STEP_PX)
