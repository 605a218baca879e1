"""Disparity: how far apart the two cameras stand, and edges that belong to one surface or the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from zsdata.field_types import check_types
from zsdata.synthesis.indices import flat_indices, indices_above

SMALLEST_DISPARITY_PX = 0.01  # of the farthest point; not 0, which marks "no value" in most stereo data sets
SHARPEN_EDGE_PX = 3.0  # Sobel magnitude above which a disparity belongs to neither side of an edge (the published threshold)
NEAR_ROWS = 3  # within which nearly every edge value finds one that is none
MOST_CHOICES = 1 << 20  # places that are weighed at once, for all edges together
NO_SQUARE = 1 << 40  # farther than anything
NOT_NEAR_PX = 45  # columns off that need no telling apart there; 14 * 45^2 is an int16

_CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


@dataclass(frozen=True, kw_only=True)
class AdaptiveDisparity:
    """Adaptive Disparity Selection (paper, section "Adaptive Disparity Selection"): the largest disparity is a share of the photo's width.

    The share s is drawn from (c - r, c + r) with probability p_c, from the r below with p_s, from the r above with p_l.
    """

    center: float = 0.1
    radius: float = 0.05
    center_probability: float = 0.8
    small_probability: float = 0.1
    large_probability: float = 0.1

    def __post_init__(self) -> None:
        check_types(self)
        if not (self.radius > 0 and self.center - 2 * self.radius >= 0 and self.center + 2 * self.radius <= 1):
            raise ValueError(
                f"center - 2 radius .. center + 2 radius are shares of the width, within 0..1; got {self.center} and {self.radius}"
            )
        probabilities = (self.center_probability, self.small_probability, self.large_probability)
        if min(probabilities) < 0 or abs(sum(probabilities) - 1) > 1e-6:
            raise ValueError(f"center_probability, small_probability, large_probability are 0 or more and add up to 1; got {probabilities}")

    def draw_scale(self, generator: np.random.Generator, width: float) -> float:
        """The disparity of the nearest point as a share of `width`; in (c - 2 r, c + 2 r)."""
        del width
        which, where = generator.random(2).tolist()
        where = min(max(where, 1e-6), 1 - 1e-6)  # the ranges are open
        if which < self.small_probability:
            low = self.center - 2 * self.radius
        elif which < self.small_probability + self.large_probability:
            low = self.center + self.radius
        else:
            return self.center - self.radius + 2 * self.radius * where
        return low + self.radius * where


@dataclass(frozen=True, kw_only=True)
class UniformDisparity:
    """MfS-Stereo's choice, the paper's baseline: the largest disparity is uniform in a range of pixels, whatever the photo's width.

    Of a photo that the stream takes for a smaller one they are that one's pixels (see `ViewConfig.max_width`).
    """

    min_px: float = 50.0
    max_px: float = 225.0

    def __post_init__(self) -> None:
        check_types(self)
        if not 0 < self.min_px <= self.max_px:
            raise ValueError(f"a range of pixels needs 0 < min_px <= max_px; got {self.min_px}..{self.max_px}")

    def draw_scale(self, generator: np.random.Generator, width: float) -> float:
        """The disparity of the nearest point as a share of `width`."""
        return float(generator.uniform(self.min_px, self.max_px)) / width


@torch.no_grad()
def dilate_disparity(disparity: Tensor, radius_px: int = 1) -> Tensor:
    """Lets near surfaces grow by `radius_px`, so that the rim of an object moves with it (paper, supplement, "Forward Warping").

    Args:
        disparity: float [B, 1, H, W], pixels.
        radius_px: how often the maximum over a pixel and its four neighbours is taken; 0 changes nothing. OpenCV's 3x3 ellipse of the
            published code is that cross.
    """
    if radius_px < 0:
        raise ValueError(f"radius_px must be 0 or more; got {radius_px}")
    if disparity.device.type == "cpu":  # OpenCV takes the same maximum in a third of the time
        grown = torch.empty_like(disparity, memory_format=torch.contiguous_format)
        for source, target in zip(disparity.flatten(0, 1).numpy(), grown.flatten(0, 1).numpy(), strict=True):
            cv2.dilate(source, _CROSS, dst=target, iterations=radius_px)
        return grown
    for _ in range(radius_px):
        grown = disparity.clone()
        for here, neighbour in _neighbour_slices():
            torch.maximum(grown[here], disparity[neighbour], out=grown[here])
        disparity = grown
    return disparity


def _neighbour_slices():
    head, tail, whole = slice(None, -1), slice(1, None), slice(None)
    for first, second in ((head, tail), (tail, head)):
        yield (..., first, whole), (..., second, whole)
        yield (..., whole, first), (..., whole, second)


@torch.no_grad()
def sharpen_disparity(disparity: Tensor, edge_px: float = SHARPEN_EDGE_PX) -> Tensor:
    """Replaces every edge value by the nearest value that is none, so that a depth edge is a step and no pixel hangs between two surfaces.

    An edge is where the Sobel magnitude (root mean square of both directions, kernels 1-2-1 over 4) exceeds `edge_px`. The nearest is
    that of the smallest Euclidean distance; of several at one distance the one in the nearest row wins, then the row above, then the left
    one. A map that is edge all over stays as it is.

    Args:
        disparity: float32 [B, 1, H, W], pixels.
        edge_px: pixels of disparity.
    """
    frame = _Frame(disparity)
    energy = torch.zeros_like(frame.padded)
    _sobel_energy(frame.padded[..., NEAR_ROWS - 1 : 1 - NEAR_ROWS, :], out=frame.inside(energy))
    edge = indices_above(energy, 32 * edge_px**2)
    if edge.shape[0] in (0, disparity.numel()):
        return disparity
    values = frame.padded.view(-1)
    values.index_copy_(0, edge, values.index_select(0, _nearest_values(edge, frame)))
    return frame.inside(frame.padded).contiguous()


class _Frame:
    """The maps with a column on each side and NEAR_ROWS rows above and below, so that each edge has its neighbours."""

    def __init__(self, disparity: Tensor) -> None:
        self.padded = torch.nn.functional.pad(disparity, (1, 1, NEAR_ROWS, NEAR_ROWS), mode="replicate")
        self.rows, self.columns = self.padded.shape[-2:]

    def inside(self, padded: Tensor) -> Tensor:
        """Without the frame."""
        return padded[..., NEAR_ROWS:-NEAR_ROWS, 1:-1]

    def table(self, edge: Tensor, of_edge: Tensor, of_frame: int) -> Tensor:
        """For all places, flattened: `of_edge` for the edges, `of_frame` for the frame, 0 for values."""
        table = torch.full(self.padded.shape, of_frame, dtype=of_edge.dtype, device=edge.device)
        self.inside(table).zero_()
        return table.view(-1).index_copy_(0, edge, of_edge)


class _NearRows(NamedTuple):
    """The R rows that are searched at once, and a choice for each row and side, 2 R. They stand in the order of preference at equal
    distance: nearer rows, the row above, the left side."""

    row_steps: Tensor  # int64 [R, 1]
    order: Tensor  # int16 [R, 1]: the part of a choice's key that depends on its row
    row_step_of_choice: Tensor  # int64 [2 R]
    side_of_choice: Tensor  # int64 [2 R], -1 or 1

    @staticmethod
    @cache
    def on(device: torch.device) -> _NearRows:
        """Kept, because a GPU waits for whatever is brought there."""
        steps = torch.tensor(sorted(range(-NEAR_ROWS, NEAR_ROWS + 1), key=abs)).unsqueeze(1)
        choices = torch.arange(2 * len(steps))
        order = 2 * len(steps) * steps**2 + choices[::2].unsqueeze(1)
        tables = steps, order.to(torch.int16), steps.expand(-1, 2).flatten(), choices % 2 * 2 - 1
        return _NearRows(*(table.to(device) for table in tables))


def _nearest_values(edge: Tensor, frame: _Frame) -> Tensor:
    """Where each edge takes its value from. Places are indices into the flattened, padded maps, int64; those of the edges ascend."""
    begins = torch.ones(edge.shape[0] + 1, dtype=torch.bool, device=edge.device)  # a run of edges in one row, or ends them all
    torch.ne(edge[1:] - edge[:-1], 1, out=begins[1:-1])
    run = begins[:-1].cumsum(0).sub_(1)
    bounds = flat_indices(begins)
    before, after = edge.index_select(0, bounds[:-1]) - 1, edge.index_select(0, bounds[1:] - 1) + 1

    def columns_off(none: int) -> tuple[Tensor, Tensor]:
        """How far off the nearest value of its row is, on the left and on the right of each edge; `none` at most."""
        left = before - (before % frame.columns == 0) * none  # the frame holds no values
        right = after + (after % frame.columns == frame.columns - 1) * none
        return (edge - left.index_select(0, run)).clamp_(max=none), (right.index_select(0, run) - edge).clamp_(max=none)

    # Near rows, all at once.
    near = _NearRows.on(edge.device)
    count = len(near.side_of_choice)
    there = (edge + frame.columns * near.row_steps).flatten()
    left, right = columns_off(NOT_NEAR_PX)
    best_of_row = frame.table(edge, torch.minimum(count * left * left, count * right * right + 1).to(torch.int16), count * NOT_NEAR_PX**2)
    key = best_of_row.index_select(0, there).view(len(near.row_steps), -1).add_(near.order).amin(0).long()
    square = torch.div(key, count, rounding_mode="floor")
    choice = key.sub_(square, alpha=count)
    row_step, side = near.row_step_of_choice.index_select(0, choice), near.side_of_choice.index_select(0, choice)
    column_step = (square - row_step * row_step).float().sqrt_().long()
    found = row_step.mul_(frame.columns).add_(edge).add_(column_step.mul_(side))

    far = flat_indices(square > (NEAR_ROWS + 1) ** 2)
    if far.shape[0]:
        none = frame.columns  # farther than any value of the row
        sides = [frame.table(edge, off, none) for off in columns_off(none)]
        found[far] = _nearest_values_farther(edge[far], sides, none, frame)
    return found


def _nearest_values_farther(edge: Tensor, columns_off: Sequence[Tensor], none: int, frame: _Frame) -> Tensor:
    """As `_nearest_values`, for some edges and at any distance; the edge itself where a map is edge all over. Rows are searched outwards,
    ever more of them at once."""
    found, distance = edge.clone(), torch.full_like(edge, frame.rows**2 + frame.columns**2)
    row = torch.div(edge, frame.columns, rounding_mode="floor") % frame.rows
    pending = torch.arange(edge.shape[0], device=edge.device)
    begin = 0
    while pending.shape[0] and begin < frame.rows:
        at_once = max(1, min(max(begin, NEAR_ROWS + 1), MOST_CHOICES // (4 * pending.shape[0])))
        end = min(begin + at_once, frame.rows)
        which = torch.arange(2 * begin, 2 * end, device=edge.device).unsqueeze(1)  # of two rows equally far off the one above comes first
        row_step = torch.div(which, 2, rounding_mode="floor") * (which % 2 * 2 - 1)
        there = row[pending] + row_step
        there = torch.where((there >= 0) & (there < frame.rows), edge[pending] + row_step * frame.columns, 0)  # at place 0 is none
        steps = torch.stack([off.index_select(0, there.flatten()).view(there.shape) for off in columns_off], 1)
        squares = (steps * steps + (row_step * row_step).unsqueeze(1)).masked_fill_(steps >= none, NO_SQUARE).flatten(0, 1)
        order = torch.arange(squares.shape[0], device=edge.device).unsqueeze(1)
        key = (squares * len(order) + order).amin(0)
        square = torch.div(key, len(order), rounding_mode="floor")
        choice = (key - square * len(order)).unsqueeze(0)
        source = there.repeat_interleave(2, 0).gather(0, choice) + steps.flatten(0, 1).gather(0, choice) * (choice % 2 * 2 - 1)
        nearest = distance[pending]
        better = square < nearest
        found[pending] = torch.where(better, source[0], found[pending])
        distance[pending] = nearest = torch.where(better, square, nearest)
        begin = end
        pending = pending[nearest > begin**2]
    return found


def sobel_magnitude(disparity: Tensor) -> Tensor:
    """Root mean square of the horizontal and vertical Sobel derivative, borders replicated; [B, 1, H, W], pixels of disparity."""
    padded = torch.nn.functional.pad(disparity, (1, 1, 1, 1), mode="replicate")
    return _sobel_energy(padded, out=torch.empty_like(disparity)).div_(32).sqrt_()


def _sobel_energy(padded: Tensor, out: Tensor) -> Tensor:
    """32 times the square of the Sobel magnitude of maps with a border of one pixel: the sum of both squares before any division."""
    down = (padded[..., :-2, :] + padded[..., 2:, :]).add_(padded[..., 1:-1, :], alpha=2)
    across = (padded[..., :-2] + padded[..., 2:]).add_(padded[..., 1:-1], alpha=2)
    horizontal = down[..., 2:] - down[..., :-2]
    vertical = across[..., 2:, :] - across[..., :-2, :]
    return torch.addcmul(horizontal.square_(), vertical, vertical, out=out)
