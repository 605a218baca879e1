"""Disparity: how far apart the two cameras stand, and edges that belong to one surface or the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from zsdata.synthesis.indices import flat_indices

SMALLEST_DISPARITY_PX = 0.01  # of the farthest point; not 0, which marks "no value" in most stereo data sets
SHARPEN_EDGE_PX = 3.0  # Sobel magnitude above which a disparity belongs to neither side of an edge (the published threshold)


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
        if not (self.radius > 0 and self.center - 2 * self.radius >= 0 and self.center + 2 * self.radius <= 1):
            raise ValueError(
                f"center - 2 radius .. center + 2 radius are shares of the width, within 0..1; got {self.center} and {self.radius}"
            )
        probabilities = (self.center_probability, self.small_probability, self.large_probability)
        if min(probabilities) < 0 or abs(sum(probabilities) - 1) > 1e-6:
            raise ValueError(f"the three probabilities must be >= 0 and add up to 1; got {probabilities}")

    def draw_scale(self, generator: np.random.Generator, width: int) -> float:
        """The disparity of the nearest point as a share of `width`; in (c - 2 r, c + 2 r)."""
        del width
        which, where = generator.random(2)
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
    """MfS-Stereo's choice, the paper's baseline: the largest disparity is uniform in a range of pixels, whatever the photo's width."""

    min_px: float = 50.0
    max_px: float = 225.0

    def __post_init__(self) -> None:
        if not 0 < self.min_px <= self.max_px:
            raise ValueError(f"a range of pixels needs 0 < min_px <= max_px; got {self.min_px}..{self.max_px}")

    def draw_scale(self, generator: np.random.Generator, width: int) -> float:
        """The disparity of the nearest point as a share of `width`."""
        return float(generator.uniform(self.min_px, self.max_px)) / width


def dilate_disparity(disparity: Tensor, radius_px: int = 1) -> Tensor:
    """Lets near surfaces grow by `radius_px`, so that the rim of an object moves with it (paper, supplement, "Forward Warping").

    Args:
        disparity: float [B, 1, H, W], pixels.
        radius_px: how often the maximum over a pixel and its four neighbours is taken; 0 changes nothing. OpenCV's 3x3 ellipse of the
            published code is that cross.
    """
    if radius_px < 0:
        raise ValueError(f"radius_px must be 0 or more; got {radius_px}")
    for _ in range(radius_px):
        grown = disparity.clone()
        for here, neighbour in _neighbour_slices():
            grown[here] = torch.maximum(grown[here], disparity[neighbour])
        disparity = grown
    return disparity


def _neighbour_slices():
    head, tail, whole = slice(None, -1), slice(1, None), slice(None)
    for first, second in ((head, tail), (tail, head)):
        yield (..., first, whole), (..., second, whole)
        yield (..., whole, first), (..., whole, second)


def sharpen_disparity(disparity: Tensor, edge_px: float = SHARPEN_EDGE_PX) -> Tensor:
    """Replaces every edge value by the nearest value that is none, so that a depth edge is a step and no pixel hangs between two surfaces.

    An edge is where the Sobel magnitude (root mean square of both directions, kernels 1-2-1 over 4) exceeds `edge_px`. The nearest is
    that of the smallest Euclidean distance; of several at one distance the one in the nearest row wins, then the row above, then the left
    one. A map that is edge all over stays as it is.

    Args:
        disparity: float32 [B, 1, H, W], pixels.
        edge_px: pixels of disparity.
    """
    rows, columns = disparity.shape[-2:]
    edge = flat_indices(sobel_magnitude(disparity) > edge_px)
    if not len(edge) or len(edge) == disparity.numel():
        return disparity

    # In each row the nearest value at or left of x, and at or right of x; -1 and `columns` stand for "none".
    column = torch.arange(columns, device=disparity.device).repeat(disparity.numel() // columns)
    x = column[edge]
    begins = torch.ones_like(edge, dtype=torch.bool)  # of a run of edges in one row
    begins[1:] = (edge[1:] != edge[:-1] + 1) | (x[1:] == 0)
    run = begins.cumsum(0) - 1
    at_left, at_right = column, column.clone()
    at_left[edge] = (x[begins] - 1)[run]
    at_right[edge] = (x[begins.roll(-1)] + 1)[run]

    y = torch.div(edge, columns, rounding_mode="floor") % rows
    unknown = rows**2 + columns**2
    best = torch.full_like(edge, unknown)  # squared distances
    found = edge.clone()
    pending = torch.arange(len(edge), device=edge.device)
    row_distance = 0
    while len(pending) and row_distance < rows:
        here, x_here, y_here = edge[pending], x[pending], y[pending]
        nearest, source = best[pending], found[pending]
        for row_step in (-row_distance, row_distance)[: 1 if row_distance == 0 else 2]:
            inside = (y_here + row_step >= 0) & (y_here + row_step < rows)
            there = (here + row_step * columns).clamp_(0, disparity.numel() - 1)
            for at in (at_left, at_right):
                candidate = at.index_select(0, there)
                step = candidate - x_here
                distance = step * step + row_distance**2
                better = inside & (distance < nearest) & (candidate >= 0) & (candidate < columns)
                nearest = torch.where(better, distance, nearest)
                source = torch.where(better, there + step, source)
        best[pending], found[pending] = nearest, source
        row_distance += 1
        pending = pending[nearest > row_distance**2]

    sharp = disparity.flatten().clone()
    sharp[edge] = sharp[found]
    return sharp.view_as(disparity)


def sobel_magnitude(disparity: Tensor) -> Tensor:
    """Root mean square of the horizontal and vertical Sobel derivative, borders replicated; [B, 1, H, W], pixels of disparity."""
    padded = torch.nn.functional.pad(disparity, (1, 1, 1, 1), mode="replicate")
    down = padded[..., :-2, :] + 2 * padded[..., 1:-1, :] + padded[..., 2:, :]
    across = padded[..., :-2] + 2 * padded[..., 1:-1] + padded[..., 2:]
    horizontal = (down[..., 2:] - down[..., :-2]) / 4
    vertical = (across[..., 2:, :] - across[..., :-2, :]) / 4
    return ((horizontal**2 + vertical**2) / 2).sqrt()
