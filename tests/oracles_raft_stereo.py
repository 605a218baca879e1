"""Pieces of RAFT-Stereo in plain loops: the correlation, its lookup, the convex upsampling."""

from __future__ import annotations

import math

import numpy as np


def correlation_volume(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Features [C, H, W] of both views to [H, W, W]: scalar products of left (y, x) and right (y, x'), over sqrt(C)."""
    channels, height, width = left.shape
    volume = np.zeros((height, width, right.shape[2]))
    for y, x, other in np.ndindex(volume.shape):
        volume[y, x, other] = float(left[:, y, x] @ right[:, y, other]) / math.sqrt(channels)
    return volume


def halve(volume: np.ndarray) -> np.ndarray:
    """Means of two neighbouring right columns; an odd last one is dropped."""
    height, width, others = volume.shape
    result = np.zeros((height, width, others // 2))
    for y, x, i in np.ndindex(result.shape):
        result[y, x, i] = (volume[y, x, 2 * i] + volume[y, x, 2 * i + 1]) / 2
    return result


def value_at(row: np.ndarray, position: float) -> float:
    """Linear between the entries of a row, 0 beside it."""
    low = math.floor(position)
    weight = position - low

    def entry(i: int) -> float:
        return float(row[i]) if 0 <= i < len(row) else 0.0

    return (1 - weight) * entry(low) + weight * entry(low + 1)


def lookup(left: np.ndarray, right: np.ndarray, columns: np.ndarray, levels: int, radius: int) -> np.ndarray:
    """Correlations [levels * (2 radius + 1), H, W] around columns [H, W]."""
    volume = correlation_volume(left, right)
    found = []
    for level in range(levels):
        for offset in range(-radius, radius + 1):
            plane = np.zeros(columns.shape)
            for y, x in np.ndindex(columns.shape):
                plane[y, x] = value_at(volume[y, x], columns[y, x] / 2**level + offset)
            found.append(plane)
        volume = halve(volume)
    return np.stack(found)


def convex_upsample(flow: np.ndarray, logits: np.ndarray, factor: int) -> np.ndarray:
    """flow [h, w], logits [9 factor^2, h, w] to [h factor, w factor]."""
    height, width = flow.shape
    logits = logits.reshape(9, factor, factor, height, width)
    fine = np.zeros((height * factor, width * factor))
    for y, x, i, j in np.ndindex(height, width, factor, factor):
        weights = np.exp(logits[:, i, j, y, x])
        weights /= weights.sum()
        for k in range(9):
            ny, nx = y + k // 3 - 1, x + k % 3 - 1
            if 0 <= ny < height and 0 <= nx < width:
                fine[y * factor + i, x * factor + j] += weights[k] * factor * flow[ny, nx]
    return fine
