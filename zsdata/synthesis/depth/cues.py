"""What a picture says about nearness: six cues per superpixel."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from .regions import LAB_WEIGHTS, Array, Labels, Partition, region_mean, region_sum

COARSEST_LEVEL = 12  # partitions of fewer regions are too coarse to mean objects
CONTACT_COST = 1500.0  # squared colour contrast that costs a whole image height on the way down to the ground
DETAIL_SIGMAS_PX = (1.0, 3.0)  # band of detail: above the noise, below the size of objects
DETAIL_WINDOW_PX = 15
FRAME_REGIONS = 256  # most regions of the partition that is linked to the frame; the cost is cubic in it
SAME_CONTRAST = 14.0  # contrast along a path (one standard deviation) up to which two regions count as one thing
IGNORED_CONTRAST = 4.0  # contrast of a border that costs nothing: shading
GROUND_SHARE = (0.4, 0.7)  # a thing that holds so much of the bottom border begins to be, or is, the ground


class Cues(NamedTuple):
    """One value per superpixel and cue, all larger where nearer; also used for the six weights."""

    row: Array | float
    """Height in the image, 0 at the top: on a ground plane inverse depth is linear in the image row."""
    contact: Array | float
    """Lowest row that a path of little colour contrast reaches: where the thing stands. On the ground itself its own row."""
    base: Array | float
    """Lowest row of the region that holds the superpixel, averaged over ever coarser partitions; on the ground its own row."""
    detail: Array | float
    """Fine contrast, which haze and defocus take from what is far."""
    chroma: Array | float
    """Colourfulness, which haze takes too."""
    enclosed: Array | float
    """1 for what does not belong to things that leave the frame through its upper part, as walls, sky and distance do."""


def find_cues(image: NDArray[np.uint8], labels: Labels, finest: Partition, levels: list[Partition], y: Array) -> Cues:
    """The cues of the superpixels.

    Args:
        image: RGB [h, w, 3].
        labels: superpixel of each pixel [h, w].
        finest: the superpixels.
        levels: ever coarser partitions of them, down to one region.
        y: mean row of each superpixel, 0..1.
    """
    pixels = finest.pixels
    coarse = [level for level in levels if len(level.pixels) > COARSEST_LEVEL] or levels[:1]
    linked = next(level for level in levels if len(level.pixels) <= FRAME_REGIONS)
    background, ground = _frame(labels, linked)
    ground = ground[linked.region_of]

    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    fine, smooth = (cv2.GaussianBlur(grey, (0, 0), sigma) for sigma in DETAIL_SIGMAS_PX)
    band = cv2.blur(np.abs(fine - smooth), (DETAIL_WINDOW_PX, DETAIL_WINDOW_PX))
    detail = np.log1p(region_sum(labels.ravel(), band.ravel()) / pixels) / 4
    chroma = np.hypot(finest.colour[:, 1] - 128 * LAB_WEIGHTS[1], finest.colour[:, 2] - 128 * LAB_WEIGHTS[2]) / (128 * LAB_WEIGHTS[1])

    def over_levels(value: Array) -> Array:
        return np.mean([region_mean(level.region_of, value, pixels)[level.region_of] for level in coarse], 0)

    contact = -_least_over_paths(-y, finest, np.square(finest.contrast) / CONTACT_COST)
    base = np.mean([_region_max(level.region_of, y) for level in coarse], 0)
    return Cues(
        row=y,
        contact=contact + ground * (y - contact),
        base=base + ground * (y - base),
        detail=over_levels(detail),
        chroma=over_levels(chroma),
        enclosed=1 - background[linked.region_of],
    )


def _region_max(region_of: Labels, value: Array) -> Array:
    """Largest value in the region of each superpixel."""
    largest = np.full(region_of.max() + 1, -np.inf)
    np.maximum.at(largest, region_of, value)
    return largest[region_of]


def _least_over_paths(start: Array, partition: Partition, cost: Array) -> Array:
    """min over superpixels q of start(q) + cost of the cheapest path from q (Bellman-Ford)."""
    if not len(cost):
        return start
    source = np.concatenate([partition.second, partition.first])
    target = np.concatenate([partition.first, partition.second])
    order = np.argsort(target, kind="stable")
    source, cost = source[order], np.concatenate([cost, cost])[order]
    target, begin = np.unique(target[order], return_index=True)
    least = start.copy()
    while True:
        lower = np.minimum(least[target], np.minimum.reduceat(least[source] + cost, begin))
        if np.array_equal(lower, least[target]):
            return least
        least[target] = lower


def _frame(labels: Labels, partition: Partition) -> tuple[Array, Array]:
    """How far each region is background and how far it is ground, 0..1, from where its thing meets the frame.

    A region's thing is the soft set of regions that a path of little contrast reaches. Background leaves the frame
    through the top and the upper sides rather than the lower sides and the bottom: the length of frame it holds, counted
    positive above and negative below, is large for its area (boundary connectivity, Zhu et al., CVPR 2014, with signs).
    Ground holds most of the bottom.
    """
    count = len(partition.pixels)
    height, width = labels.shape
    path = np.full((count, count), np.inf, np.float32)
    np.fill_diagonal(path, 0)
    step = np.maximum(partition.contrast + 0.5 * partition.gradient - IGNORED_CONTRAST, 0)
    path[partition.first, partition.second] = step
    path[partition.second, partition.first] = step
    for via in range(count):
        np.minimum(path, path[:, via, None] + path[via], out=path)
    same = np.exp(-0.5 * np.square(path.astype(np.float64) / SAME_CONTRAST))

    region = partition.region_of[labels]
    bottom = np.bincount(region[-1], minlength=count)
    upper = 1 - 2 * (np.arange(height) + 0.5) / height
    sides = region_sum(region[:, 0], upper, count) + region_sum(region[:, -1], upper, count)
    length = (same * (np.bincount(region[0], minlength=count) + sides - bottom)).sum(1).clip(0)
    connectivity = length / np.sqrt((same * partition.pixels).sum(1))
    begins, full = GROUND_SHARE
    ground = ((same * bottom).sum(1) / width - begins) / (full - begins)
    return 1 - np.exp(-0.5 * np.square(connectivity)), ground.clip(0, 1)
