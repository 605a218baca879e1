"""The ZeroStereo loss as the paper writes it: numpy, float64, one pixel at a time."""

from __future__ import annotations

import math

import numpy as np


def warp_pixel(image: np.ndarray, y: int, column: float) -> np.ndarray:
    """Linear interpolation in row y of an image [C, H, W]; beside the image its first or last column."""
    column = min(max(column, 0.0), image.shape[2] - 1.0)
    low = math.floor(column)
    high = min(low + 1, image.shape[2] - 1)
    return (high - column) * image[:, y, low] + (column - low) * image[:, y, high] if high > low else image[:, y, low]


def backward_warp(image: np.ndarray, disparity: np.ndarray) -> np.ndarray:
    """image [C, H, W], disparity [H, W] -> [C, H, W]."""
    _, height, width = image.shape
    return np.stack([np.stack([warp_pixel(image, y, x - disparity[y, x]) for x in range(width)], 1) for y in range(height)], 1)


def ssim_pixel(first: np.ndarray, second: np.ndarray) -> float:
    """SSIM of two windows [7, 7] in 0..1."""
    mean_1, mean_2 = first.mean(), second.mean()
    variance_1, variance_2 = ((first - mean_1) ** 2).mean(), ((second - mean_2) ** 2).mean()
    covariance = ((first - mean_1) * (second - mean_2)).mean()
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_1 * mean_2 + c1) / (mean_1**2 + mean_2**2 + c1)
    return luminance * (2 * covariance + c2) / (variance_1 + variance_2 + c2)


def photometric_loss(left: np.ndarray, right: np.ndarray, disparity: np.ndarray, beta: float) -> np.ndarray:
    """L_p [H, W] of images [C, H, W] in 0..1."""
    reconstruction = backward_warp(right, disparity)
    border = ((0, 0), (3, 3), (3, 3))
    a, b = np.pad(left, border, mode="reflect"), np.pad(reconstruction, border, mode="reflect")
    result = np.zeros(disparity.shape)
    for y, x in np.ndindex(disparity.shape):
        for c in range(len(left)):
            ssim = ssim_pixel(a[c, y : y + 7, x : x + 7], b[c, y : y + 7, x : x + 7])
            result[y, x] += beta * min(max((1 - ssim) / 2, 0), 1) / len(left)
            result[y, x] += (1 - beta) * abs(left[c, y, x] - reconstruction[c, y, x]) / len(left)
    return result


def smooth_l1(error: float) -> float:
    return 0.5 * error**2 if abs(error) < 1 else abs(error) - 0.5


def zero_stereo_loss(
    predictions, left, right, disparity, confidence, nonocclusion, inpaint, valid, initial, gamma, mu, beta, max_disparity
) -> float:
    """L_Zero; images [B, 3, H, W] in 0..255, maps [B, H, W], predictions a list of maps."""

    def one(prediction, distance) -> float:
        disparity_terms, photometric_terms = [], []
        for b in range(len(left)):
            photometric = photometric_loss(left[b] / 255, right[b] / 255, prediction[b], beta)
            height, width = photometric.shape
            for y, x in np.ndindex(height, width):
                d, c = disparity[b, y, x], confidence[b, y, x]
                if valid[b, y, x] and d < max_disparity:
                    disparity_terms.append(c * distance(prediction[b, y, x] - d))
                if nonocclusion[b, y, x] and math.isfinite(d):
                    seen_at = round(x - d)
                    if 0 <= seen_at < width and not inpaint[b, y, seen_at]:
                        photometric_terms.append((1 - c) * photometric[y, x])
        return _mean(disparity_terms) + mu * _mean(photometric_terms)

    n = len(predictions)
    total = one(initial, smooth_l1) if initial is not None else 0.0
    for i, prediction in enumerate(predictions):
        total += (gamma ** (15 * (n - 1 - i) / (n - 1)) if n > 1 else 1.0) * one(prediction, abs)
    return total


def _mean(values: list[float]) -> float:
    return math.fsum(values) / len(values) if values else 0.0
