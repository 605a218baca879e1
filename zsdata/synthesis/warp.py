"""Forward warp: the right view of a rectified pair, and what it cannot see.

The geometry, exactly. A left pixel x with disparity d lands at x' = x - d and covers [x' - 1/2, x' + 1/2]. Two neighbours whose
disparities differ by at most 1 px are one surface, which also covers all that lies between them; across a larger step the surface is
torn. Right pixel u shows the nearest surface that covers its centre, at the very point of the surface that lands on u; where nothing
covers it, u is a hole.

Two facts make this one scatter per row. Among the sources that land on one u, the one with the larger x is the nearer, because
d = x - u; so the z-buffer is `amax` of the source's position. And with d = n + f (n whole, 0 <= f < 1; both exact in floating point) the
first column at or right of x' is x - n, so that every comparison is between disparities, never between rounded positions.

Fast, because nearly all of a photo is the inside of surfaces: there a pixel and its right neighbour span what lands between them, with no
case to tell apart. Everything is computed as if it were the inside; the few pixels at tears are done again, as lists.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from zsdata.synthesis.indices import flat_indices

CACHED_PX = 65_536  # warped at once on the CPU: what is between the steps stays in its cache
# Of the cubic that resamples colours. At 1/2 it is Catmull-Rom's; at 1 a shift by half a pixel leaves the right view as sharp as the left
# (0.92 of its gradient energy against 0.72), so that blur does not tell the fraction of a disparity. See benchmarks/reprojection.py.
SHARPNESS = 1.0
LARGEST_STEP_PX = 1.0  # neighbours whose disparities differ by more are two surfaces
PAD = 4  # zeros before and after the pixels of a plane: a hole reads the first ones
FAR_AWAY_PX = 1e9  # the disparity of a hole where it is compared with a pixel's own


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

    Colours are resampled along the row by a cubic (see SHARPNESS) at the point of the surface that lands on the pixel's centre, with taps
    from that surface alone, so that nothing bleeds across a depth edge. Every pixel of the result depends on its own row only,
    and no sum depends on the batch: a sample's result is the same bit for bit in any batch. Differentiable in `left`; not in `disparity`.

    Args:
        left: float [B, C, H, W]; RGB 0..255 in the stream, any C and range here (the result is kept within the range of each image).
        disparity: float [B, 1, H, W], pixels, left frame, >= 0. Zero leaves the photo as it is. A non-finite value covers nothing.

    Raises:
        ValueError: for shapes that do not fit each other, and for a negative disparity.
    """
    if left.ndim != 4 or disparity.ndim != 4 or 0 in left.shape or disparity.shape != (left.shape[0], 1, *left.shape[2:]):
        raise ValueError(
            f"it takes left [B, C, H, W] and disparity [B, 1, H, W] of one size, got {list(left.shape)} and {list(disparity.shape)}"
        )
    batch, _, height, width = left.shape
    disparity, largest = _within_reach(disparity.detach().float(), width)
    limits = [[float(limit) for limit in image.detach().aminmax()] for image in left]  # cubic convolution overshoots

    rows = height if left.device.type != "cpu" else min(height, max(1, CACHED_PX // (batch * width)))
    grid = _Grid.make(batch * rows, width, margin=int(largest) + 2, device=left.device)
    right = torch.empty_like(left)
    hole, seen = (torch.empty(disparity.shape, dtype=torch.bool, device=left.device) for _ in range(2))
    right_disparity = torch.empty_like(disparity)
    for top in range(0, height, rows):
        band = slice(top, top + rows)
        shape = disparity[:, 0, band].shape
        plane = _padded(disparity[:, 0, band])
        torn = _torn(plane, grid)
        spans = _spans(plane, _nearest(plane, torn, grid), grid)
        covered = spans.covered.to(left.dtype)
        for channel, colour in enumerate(_colours(left[:, :, band], spans, torn)):
            for image, limit in enumerate(limits):
                colour.view(shape)[image].clamp_(*limit)
            right[:, channel, band] = colour.mul_(covered).view(shape)
        right_disparity[:, 0, band] = spans.disparity.view(shape)
        hole[:, 0, band] = (1 - spans.covered).bool().view(shape)
        seen[:, 0, band] = _wins_where_it_lands(plane, spans, grid).view(shape)
    return Warped(right, hole, seen, right_disparity)


def _within_reach(disparity: Tensor, width: int) -> tuple[Tensor, float]:
    """The disparity with all that lands outside of the frame on its left just there, and the largest value."""
    if not disparity.numel():
        return disparity, 0.0
    outside = width + 2.0
    least, largest = (float(limit) for limit in disparity.aminmax())
    if not (least >= 0 and largest <= outside):
        disparity = disparity.nan_to_num(outside, outside, outside).clamp(max=outside)
        least, largest = (float(limit) for limit in disparity.aminmax())
        if least < 0:
            raise ValueError(f"disparity is positive: left (x, y) is right (x - d, y); got {least:g} px")
    return disparity, largest


class _Grid(NamedTuple):
    """Numbers of a band's pixels, row by row; int32 [N].

    Attributes:
        column: of each pixel.
        place: of each pixel in a padded plane, less one, so that a hole's 0 and its neighbours read zeros.
        target: its own column, in rows that have `margin` columns more on the left, where what leaves the frame lands.
    """

    width: int
    margin: int
    column: Tensor
    place: Tensor
    target: Tensor

    @staticmethod
    def make(rows: int, width: int, margin: int, device: torch.device) -> _Grid:
        column = torch.arange(width, device=device, dtype=torch.int32).repeat(rows)
        place = torch.arange(PAD - 1, PAD - 1 + rows * width, device=device, dtype=torch.int32)
        target = torch.arange(rows * (margin + width), device=device, dtype=torch.int32).view(rows, -1)[:, margin:].reshape(-1)
        return _Grid(width, margin, column, place, target)


def _padded(band: Tensor) -> Tensor:
    """Its pixels row by row, between PAD zeros."""
    plane = band.new_zeros(band.numel() + 2 * PAD)
    plane[PAD:-PAD].view(band.shape).copy_(band)
    return plane


def _torn(plane: Tensor, grid: _Grid) -> Tensor:
    """Indices of the pixels whose right neighbour belongs to another surface; the last column's always does."""
    torn = (plane[PAD + 1 : -PAD + 1] - plane[PAD:-PAD]).abs_() > LARGEST_STEP_PX
    torn.view(-1, grid.width)[:, -1] = True
    return flat_indices(torn)


def _nearest(plane: Tensor, torn: Tensor, grid: _Grid) -> Tensor:
    """The z-buffer: int32 [N], right frame: 2 * place of the winning pixel, + 1 where it wins alone, not as a span; 0 in holes.

    A span is a pixel and its right neighbour on one surface: it covers the columns of [x'(i), x'(i + 1)), two at most. At the ends of a
    surface a pixel covers half a pixel more.
    """
    disparity, following = plane[PAD:-PAD], plane[PAD + 1 : -PAD + 1]
    count = len(disparity)
    rows = count // grid.width
    whole = disparity.floor()
    column = grid.target[:count] - whole.int()  # the first column at or right of x'

    key = grid.place[:count] << 1
    span = key * (whole + 1).gt_(following).int()
    span[torn] = (key[torn] + 1) * (disparity[torn] - whole[torn] <= 0.5)
    buffer = torch.zeros(rows * (grid.width + grid.margin), dtype=torch.int32, device=plane.device)
    buffer.scatter_reduce_(0, column.long(), span, "amax")

    covers_next = following < whole
    covers_next[torn] = False
    wide = flat_indices(covers_next)
    buffer.scatter_reduce_(0, column[wide].long() + 1, key[wide], "amax")

    first = torch.cat([torn.new_zeros(1), torn[:-1] + 1])  # pixels of the surfaces
    first = first[disparity[first] - whole[first] >= 0.5]
    buffer.scatter_reduce_(0, column[first].long() - 1, key[first] + 1, "amax")
    return buffer.view(rows, -1)[:, grid.margin :].reshape(-1)


class _Spans(NamedTuple):
    """For each right pixel the span that it shows, and where in it. Flat [N].

    Attributes:
        first: int64, place of the span's first pixel; 0 in holes.
        share: float32, 0 at the first pixel, 1 at the second one.
        covered: float32, 0 in holes, 1 elsewhere.
        disparity: float32, px; 0 in holes.
    """

    first: Tensor
    share: Tensor
    covered: Tensor
    disparity: Tensor


def _spans(plane: Tensor, nearest: Tensor, grid: _Grid) -> _Spans:
    """The point of the nearest surface that lands on each right pixel's centre."""
    first = nearest >> 1
    alone = flat_indices((nearest & 1).bool())
    covered = first.clamp(max=1).float()
    behind = (grid.place[: len(nearest)] - first).float()  # u - i
    first = first.long()
    here, there = (plane[tap:].index_select(0, first) for tap in (1, 2))
    there[alone] = here[alone]
    share = behind.add_(here).div_((here - there).add_(1))  # u - x'(i), over x'(i + 1) - x'(i)
    share[alone] = 0
    return _Spans(first, share, covered, torch.lerp(here, there, share))


def _colours(left: Tensor, spans: _Spans, torn: Tensor) -> Iterator[Tensor]:
    """`left` [B, C, rows, W] at the spans' points; [N] for each channel, anything in holes.

    With t the share and p'' the second difference p(i - 1) - 2 p(i) + p(i + 1):
    lerp(p(i), p(i + 1), t) - SHARPNESS t (1 - t) lerp(p''(i), p''(i + 1), t).
    Where a surface ends p'' is zero: there its colour goes on straight, and nothing of the other side comes in.
    """
    inside = left.new_ones(spans.first.numel() + 2 * PAD - 2)
    inside[:PAD] = 0
    inside[-PAD + 1 :] = 0
    inside[torn + (PAD - 1)] = 0
    inside[torn + PAD] = 0
    share = spans.share.to(left.dtype)
    bend = SHARPNESS * share * (share - 1)

    def between(plane: Tensor) -> Tensor:
        return torch.lerp(plane.index_select(0, spans.first), plane[1:].index_select(0, spans.first), share)

    for channel in range(left.shape[1]):
        plane = _padded(left[:, channel])
        second = (plane[:-2] + plane[2:]).sub_(plane[1:-1], alpha=2).mul_(inside)
        yield between(plane[1:]).addcmul_(bend, between(second))


def _wins_where_it_lands(plane: Tensor, spans: _Spans, grid: _Grid) -> Tensor:
    """bool [N]: True where round(x') lies in the image and the surface seen there is the pixel's own (disparity within 1 px)."""
    disparity = plane[PAD:-PAD]
    count = len(disparity)
    rows = count // grid.width
    ahead = disparity - 0.5
    whole = ahead.ceil()
    steps = whole.int()  # x - steps is the column nearest to x'; of two at one distance the right one,
    half_way = ahead.eq_(whole).int()
    steps += half_way & (grid.column[:count] - steps)  # unless it is odd: torch.round takes the even one
    landing = grid.target[:count] - steps

    shown = torch.full((rows, grid.width + grid.margin), FAR_AWAY_PX, dtype=disparity.dtype, device=disparity.device)
    shown[:, grid.margin :] = torch.add(spans.disparity, 1 - spans.covered, alpha=FAR_AWAY_PX).view(rows, -1)
    there = shown.view(-1).index_select(0, landing.long())
    return (there - disparity).abs_() <= LARGEST_STEP_PX
