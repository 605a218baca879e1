"""Forward warp: the right view of a rectified pair, and what it cannot see.

The geometry, exactly. A left pixel x with disparity d lands at x' = x - d and covers [x' - 1/2, x' + 1/2]. Two neighbours whose
disparities differ by at most 1 px are one surface, which also covers all that lies between them; across a larger step the surface is
torn. Right pixel u shows the nearest surface that covers its centre, at the very point of the surface that lands on u; where nothing
covers it, u is a hole.

Two facts make this one scatter per row. Among the sources that land on one u, the one with the larger x is the nearer, because
d = x - u; so the z-buffer is `amax` of the source's position. And with d = n + f (n whole, 0 <= f < 1; both exact in floating point) the
first column at or right of x' is x - n, so that every comparison is between disparities, never between rounded positions.

Fast, because nearly every pixel, with its right neighbour, covers just the first column at or right of x'. What that column would show is
computed for every left pixel, without a look-up; then each right pixel takes it from its winner. The few that are covered otherwise, where
surfaces begin and where they are stretched, are computed as a list.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from zsdata.synthesis.indices import flat_indices

CPU_PART_PX = 262_144  # warped at once on the CPU: what is between the steps stays in its cache
PART_PX = 2**28  # elsewhere; pixels are numbered by int32
BYTES_PER_PX = 64  # of what is between the steps
RECYCLED_BYTES = 31 * 2**20  # glibc keeps freed memory for its next use as far as the largest block that was ever freed, 32 MiB at most
ALIGNED_BYTES = 64  # a cache line, on which tensors begin
# Of the cubic that resamples colours. At 1/2 it is Catmull-Rom's; at 1 a shift by half a pixel leaves the right view as sharp as the left
# (0.92 of its gradient energy against 0.72), so that blur does not tell the fraction of a disparity. See benchmarks/reprojection.py.
SHARPNESS = 1.0
LARGEST_STEP_PX = 1.0  # neighbours whose disparities differ by more are two surfaces
TIE_PX = 2.0**-26  # less than the distance of any other fraction of a disparity from 1/2
OUTSIDE_PX = 1e9  # the disparity of what lies outside of the image, where it is compared with a pixel's own


class Warped(NamedTuple):
    """What `forward_warp` returns; H is that of the left image, and so is W unless fewer columns are asked for.

    Attributes:
        right: [B, C, H, W], dtype of `left`: the right view, 0 in its holes. Of a uint8 image rounded, half to even.
        inpaint_mask: bool [B, 1, H, W], right frame: True where no left pixel lands (a hole).
        nonocclusion_mask: bool [B, 1, H, W], left frame: True where the right camera sees this point.
        right_disparity: float32 [B, 1, H, W], right frame, pixels: right (u, y) is left (u + d, y); 0 in holes.
    """

    right: Tensor
    inpaint_mask: Tensor
    nonocclusion_mask: Tensor
    right_disparity: Tensor


@torch.no_grad()
def forward_warp(left: Tensor, disparity: Tensor, columns: int | None = None) -> Warped:
    """Moves each pixel of `left` by its disparity; the nearest one wins (paper, section "Overview": the warped image and both masks).

    Colours are resampled along the row by a cubic (see SHARPNESS) at the point of the surface that lands on the pixel's centre, with taps
    from that surface alone, so that nothing bleeds across a depth edge. Every pixel of the result depends on its own row only, and no sum
    depends on the batch: a sample's result is the same bit for bit in any batch. Not differentiable: the results carry no gradient.

    Args:
        left: uint8 or float [B, C, H, W]; any C and, where it is float, any range (the result is kept within the range of each image).
        disparity: float [B, 1, H, W], pixels, left frame, >= 0. Zero leaves the photo as it is. A non-finite value covers nothing.
        columns: of the results, counted from the left; None for all W. What lies beyond them in `left` may land in them.

    Raises:
        ValueError: for shapes that do not fit each other, for a negative disparity, and for columns that `left` does not have.
        TypeError: for an image of whole numbers other than uint8.
    """
    if left.ndim != 4 or disparity.ndim != 4 or 0 in left.shape or disparity.shape != (left.shape[0], 1, *left.shape[2:]):
        raise ValueError(
            f"it takes left [B, C, H, W] and disparity [B, 1, H, W] of one size, got {list(left.shape)} and {list(disparity.shape)}"
        )
    if not (left.is_floating_point() or left.dtype == torch.uint8):
        raise TypeError(f"left is uint8 or a float; got {left.dtype}")
    batch, channels, height, width = left.shape
    columns = width if columns is None else columns
    if not 1 <= columns <= width:
        raise ValueError(f"columns is in 1..{width}, the width of `left`; got {columns}")
    disparity, largest = _within_reach(disparity.float(), width)
    flat = left.flatten(1)
    limits = torch.stack((flat.amin(1), flat.amax(1)), 1).to(_arithmetic(left))  # the cubic overshoots

    part_px, images_at_once = (CPU_PART_PX, 1) if left.device.type == "cpu" else (PART_PX, max(1, min(batch, PART_PX // (height * width))))
    parts_of_image = -(-height * width // part_px)
    rows_at_once = -(-height // parts_of_image)
    grid = _Grid.make(images_at_once * rows_at_once, width, columns, reach=int(largest) + 2, device=left.device)
    memory = _Memory.get(BYTES_PER_PX * grid.count, left.device)
    right = _fresh((channels, batch, height, columns), left.dtype, left.device)
    right_disparity = _fresh((batch, height, columns), torch.float32, left.device)
    hole, seen = (_fresh((batch, height, columns), torch.bool, left.device) for _ in range(2))
    for first in range(0, batch, images_at_once):
        for top in range(0, height, rows_at_once):
            images, rows = part = slice(first, first + images_at_once), slice(top, top + rows_at_once)
            out = Warped(
                right[:, images, rows].flatten(1), hole[part].flatten(0, 1), seen[part].flatten(0, 1), right_disparity[part].flatten()
            )
            memory.used = 0
            _warp_part(left.transpose(0, 1)[:, images, rows].flatten(1), disparity[:, 0][part].flatten(), limits[images], grid, memory, out)
    return Warped(right.transpose(0, 1).contiguous(), hole.unsqueeze(1), seen.unsqueeze(1), right_disparity.unsqueeze(1))


def _fresh(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """A tensor with anything in it.

    On the CPU numpy provides the memory, because it asks for large pages: the first touch of megabytes in small ones takes a third as long
    as the warp.
    """
    if device.type != "cpu":
        return torch.empty(shape, dtype=dtype, device=device)
    size = math.prod(shape) * dtype.itemsize
    block = torch.from_numpy(np.empty(size + ALIGNED_BYTES, np.uint8))
    start = -block.data_ptr() % ALIGNED_BYTES
    return block[start : start + size].view(dtype).view(shape)


class _Memory:
    """One block for all that is between the steps, used again for each part: fresh memory costs more than the arithmetic on it."""

    _kept = threading.local()

    def __init__(self, size: int, device: torch.device) -> None:
        self._size = size
        block = _fresh((-(-size // ALIGNED_BYTES) * ALIGNED_BYTES,), torch.uint8, device)
        self._as = {dtype: block.view(dtype) for dtype in (torch.uint8, torch.bool, torch.int32, torch.int64, torch.float32)}
        self._device = device
        self.used = 0  # bytes; set it back to give back what was taken since

    @classmethod
    def get(cls, size: int, device: torch.device) -> _Memory:
        """At least `size` bytes. On the CPU each thread keeps its block for the next image; elsewhere torch keeps it."""
        if device.type != "cpu":
            return cls(size, device)
        kept = getattr(cls._kept, "memory", None)
        if kept is None or kept._size < size:
            np.empty(RECYCLED_BYTES, np.uint8)  # never touched, and given back at once
            kept = cls._kept.memory = cls(size, device)
        return kept

    def take(self, count: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """[count], with anything in it."""
        start = -(-self.used // ALIGNED_BYTES) * ALIGNED_BYTES
        end = start + count * dtype.itemsize
        if end > self._size or dtype not in self._as:  # images in float64 or in half, or hardly two neighbours on one surface
            return torch.empty(count, dtype=dtype, device=self._device)
        self.used = end
        return self._as[dtype][start // dtype.itemsize : end // dtype.itemsize]


def _within_reach(disparity: Tensor, width: int) -> tuple[Tensor, float]:
    """The disparity with all that lands outside of the frame on its left just there, and the largest value."""
    outside = width + 2.0
    least, largest = _extent(disparity)
    if not (least >= 0 and largest <= outside):
        disparity = disparity.nan_to_num(outside, outside, outside).clamp(max=outside)
        least, largest = _extent(disparity)
        if least < 0:
            raise ValueError(f"disparity is positive: left (x, y) is right (x - d, y); got {least:g} px")
    return disparity, largest


def _extent(values: Tensor) -> list[float]:
    """The least and the largest, with one wait for the device."""
    return torch.stack((values.amin(), values.amax())).tolist()


class _Grid(NamedTuple):
    """Numbers of a part's N pixels, row by row, and of the cells that they land on.

    A row has `stride` cells: `margin` that lie left of the image, those of the wanted columns, and one more if it takes one to make the
    stride even: a cell's number is odd where its column is. What lands right of the wanted columns falls into the next row's margin.

    Attributes:
        count: N.
        place: int32 [N], 1 to N.
        cell: int32 [N], the cell of the pixel's own column.
    """

    count: int
    width: int
    columns: int
    margin: int
    stride: int
    place: Tensor
    cell: Tensor

    @staticmethod
    def make(rows: int, width: int, columns: int, reach: int, device: torch.device) -> _Grid:
        margin = max(reach, width - columns)
        margin += margin % 2
        stride = margin + columns + columns % 2
        row, column = (torch.arange(count, dtype=torch.int32, device=device) for count in (rows, width))
        place = (row * width).unsqueeze(1) + (column + 1)
        cell = (row * stride).unsqueeze(1) + (column + margin)
        return _Grid(rows * width, width, columns, margin, stride, place.flatten(), cell.flatten())

    def first(self, count: int) -> _Grid:
        """The grid of the first `count` pixels."""
        return self if count == self.count else self._replace(count=count, place=self.place[:count], cell=self.cell[:count])

    @property
    def cells(self) -> int:
        """How many there are."""
        return self.count // self.width * self.stride + self.margin

    def wanted(self, cells: Tensor) -> Tensor:
        """Those of the wanted columns, [rows, columns]."""
        return cells[: -self.margin].view(-1, self.stride)[:, self.margin : self.margin + self.columns]


def _warp_part(planes: Tensor, disparity: Tensor, limits: Tensor, grid: _Grid, memory: _Memory, out: Warped) -> None:
    """Warps whole rows.

    Args:
        planes: [C, N], uint8 or float, of one or several images.
        disparity: [N].
        limits: [images, 2], least and largest value of each.
        out: what is filled in: right [C, M], masks [rows, columns], right_disparity [M], for M = rows * columns.
    """
    count = disparity.shape[0]
    grid = grid.first(count)
    surfaces = _surfaces(disparity, grid, memory)
    special = _special(disparity, surfaces, grid)
    nearest = grid.wanted(surfaces.nearest)
    out.inpaint_mask.copy_(nearest).logical_not_()
    source = memory.take(nearest.numel(), torch.int64)
    source.view_as(nearest).copy_(nearest)
    used = memory.used

    shown = memory.take(1 + count + special.share.shape[0])  # as in `_colours`
    shown[:1].zero_()
    torch.lerp(disparity[:-1], disparity[1:], surfaces.share[:-1], out=shown[1:count])
    shown[count] = disparity[-1]
    shown[1 + count :] = special.disparity
    torch.index_select(shown, 0, source, out=out.right_disparity)
    memory.used = used
    for colours, right in zip(_colours(planes, surfaces, special, limits, memory), out.right, strict=True):
        torch.index_select(colours, 0, source, out=right)
    memory.used = used
    out.nonocclusion_mask.copy_(_wins_where_it_lands(disparity, surfaces.landing, out.right_disparity, grid, memory))


class _Surfaces(NamedTuple):
    """The surfaces that N pixels lie on, and where they land.

    Attributes:
        joined: float32 [N + 2], 1 where the pixel and its left neighbour are of one surface, else 0; 0 at N and N + 1.
        share: float32 [N], how far from the pixel (0) to its right neighbour (1) the point lies that lands on the first column at or right
            of x'; 0 where they are two surfaces; above 1 or NaN where that column is not the pixel's to cover.
        landing: int32 [N], the cell of round(x'), half to even.
        nearest: int32, all cells: the z-buffer, the place of the winning pixel, 0 where nothing lands.
        breaks: int64, ascending, from 0 to N: pixels whose left neighbour lies on another surface, or so far off that the column before
            the pixel's first at or right of x' is not the neighbour's.
    """

    joined: Tensor
    share: Tensor
    landing: Tensor
    nearest: Tensor
    breaks: Tensor


def _surfaces(disparity: Tensor, grid: _Grid, memory: _Memory) -> _Surfaces:
    count = grid.count
    share, joined = memory.take(count), memory.take(count + 2)
    landing, nearest = memory.take(count, torch.int32), memory.take(grid.cells, torch.int32)
    used = memory.used
    drop = share  # to the right neighbour
    torch.sub(disparity[:-1], disparity[1:], out=drop[:-1])
    drop.view(-1, grid.width)[:, -1].zero_()
    joined[:1].zero_()
    joined[-1:].zero_()
    same = torch.abs(drop, out=joined[1:-1]).le_(LARGEST_STEP_PX)  # 1 or 0: comparisons of floats in place are the fastest
    same.view(-1, grid.width)[:, -1].zero_()

    # A pixel covers the first column at or right of x' unless its neighbour on the same surface lands at or left of that column, too. The
    # right end of a surface, which reaches half a pixel far, is left to `_special`.
    whole = torch.floor(disparity, out=memory.take(count))
    rise = memory.take(count)
    torch.sub(whole[1:], whole[:-1], out=rise[:-1])
    rise[-1:].zero_()
    rise.mul_(same)
    covers = torch.clamp(rise, -1, 0, out=memory.take(count)).add_(same)
    simple = memory.take(count + 1, torch.bool)
    simple[:1].zero_()
    simple[1:] = covers
    torch.sub(same, rise.clamp_(min=0), out=covers)
    place = memory.take(count, torch.int32).copy_(covers).mul_(grid.place)
    cell = torch.sub(grid.cell, landing.copy_(whole), out=landing)
    nearest.zero_().scatter_reduce_(0, memory.take(count, torch.int64).copy_(cell), place, "amax")

    # The column lies `fraction` right of x'(i) and `1 + whole(i) - disparity(i + 1)` left of x'(i + 1). Their sum is 1 + drop, which
    # would lose its digits where both are small.
    torch.sub(whole[:-1], disparity[1:], out=drop[:-1])
    drop.view(-1, grid.width)[:, -1].zero_()
    fraction = torch.sub(disparity, whole, out=whole)
    torch.div(fraction, drop.add_(1).add_(fraction), out=share).mul_(same)
    odd = torch.bitwise_and(cell, 1, out=place)
    landing.sub_(place.copy_(fraction.sub_(0.5).add_(odd, alpha=TIE_PX).ceil_()))
    breaks = flat_indices(simple.logical_not_())
    memory.used = used
    return _Surfaces(joined, share, landing, nearest, breaks)


class _Special(NamedTuple):
    """Right pixels that show no pixel's first column at or right of its x'; [S]. The k-th is number N + 1 + k in the z-buffer.

    Attributes:
        source: int64, the left pixel whose point it shows, or which that point lies right of.
        share: float32, how far from the source to its right neighbour the point lies.
        disparity: float32, px.
    """

    source: Tensor
    share: Tensor
    disparity: Tensor


def _special(disparity: Tensor, surfaces: _Surfaces, grid: _Grid) -> _Special:
    """What is seen where surfaces begin, end and are stretched; it enters the z-buffer.

    The right end of a surface covers its first column at or right of x' where that is half a pixel away at most. The left end covers the
    column before its own where that is half a pixel away at most, and behind a stretched step the pixel covers it in any case.
    """
    joined, nearest, breaks = surfaces.joined, surfaces.nearest, surfaces.breaks
    inner = joined.index_select(0, breaks)  # 1 on a stretched step, 0 between two surfaces
    ends, begins = breaks[1:] - 1, breaks[:-1]
    count = ends.shape[0]
    pixel = torch.cat((ends, begins))
    own = disparity.index_select(0, pixel)
    whole = own.floor()
    half = (own - whole).sub_(0.5)
    covers = torch.cat((half[:count].le_(0).sub_(inner[1:]).clamp_(min=0), torch.maximum(half[count:].ge_(0), inner[:-1])))
    cell = grid.cell.index_select(0, pixel).sub_(whole.int()).long()
    cell[count:] -= 1
    place = covers.int().mul_(grid.place.index_select(0, pixel))
    nearest.scatter_reduce_(0, cell, place, "amax")

    cell, place, whole, inner = cell[count:], place[count:], whole[count:], inner[:-1]
    wins = nearest.index_select(0, cell).eq_(place).mul_(place.clamp_(max=1))
    number = torch.arange(grid.count + 1, grid.count + 1 + count, dtype=torch.int32, device=disparity.device)
    nearest.scatter_reduce_(0, cell, wins.mul_(number), "amax")

    source = begins - inner.long()
    here, following = disparity.index_select(0, source), own[count:]  # the same where nothing joins them
    beyond = here - whole
    share = beyond.div_((whole - following).add_(1).add_(beyond)).clamp_(0, 1).mul_(inner)
    return _Special(source, share, torch.lerp(here, following, share))


def _colours(planes: Tensor, surfaces: _Surfaces, special: _Special, limits: Tensor, memory: _Memory) -> Iterator[Tensor]:
    """For each channel a zero for the holes, the colours that the N pixels show, and those of the special ones; [1 + N + S]."""
    count, dtype = planes.shape[1], _arithmetic(planes)
    others = _special_colours(planes, surfaces.joined, special, limits)
    weights = _Weights(*(memory.take(count) for _ in range(3)))
    weights = weights.fill(surfaces.share, surfaces.joined[:-2], surfaces.joined[2:]).to(dtype)
    values = memory.take(count, dtype)
    change = memory.take(count + 2, dtype)  # from the left neighbour; the outermost have no weight
    change[:1].zero_()
    change[-2:].zero_()
    changes = change[:-2], change[1:-1], change[2:]
    colours, rounded = (memory.take(1 + count + special.share.shape[0], kind) for kind in (dtype, planes.dtype))
    colours[:1].zero_()
    ordinary = colours[1 : 1 + count]
    images = ordinary.view(len(limits), -1)
    on_cpu = limits.device.type == "cpu"  # there numbers are the fastest, and images come one by one
    least_and_largest = limits[0].tolist() if on_cpu else (limits[:, :1], limits[:, 1:])
    for plane, other in zip(planes, others, strict=True):
        values.copy_(plane)
        torch.sub(values[1:], values[:-1], out=change[1:-2])
        weights.cubic(values, changes, out=ordinary)
        images.clamp_(*least_and_largest)
        colours[1 + count :] = other
        yield colours if planes.is_floating_point() else _round(colours, out=rounded)


def _arithmetic(image: Tensor) -> torch.dtype:
    """In which its colours are computed."""
    return image.dtype if image.is_floating_point() else torch.float32


def _round(values: Tensor, out: Tensor) -> Tensor:
    """float32 [N], 0..255, to uint8, half to even. On the CPU OpenCV rounds, three times as fast as torch."""
    if values.device.type == "cpu":
        cv2.convertScaleAbs(values.numpy(), dst=out.numpy())
        return out
    return out.copy_(values.round())


def _special_colours(planes: Tensor, joined: Tensor, special: _Special, limits: Tensor) -> Tensor:
    """[C, S]."""
    source, share, _ = special
    weights = _Weights(*(torch.empty_like(share) for _ in range(3)))
    weights = weights.fill(share, joined.index_select(0, source), joined.index_select(0, source + 2)).to(_arithmetic(planes))
    places = (source + torch.arange(-1, 3, device=source.device).unsqueeze(1)).clamp_(0, planes.shape[1] - 1).flatten()
    taps = torch.stack([plane.index_select(0, places) for plane in planes]).to(_arithmetic(planes)).view(len(planes), 4, -1)
    colours = weights.cubic(taps[:, 1], taps.diff(dim=1).unbind(1))
    if limits.device.type == "cpu":  # one image
        return colours.clamp_(*limits[0].tolist())
    image = torch.div(source, planes.shape[1] // len(limits), rounding_mode="floor")
    return colours.clamp_(*limits.index_select(0, image).unbind(1))


class _Weights(NamedTuple):
    """The cubic between p(i) and p(i + 1) at a share t, by the changes from p(i - 1) on to p(i + 2).

    With p'' the second difference p(i - 1) - 2 p(i) + p(i + 1): lerp(p(i), p(i + 1), t) - SHARPNESS t (1 - t) lerp(p''(i), p''(i + 1), t).
    Where a surface ends p'' is zero: there its colour goes on straight, and nothing of the other side comes in.
    """

    before: Tensor
    between: Tensor
    after: Tensor

    def fill(self, share: Tensor, joined_before: Tensor, joined_after: Tensor) -> _Weights:
        """At these shares; `joined_before` is 1 where p(i - 1), `joined_after` where p(i + 2) is of the same surface, else 0."""
        before, between, after = self
        torch.addcmul(share, share, share, value=-1, out=before)
        torch.mul(before, share, out=after)
        before.sub_(after).mul_(joined_before)
        after.mul_(joined_after)
        torch.sub(share, before, alpha=SHARPNESS, out=between).add_(after, alpha=SHARPNESS)
        return self

    def to(self, dtype: torch.dtype) -> _Weights:
        return _Weights(*(weight.to(dtype) for weight in self))

    def cubic(self, here: Tensor, changes: Sequence[Tensor], out: Tensor | None = None) -> Tensor:
        """The colour, from p(i) and the three changes."""
        out = torch.addcmul(here, self.before, changes[0], value=SHARPNESS, out=out)
        return out.addcmul_(self.between, changes[1]).addcmul_(self.after, changes[2], value=-SHARPNESS)


def _wins_where_it_lands(disparity: Tensor, landing: Tensor, right_disparity: Tensor, grid: _Grid, memory: _Memory) -> Tensor:
    """[rows, columns], 1 where round(x') lies in the image and the surface seen there is the pixel's own (disparity within 1 px), else 0.

    No pixel lands in a hole: its own surface covers the column.
    """
    seen = memory.take(grid.cells).fill_(OUTSIDE_PX)
    wanted = grid.wanted(seen)
    wanted.copy_(right_disparity.view_as(wanted))
    there = torch.index_select(seen, 0, memory.take(grid.count, torch.int64).copy_(landing), out=memory.take(grid.count))
    return there.sub_(disparity).abs_().le_(LARGEST_STEP_PX).view(-1, grid.width)[:, : grid.columns]
