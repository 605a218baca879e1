"""Pieces of IGEV-Stereo in plain loops: the cost volume, the geometry lookup, the upsampling by the context, the regression."""

from __future__ import annotations

import math

import numpy as np

from tests.oracles_raft_stereo import value_at


def groupwise_correlation(left: np.ndarray, right: np.ndarray, disparities: int, groups: int) -> np.ndarray:
    """Features [C, H, W] of both views to [groups, disparities, H, W]: means of products over each group; 0 beside the image."""
    channels, height, width = left.shape
    size = channels // groups
    volume = np.zeros((groups, disparities, height, width))
    for g, d, y, x in np.ndindex(volume.shape):
        if x - d >= 0:
            volume[g, d, y, x] = sum(float(left[c, y, x] * right[c, y, x - d]) for c in range(g * size, (g + 1) * size)) / size
    return volume


def halve(row: np.ndarray) -> np.ndarray:
    """Means of two neighbours; an odd last one is dropped."""
    return np.array([(row[2 * i] + row[2 * i + 1]) / 2 for i in range(len(row) // 2)])


def geometry_encoding(
    volume: np.ndarray, left: np.ndarray, right: np.ndarray, disparity: np.ndarray, levels: int, radius: int
) -> np.ndarray:
    """Volume [C, D, H, W], features [F, H, W] and disparity [H, W] to [levels * (C + 1) * (2 radius + 1), H, W]."""
    channels, _, height, width = volume.shape
    offsets = range(-radius, radius + 1)
    found = np.zeros((levels * (channels + 1) * len(offsets), height, width))
    for y, x in np.ndindex(height, width):
        curves = [volume[c, :, y, x] for c in range(channels)]
        correlation = np.array([float(left[:, y, x] @ right[:, y, other]) for other in range(width)])
        values = []
        for level in range(levels):
            for curve in curves:
                values += [value_at(curve, disparity[y, x] / 2**level + offset) for offset in offsets]
            values += [value_at(correlation, (x - disparity[y, x]) / 2**level + offset) for offset in offsets]
            curves, correlation = [halve(curve) for curve in curves], halve(correlation)
        found[:, y, x] = values
    return found


def context_upsample(disparity: np.ndarray, logits: np.ndarray, factor: int) -> np.ndarray:
    """Disparity [h, w], logits [9, h factor, w factor] of each fine pixel's coarse neighbours to [h factor, w factor]."""
    height, width = disparity.shape
    fine = np.zeros(logits.shape[1:])
    for y, x in np.ndindex(fine.shape):
        weights = np.exp(logits[:, y, x])
        weights /= weights.sum()
        for k in range(9):
            ny, nx = y // factor + k // 3 - 1, x // factor + k % 3 - 1
            if 0 <= ny < height and 0 <= nx < width:
                fine[y, x] += weights[k] * factor * disparity[ny, nx]
    return fine


def expected_disparity(scores: np.ndarray) -> np.ndarray:
    """Scores [D, H, W] to [H, W]."""
    result = np.zeros(scores.shape[1:])
    for y, x in np.ndindex(result.shape):
        likelihoods = [math.exp(score) for score in scores[:, y, x]]
        result[y, x] = sum(d * likelihood for d, likelihood in enumerate(likelihoods)) / sum(likelihoods)
    return result
