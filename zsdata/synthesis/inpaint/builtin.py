"""Built-in inpainting: the surface behind the hole goes on, its colour smoothly and its texture as it is.

What a hole of a warped view hides is background. In the right view of a rectified pair the background lies at the hole's right end: a
foreground pixel x of disparity f lands at x - f, its right neighbour in the left image, x + 1 of disparity b < f, lands at
x + 1 - b > x + 1 - f, and the hole is what lies between the two, foreground to the left, background to the right. (Where the disparity
grows from x to x + 1 the two land on each other and leave no hole.) Only at the frame's right border is there no right end: there the scene
goes on beyond what the left camera saw, and the surface to the left is all there is to go on with.

Holes are filled by runs, the parts of one row, in two layers:

1. Colour. A run begins as the mean of the background next to it. It then takes part of the colour of the runs above and below that hide
   the same surface, the more the farther a pixel is from known ground: close by, the row itself knows best; far away only the mean does.
2. Texture. What the background has beyond the mean of its four neighbours TEXTURE_PX away, up to TEXTURE_LIMIT, is added at full strength.
   It is copied by a shift that is the same for a run and most of its neighbours, so that it keeps its form; where the shifted pixel is
   no background, it is mirrored at the hole's edge instead, to and fro within the surface.

Everything happens at hole pixels and runs, by gathers and sums of a fixed order: the result does not depend on the batch nor on threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from zsdata.synthesis.indices import flat_indices

SURFACE_PX = 3.0  # pixels whose disparities differ by at most this are taken for one surface
SPECK_PX = 2  # known pixels inside a hole, not more in a row, that are nearer than what follows: noise of the disparity, no edge
NEAR_PX, FAR_PX = 2, 4  # how much of the background gives a run's colour: close to the edge, and far from it
NEAR_ROWS, FAR_ROWS = (1, 2), (4, 8)  # how far above and below runs are averaged (1 2 1), one after the other: sigma 1.6 px, then 6.5 px
HALFWAY_PX = 8  # the distance at which a pixel's colour is half near and half far
MIRROR_PX = 16  # how much of the background is mirrored, at most
TEXTURE_PX = 2
TEXTURE_LIMIT = 20.0  # grey levels; more is the edge of a thing, whose ghost would be worse than its absence
SMALLEST_SHIFT_PX = 8
GREY = 127.5  # of an image without a known pixel


class BuiltinInpainter:
    """Fills the holes of right views. Needs no weights, draws nothing, works on the device of its input.

    `needs` names what it makes use of beyond the image and its holes: the disparity of the right view.
    """

    needs = ("right_disparity",)

    def __call__(
        self,
        right: Tensor,
        inpaint_mask: Tensor,
        generators: Sequence[np.random.Generator | None] | None = None,
        right_disparity: Tensor | None = None,
    ) -> Tensor:
        """Returns `right` with its holes filled; known pixels are unchanged bit for bit.

        Args:
            right: float [B, C, H, W], RGB 0..255, anything in the holes.
            inpaint_mask: bool [B, 1, H, W], True in the holes.
            generators: not used; the result depends on the other arguments alone.
            right_disparity: float [B, 1, H, W], pixels, right view, anything in the holes, as `forward_warp` returns it. With it the
                background of a hole is the farther of its two ends, and textures come from that surface alone; without it, it is the
                right end.

        Raises:
            ValueError: for shapes or dtypes that do not fit.
        """
        _check(right, inpaint_mask, right_disparity)
        batch, channels, height, width = right.shape
        hole = inpaint_mask.reshape(-1)
        pixel = flat_indices(hole)
        if len(pixel) == 0:
            return right.clone()
        colours = right.float().masked_fill(inpaint_mask, 0).transpose(0, 1).reshape(channels, -1)
        surface = torch.zeros(hole.shape, device=right.device) if right_disparity is None else right_disparity.float().reshape(-1)
        surface = surface.masked_fill(hole, torch.inf)

        run_of_pixel, runs = _find_runs(pixel, surface, width, trust_specks=right_disparity is not None)
        runs, room = _leave_the_rim(runs, surface, width)
        near, far = _run_colours(colours, surface, pixel, run_of_pixel, runs, room, height, width)

        beyond = (pixel - runs.edge[run_of_pixel]).abs().float() - 1
        share = beyond / (beyond + HALFWAY_PX)
        start = near.index_select(1, run_of_pixel)
        colour = start + (far.index_select(1, run_of_pixel) - start) * share
        colour += _texture(colours, surface, pixel, run_of_pixel, runs, room, height, width)

        filled = colours.clone()
        filled[:, pixel] = colour.clamp_(0, 255)
        filled = _fill_empty_rows(filled.reshape(channels, batch, height, width), inpaint_mask)
        return filled.transpose(0, 1).to(right.dtype, memory_format=torch.contiguous_format)


class _Runs(NamedTuple):
    """The M runs of holes; positions are indices into the flattened batch, B H W."""

    first: Tensor  # the leftmost and the rightmost hole pixel
    last: Tensor
    row: Tensor  # where the run's row begins
    edge: Tensor  # the known pixel at the background's end
    source: Tensor  # where the background is taken from: the edge, or the pixel behind it
    inward: Tensor  # +1 or -1: the direction from the hole into the background
    disparity: Tensor  # of the background; infinite where a whole row is a hole
    inner: Tensor  # True where the run has known pixels on both sides


def _find_runs(pixel: Tensor, surface: Tensor, width: int, trust_specks: bool) -> tuple[Tensor, _Runs]:
    """The run of every hole pixel, int64 [N], and the runs. `trust_specks`: `surface` can tell a near speck from the background."""
    row_of_pixel = pixel - pixel % width
    begins = torch.ones_like(pixel, dtype=torch.bool)
    begins[1:] = (pixel.diff() != 1) | (row_of_pixel.diff() != 0)
    ends = torch.ones_like(begins)
    ends[:-1] = begins[1:]
    first, last = pixel[flat_indices(begins)], pixel[flat_indices(ends)]
    row = first - first % width
    has_left, has_right = first > row, last < row + width - 1
    left, right = (first - 1).clamp_(min=0), (last + 1).clamp_(max=len(surface) - 1)

    linked = (row.diff() == 0) & (first[1:] - last[:-1] - 1 <= SPECK_PX)  # with the run that follows, across a speck
    if trust_specks:
        linked &= (surface[left[1:]] > surface[right[1:]] + SURFACE_PX) | ~has_right[1:]
    whole = torch.ones((1,), dtype=torch.bool, device=pixel.device)
    opens, closes = torch.cat([whole, ~linked]), torch.cat([~linked, whole])
    run_of_pixel = (opens.cumsum(0) - 1)[begins.cumsum(0) - 1]

    opens, closes = flat_indices(opens), flat_indices(closes)
    first, row, left, has_left = first[opens], row[opens], left[opens], has_left[opens]
    last, right, has_right = last[closes], right[closes], has_right[closes]
    to_right = has_right & (~has_left | (surface[right] <= surface[left]))
    edge = torch.where(to_right, right, left)
    inward = torch.where(to_right, 1, -1)
    return run_of_pixel, _Runs(first, last, row, edge, edge, inward, surface[edge], has_left & has_right)


def _leave_the_rim(runs: _Runs, surface: Tensor, width: int) -> tuple[_Runs, Tensor]:
    """The runs with `source` one pixel into the background, and how far that background goes on, int64 [M], 0..MIRROR_PX - 1 px.

    The outermost pixel of an object's background is often mixed with the object's colour; at the frame's border there is no object.
    """
    behind, there = _inside(runs.edge + runs.inward, runs, surface, width)
    behind_disparity = surface[behind]
    better = runs.inner & there & (behind_disparity <= runs.disparity + SURFACE_PX)
    source = torch.where(better, behind, runs.edge)
    runs = runs._replace(source=source, disparity=torch.where(better, behind_disparity, runs.disparity))

    room = torch.zeros_like(source)
    goes_on = torch.ones_like(better)
    for step in range(1, MIRROR_PX):
        following, there = _inside(source + runs.inward * step, runs, surface, width)
        goes_on = goes_on & there & _same_surface(surface[following], runs.disparity)
        room += goes_on
    return runs, room


def _run_colours(
    colours: Tensor, surface: Tensor, pixel: Tensor, run_of_pixel: Tensor, runs: _Runs, room: Tensor, height: int, width: int
) -> tuple[Tensor, Tensor]:
    """The colour of every run close to its edge and far from it, two times [C, M]."""
    channels, count = len(colours), len(runs.first)
    total, means = torch.zeros((channels, count), device=colours.device), []
    for step in range(FAR_PX):
        total = total + colours[:, runs.source + runs.inward * room.clamp(max=step)]
        if step + 1 in (NEAR_PX, FAR_PX):
            means.append(total / (step + 1))
    levels = torch.cat(means)

    # The neighbour of a run is the run in the same column, close to the edge, so many rows above or below.
    run_at = torch.full_like(surface, count, dtype=torch.int32)
    run_at[pixel] = run_of_pixel.int()
    nothing = torch.full((1,), torch.nan, device=colours.device)
    disparity = torch.cat([runs.disparity, nothing])
    border = torch.where(runs.inward > 0, runs.last, runs.first)
    middle = border - runs.inward * ((runs.last - runs.first) // 2).clamp(max=SMALLEST_SHIFT_PX)
    y = runs.row // width % height
    near = levels
    for rows in (*NEAR_ROWS, *FAR_ROWS):
        padded = torch.cat([levels, levels[:, :1]], 1)
        total, weight = 2 * levels, torch.full_like(runs.disparity, 2)
        for offset in (-rows, rows):
            inside = (y + offset >= 0) & (y + offset < height)
            neighbour = run_at[(middle + offset * width).clamp_(0, len(surface) - 1)].long().masked_fill_(~inside, count)
            same = _same_surface(disparity[neighbour], runs.disparity)
            total = total + torch.where(same, padded.index_select(1, neighbour), 0)
            weight = weight + same
        levels = total / weight
        if rows == NEAR_ROWS[-1]:
            near = levels
    return near[:channels], levels[channels:]


def _texture(
    colours: Tensor, surface: Tensor, pixel: Tensor, run_of_pixel: Tensor, runs: _Runs, room: Tensor, height: int, width: int
) -> Tensor:
    """What is added to the colour of every hole pixel, [C, N]: the background's own deviation from its surroundings."""
    # A power of two is the same for runs of similar length; being at least as long as the run, it repeats nothing.
    shifts = SMALLEST_SHIFT_PX * 2 ** torch.arange(max(1, width.bit_length()), device=pixel.device)
    span = torch.maximum((runs.edge - runs.first).abs(), (runs.edge - runs.last).abs())
    shift = runs.inward * shifts[torch.bucketize(span, shifts)]

    runs = _Runs(*(field.index_select(0, run_of_pixel) for field in runs))
    room, shift = room.index_select(0, run_of_pixel), shift.index_select(0, run_of_pixel)
    shifted, there = _inside(pixel + shift, runs, surface, width)
    there &= _same_surface(surface.index_select(0, shifted), runs.disparity)
    there_and_back = (2 * room).clamp(min=1)
    step = (pixel - runs.source).abs() % there_and_back
    mirrored = runs.source + runs.inward * torch.minimum(step, 2 * room - step).clamp_(min=0)
    source = torch.where(there, shifted, mirrored)

    column, y = source - runs.row, source // width % height
    disparity, centre = surface.index_select(0, source), colours.index_select(1, source)
    texture = torch.zeros_like(centre)
    for offset, inside in (
        (TEXTURE_PX, column < width - TEXTURE_PX),
        (-TEXTURE_PX, column >= TEXTURE_PX),
        (TEXTURE_PX * width, y < height - TEXTURE_PX),
        (-TEXTURE_PX * width, y >= TEXTURE_PX),
    ):
        neighbour = torch.where(inside, source + offset, source)
        same = _same_surface(surface.index_select(0, neighbour), disparity)
        texture += (centre - colours.index_select(1, neighbour)) * (same * 0.25)
    return texture.clamp_(-TEXTURE_LIMIT, TEXTURE_LIMIT)


def _inside(position: Tensor, runs: _Runs, surface: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """`position`, made an index, and True where it lies in the run's own row."""
    return position.clamp(0, len(surface) - 1), (position >= runs.row) & (position < runs.row + width)


def _same_surface(disparity: Tensor, reference: Tensor) -> Tensor:
    """True where both are known (holes are infinitely near) and close to each other."""
    return (disparity - reference).abs() <= SURFACE_PX


def _fill_empty_rows(planes: Tensor, inpaint_mask: Tensor) -> Tensor:
    """`planes` [C, B, H, W] with rows that are holes from end to end mirrored from the nearest other row; grey where there is none."""
    empty = inpaint_mask[:, 0].all(-1)
    if not empty.any():
        return planes
    batch, height = empty.shape
    y = torch.arange(height, device=empty.device).expand(batch, height)
    above = torch.where(empty, -height, y).cummax(1).values
    below = torch.where(empty, 3 * height, y).flip(1).cummin(1).values.flip(1)
    nearest = torch.where(y - above <= below - y, above, below).clamp_(0, height - 1)
    mirrored = (2 * nearest - y).clamp_(0, height - 1)
    source = torch.where(empty.gather(1, mirrored), nearest, mirrored)
    planes = planes.gather(2, source[None, :, :, None].expand_as(planes))
    return planes.masked_fill(empty.all(1).view(1, batch, 1, 1), GREY)


def _check(right: Tensor, inpaint_mask: Tensor, right_disparity: Tensor | None) -> None:
    if right.ndim != 4 or not right.is_floating_point():
        raise ValueError(f"right is a float [B, C, H, W] image; got {right.dtype} {list(right.shape)}")
    expected = [right.shape[0], 1, *right.shape[2:]]
    if list(inpaint_mask.shape) != expected or inpaint_mask.dtype != torch.bool:
        raise ValueError(f"inpaint_mask is bool {expected}, True in the holes; got {inpaint_mask.dtype} {list(inpaint_mask.shape)}")
    if right_disparity is not None and list(right_disparity.shape) != expected:
        raise ValueError(f"right_disparity is {expected}; got {list(right_disparity.shape)}")
