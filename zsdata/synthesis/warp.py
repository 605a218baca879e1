"""Forward warp: the right view of a rectified pair, and what it cannot see.

The geometry, exactly. A left pixel x with disparity d lands at x' = x - d and covers [x' - 1/2, x' + 1/2]. Two neighbours whose
disparities differ by at most 1 px are one surface, which also covers all that lies between them; across a larger step the surface is
torn. Right pixel u shows the nearest surface that covers its centre, at the very point of the surface that lands on u; where nothing
covers it, u is a hole.

Two facts make this one scatter per row. Among the sources that land on one u, the one with the larger x is the nearer, because
d = x - u; so the z-buffer is `amax` of the source's position. And with d = n + f (n whole, 0 <= f < 1; both exact in floating point) the
first column at or right of x' is x - n, so that every comparison is between disparities, never between rounded positions.

Fast, because nearly every pixel, with its right neighbour, covers just the first column at or right of x'. What that column would show is
computed for every left pixel, without a look-up; then each right pixel takes it from its winner. The few that are covered otherwise, at the
ends of surfaces and where they stretch, are done again as a list.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from zsdata.synthesis.indices import flat_indices

CACHED_PX = 65_536  # warped at once on the CPU: what is between the steps stays in its cache
# Of the cubic that resamples colours. At 1/2 it is Catmull-Rom's; at 1 a shift by half a pixel leaves the right view as sharp as the left
# (0.92 of its gradient energy against 0.72), so that blur does not tell the fraction of a disparity. See benchmarks/reprojection.py.
SHARPNESS = 1.0
LARGEST_STEP_PX = 1.0  # neighbours whose disparities differ by more are two surfaces
SMALLEST_STRETCH = 1e-6  # px of the right view that a left pixel is stretched to; less is hidden by its neighbour
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
        surface = _surface(disparity[:, 0, band])
        shown = _shown(surface, grid)
        covered = shown.covered.to(left.dtype)
        for channel, colour in enumerate(_colours(left[:, :, band], surface, shown)):
            for image, limit in enumerate(limits):
                colour.view(shape)[image].clamp_(*limit)
            right[:, channel, band] = colour.mul_(covered).view(shape)
        right_disparity[:, 0, band] = shown.disparity.view(shape)
        hole[:, 0, band] = (1 - shown.covered).bool().view(shape)
        seen[:, 0, band] = _wins_where_it_lands(surface, shown, grid).view(shape)
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
        place: of each pixel, from 0 on.
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
        place = torch.arange(rows * width, device=device, dtype=torch.int32)
        target = torch.arange(rows * (margin + width), device=device, dtype=torch.int32).view(rows, -1)[:, margin:].reshape(-1)
        return _Grid(width, margin, column, place, target)


class _Surface(NamedTuple):
    """The surfaces that a band's pixels lie on. Flat [N], row by row.

    Attributes:
        disparity: float32, px.
        following: float32, px, the right neighbour's disparity; the last column's is anything.
        whole: float32, the disparity rounded down: x - whole is the first column at or right of x'.
        torn: int64, indices of the pixels whose right neighbour lies on another surface; the last column's always does.
        share: float32, how far from the pixel (0) to its right neighbour (1) the point lies that lands on column x - whole.
    """

    disparity: Tensor
    following: Tensor
    whole: Tensor
    torn: Tensor
    share: Tensor


def _surface(band: Tensor) -> _Surface:
    padded = F.pad(band.reshape(-1), (0, 1))
    disparity, following = padded[:-1], padded[1:]
    torn = (following - disparity).abs_() > LARGEST_STEP_PX
    torn.view(-1, band.shape[-1])[:, -1] = True
    torn = flat_indices(torn)
    whole = disparity.floor()
    share = _share_at(disparity - whole, disparity, following)
    share[torn] = 0
    return _Surface(disparity, following, whole, torn, share)


def _share_at(distance: Tensor, disparity: Tensor, following: Tensor) -> Tensor:
    """How far from the pixel to its right neighbour the point lies that lands `distance` px right of x'; 0 if that is negative."""
    stretch = (disparity - following).add_(1).clamp_(min=SMALLEST_STRETCH)  # x'(i + 1) - x'(i)
    return (distance / stretch).clamp_(0, 1)


class _Shown(NamedTuple):
    """What each right pixel shows. Flat [N].

    Attributes:
        source: int64, index of the left pixel whose point it is, or which that point lies right of; anything in holes.
        covered: float32, 0 in holes, 1 elsewhere.
        disparity: float32, px; 0 in holes.
        special: int64, indices of the right pixels that are not at column x - whole of their source.
        special_share: float32, of these, how far from the source to its right neighbour the point lies.
    """

    source: Tensor
    covered: Tensor
    disparity: Tensor
    special: Tensor
    special_share: Tensor


def _shown(surface: _Surface, grid: _Grid) -> _Shown:
    nearest = _nearest(surface, grid)
    special = flat_indices((nearest & 1).bool())
    covered = nearest.clamp(max=1).float()
    place = ((nearest >> 1) - 1).clamp_(min=0)
    source = place.long()

    there = source[special]
    disparity, following = surface.disparity[there], surface.following[there]
    distance = (grid.place[special] - place[special]).float() + disparity  # u - x'
    special_share = _share_at(distance, disparity, following)

    right_disparity = torch.lerp(surface.disparity, surface.following, surface.share).index_select(0, source)
    right_disparity[special] = torch.lerp(disparity, following, special_share)
    return _Shown(source, covered, right_disparity.mul_(covered), special, special_share)


def _nearest(surface: _Surface, grid: _Grid) -> Tensor:
    """The z-buffer: int32 [N], right frame: 2 * (place of the winning pixel + 1), + 1 where it is not at its column x - whole; 0 in holes.

    A pixel and its right neighbour on the same surface cover the columns of [x'(i), x'(i + 1)), two at most. At the ends of a surface a
    pixel covers half a pixel more.
    """
    disparity, following, whole, torn, _ = surface
    count = len(disparity)
    rows = count // grid.width
    column = grid.target[:count] - whole.int()
    key = (grid.place[:count] + 1) << 1

    covers = (whole + 1).gt_(following)
    covers[torn] = (disparity[torn] - whole[torn]).le_(0.5)
    buffer = torch.zeros(rows * (grid.width + grid.margin), dtype=torch.int32, device=disparity.device)
    buffer.scatter_reduce_(0, column.long(), key * covers.int(), "amax")

    covers_next = following < whole
    covers_next[torn] = False
    wide = flat_indices(covers_next)
    buffer.scatter_reduce_(0, column[wide].long() + 1, key[wide] + 1, "amax")

    first = torch.cat([torn.new_zeros(1), torn[:-1] + 1])  # pixels of the surfaces
    first = first[disparity[first] - whole[first] >= 0.5]
    buffer.scatter_reduce_(0, column[first].long() - 1, key[first] + 1, "amax")
    return buffer.view(rows, -1)[:, grid.margin :].reshape(-1)


def _colours(left: Tensor, surface: _Surface, shown: _Shown) -> Iterator[Tensor]:
    """`left` [B, C, rows, W] at the points that are shown; [N] for each channel, anything in holes.

    With t the share and p'' the second difference p(i - 1) - 2 p(i) + p(i + 1):
    lerp(p(i), p(i + 1), t) - SHARPNESS t (1 - t) lerp(p''(i), p''(i + 1), t).
    Where a surface ends p'' is zero: there its colour goes on straight, and nothing of the other side comes in.
    """
    inside = left.new_ones(len(shown.source) + 1)
    inside[0] = 0
    inside[surface.torn] = 0
    inside[surface.torn + 1] = 0
    curve, special_curve = (_Cubic.at(share.to(left.dtype)) for share in (surface.share, shown.special_share))
    there = shown.source[shown.special]
    for channel in range(left.shape[1]):
        padded = F.pad(left[:, channel].reshape(-1), (1, 2))
        second = (padded[:-2] + padded[2:]).sub_(padded[1:-1], alpha=2).mul_(inside)
        here, following = padded[1:-2], padded[2:-1]
        taps = here, following, second[:-1], second[1:]
        colour = curve(*taps).index_select(0, shown.source)
        yield colour.index_copy_(0, shown.special, special_curve(*(values.index_select(0, there) for values in taps)))


class _Cubic(NamedTuple):
    """The cubic of `_colours` at given shares."""

    share: Tensor
    bend: Tensor

    @staticmethod
    def at(share: Tensor) -> _Cubic:
        return _Cubic(share, (share - 1).mul_(share).mul_(SHARPNESS))

    def __call__(self, here: Tensor, following: Tensor, second_here: Tensor, second_following: Tensor) -> Tensor:
        second = torch.lerp(second_here, second_following, self.share)
        return torch.lerp(here, following, self.share).addcmul_(self.bend, second)


def _wins_where_it_lands(surface: _Surface, shown: _Shown, grid: _Grid) -> Tensor:
    """bool [N]: True where round(x') lies in the image and the surface seen there is the pixel's own (disparity within 1 px)."""
    disparity = surface.disparity
    count = len(disparity)
    rows = count // grid.width
    ahead = disparity - 0.5
    whole = ahead.ceil()
    steps = whole.int()  # x - steps is the column nearest to x'; of two at one distance the right one,
    half_way = ahead.eq_(whole).int()
    steps += half_way & (grid.column[:count] - steps)  # unless it is odd: torch.round takes the even one
    landing = grid.target[:count] - steps

    seen = torch.full((rows, grid.width + grid.margin), FAR_AWAY_PX, dtype=disparity.dtype, device=disparity.device)
    seen[:, grid.margin :] = torch.add(shown.disparity, 1 - shown.covered, alpha=FAR_AWAY_PX).view(rows, -1)
    there = seen.view(-1).index_select(0, landing.long())
    return (there - disparity).abs_() <= LARGEST_STEP_PX
