"""From pixels to surfaces: an over-segmentation on image edges, and the tree of its merges."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Labels = NDArray[np.int64]

SEED_STEP_PX = 7  # one watershed seed per cell of this side: finer than the objects that matter, coarse enough for a small graph
LAB_WEIGHTS = (0.7, 1.5, 1.5)  # lightness counts less than hue: shading and shadow change it inside one surface
SMALL_REGION = 0.0006  # share of the image below which a region is taken for noise and merges early


class Partition(NamedTuple):
    """Regions made of superpixels, and the borders between them.

    `region_of` maps a superpixel to its region; `pixels` and `colour` (weighted CIE Lab) are per region, `first < second`,
    `gradient` (mean along the border) and `length` (pixels) per border.
    """

    region_of: Labels
    pixels: Array
    colour: Array
    first: Labels
    second: Labels
    gradient: Array
    length: Array

    @property
    def contrast(self) -> Array:
        """Colour distance of the two regions of each border."""
        return np.sqrt(np.square(self.colour[self.first] - self.colour[self.second]).sum(1))


def region_sum(region_of: Labels, value: NDArray, count: int = 0) -> Array:
    """Sum of `value` per region, for at least `count` regions; in index order, so it is the same everywhere."""
    return np.bincount(region_of, value, minlength=count).astype(np.float64, copy=False)


def region_mean(region_of: Labels, value: Array, weight: Array) -> Array:
    """Weighted mean of `value` per region."""
    return region_sum(region_of, value * weight) / region_sum(region_of, weight)


def superpixels(image: NDArray[np.uint8]) -> tuple[Labels, Partition]:
    """Small regions that end on image edges: a watershed from one seed per cell, placed where the cell is smoothest.

    Args:
        image: RGB [h, w, 3].
    Returns:
        labels [h, w] from 0, and the superpixels as the finest partition.
    """
    smooth = np.asarray(cv2.bilateralFilter(image, 5, 25, 3), np.uint8)  # px, grey levels, px: takes sensor noise, leaves edges
    lab = cv2.cvtColor(smooth, cv2.COLOR_RGB2LAB).astype(np.float32) * np.array(LAB_WEIGHTS, np.float32)
    gx, gy = cv2.Sobel(lab, cv2.CV_32F, 1, 0, scale=0.25), cv2.Sobel(lab, cv2.CV_32F, 0, 1, scale=0.25)
    gradient = np.sqrt(cv2.transform(gx * gx + gy * gy, np.ones((1, 3), np.float32)))

    labels = _flood(smooth, _seeds(gradient))
    flat = labels.ravel()
    pixels = np.bincount(flat).astype(np.float64)
    colour = np.stack([region_sum(flat, channel.ravel()) for channel in cv2.split(lab)], 1) / pixels[:, None]
    borders = _borders(labels, gradient)
    return labels, Partition(np.arange(len(pixels)), pixels, colour, *borders)


def _seeds(gradient: NDArray[np.float32]) -> NDArray[np.int32]:
    """Markers [h, w]: 1, 2, ... on the smoothest pixel of each cell (the first one among equals), 0 elsewhere."""
    h, w = gradient.shape
    rows, columns = -(-h // SEED_STEP_PX), -(-w // SEED_STEP_PX)
    padded = np.full((rows * SEED_STEP_PX, columns * SEED_STEP_PX), np.inf, np.float32)
    padded[:h, :w] = gradient
    cells = padded.reshape(rows, SEED_STEP_PX, columns, SEED_STEP_PX).transpose(0, 2, 1, 3).reshape(rows, columns, -1)
    place = cells.argmin(2)
    y = np.arange(rows)[:, None] * SEED_STEP_PX + place // SEED_STEP_PX
    x = np.arange(columns) * SEED_STEP_PX + place % SEED_STEP_PX
    markers = np.zeros((h, w), np.int32)
    markers[y, x] = np.arange(1, rows * columns + 1, dtype=np.int32).reshape(rows, columns)
    return markers


def _flood(image: NDArray[np.uint8], markers: NDArray[np.int32]) -> Labels:
    """Watershed whose lines are given to the neighbour most alike in colour; labels from 0, each used."""
    # OpenCV draws a line along the image border; the padding takes it.
    labels = cv2.copyMakeBorder(markers, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    padded = cv2.copyMakeBorder(image, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    cv2.watershed(padded, labels)
    labels[[0, -1]] = labels[:, [0, -1]] = -1
    inside = np.zeros(labels.shape, bool)
    inside[1:-1, 1:-1] = True
    flat, width = labels.reshape(-1), labels.shape[1]
    channels = [channel.astype(np.int16).reshape(-1) for channel in cv2.split(padded)]
    line = np.flatnonzero((labels < 1) & inside)
    while len(line):
        neighbours = [line + offset for offset in (-1, 1, -width, width)]
        labels_there = np.stack([flat[there] for there in neighbours])
        distance = np.stack([sum(np.abs(channel[there] - channel[line]) for channel in channels) for there in neighbours])
        distance[labels_there < 1] = np.iinfo(np.int16).max
        flat[line] = np.take_along_axis(labels_there, distance.argmin(0)[None], 0)[0]
        line = line[flat[line] < 1]
    return labels[1:-1, 1:-1].astype(np.int64) - 1


def _borders(labels: Labels, gradient: NDArray[np.float32]) -> tuple[Labels, Labels, Array, Array]:
    """first, second, mean gradient and length of each border between 4-neighbouring labels."""
    keys, values = [], []
    for here, there in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        across = labels[here] != labels[there]
        a, b = labels[here][across], labels[there][across]
        keys.append(np.minimum(a, b) << 32 | np.maximum(a, b))
        values.append(np.maximum(gradient[here], gradient[there])[across])
    key, border = np.unique(np.concatenate(keys), return_inverse=True)
    length = np.bincount(border, minlength=len(key)).astype(np.float64)
    total = region_sum(border, np.concatenate(values), len(key))
    return key >> 32, key & 0xFFFFFFFF, total / length, length


def merge(partition: Partition, limit: float) -> list[Partition]:
    """Merges regions round by round, weakest borders first, until every border is stronger than `limit`.

    In a round each region looks at its weakest border; the weaker half of these borders falls. The strength is the colour
    distance plus the gradient along the border, weakened where one side is small.

    Returns:
        the partition after each round, the coarsest last; empty when nothing merges.
    """
    rounds = []
    while len(partition.first):
        area = partition.pixels / partition.pixels.sum()
        smaller = np.minimum(area[partition.first], area[partition.second])
        strength = (partition.contrast + partition.gradient) * smaller**0.25 * np.where(smaller < SMALL_REGION, 0.1, 1.0)
        weakest = np.full(len(area), np.inf)
        np.minimum.at(weakest, partition.first, strength)
        np.minimum.at(weakest, partition.second, strength)
        falls = (strength == weakest[partition.first]) | (strength == weakest[partition.second])
        falls &= strength <= min(limit, float(np.median(weakest)))
        if not falls.any():
            break
        partition = _joined(partition, falls)
        rounds.append(partition)
    return rounds


def _joined(partition: Partition, falls: NDArray[np.bool_]) -> Partition:
    """The partition without the borders in `falls`."""
    a, b = partition.first[falls], partition.second[falls]
    root = np.arange(len(partition.pixels))
    while not np.array_equal(root[a], root[b]):  # the smallest index of each connected group spreads
        np.minimum.at(root, a, root[b])
        np.minimum.at(root, b, root[a])
        root = root[root]
    merged = np.unique(root, return_inverse=True)[1].reshape(-1)
    pixels = region_sum(merged, partition.pixels)
    colour = np.stack([region_mean(merged, channel, partition.pixels) for channel in partition.colour.T], 1)
    first, second = merged[partition.first], merged[partition.second]
    stays = first != second
    key = np.minimum(first, second)[stays] << 32 | np.maximum(first, second)[stays]
    key, border = np.unique(key, return_inverse=True)
    length = region_sum(border, partition.length[stays], len(key))
    gradient = region_sum(border, (partition.gradient * partition.length)[stays], len(key)) / length
    return Partition(merged[partition.region_of], pixels, colour, key >> 32, key & 0xFFFFFFFF, gradient, length)
