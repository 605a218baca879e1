"""What a matcher is judged by: the errors of one disparity map, over the pixels that have a ground truth.

Each function takes tensors of one shape, counts the pixels where `valid` is True, and averages in float64. A picture without a valid
pixel has no error: the result is NaN, for the caller to leave out of a mean over pictures (and to count).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

# KITTI 2015: a pixel is an outlier where it is off by more than 3 px and by more than 5 % of the true disparity.
D1_PIXELS = 3.0
D1_SHARE = 0.05


def end_point_error(prediction: Tensor, disparity: Tensor, valid: Tensor) -> float:
    """Mean absolute error in pixels.

    Args:
        prediction, disparity: pixels, floating point, any shape. Not looked at where `valid` is False.
        valid: bool, True where the disparity is known (and asked for).
    Returns:
        >= 0, or NaN without a valid pixel.
    Raises:
        ValueError, TypeError: shapes that differ, a mask that is not bool, a value that is not finite at a valid pixel.
    """
    return _mean(_errors(prediction, disparity, valid)[0])


def bad_pixel_rate(prediction: Tensor, disparity: Tensor, valid: Tensor, threshold_px: float) -> float:
    """Share in 0..1 of the pixels that are off by more than `threshold_px` ("bad-1" for 1); otherwise as `end_point_error`."""
    if not threshold_px > 0:
        raise ValueError(f"threshold_px is positive; got {threshold_px}")
    return _mean(_errors(prediction, disparity, valid)[0] > threshold_px)


def d1(prediction: Tensor, disparity: Tensor, valid: Tensor) -> float:
    """Share in 0..1 of KITTI's outliers: off by more than 3 px and by more than 5 %; otherwise as `end_point_error`."""
    errors, truth = _errors(prediction, disparity, valid)
    return _mean((errors > D1_PIXELS) & (errors > D1_SHARE * truth.abs()))


def _errors(prediction: Tensor, disparity: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Absolute errors and true disparities of the valid pixels, float64."""
    if not prediction.shape == disparity.shape == valid.shape:
        raise ValueError(
            f"prediction, disparity and valid have one shape; got {list(prediction.shape)}, {list(disparity.shape)} and {list(valid.shape)}"
        )
    if valid.dtype != torch.bool:
        raise TypeError(f"valid is bool; got {valid.dtype}")
    estimate, truth = prediction[valid].double(), disparity[valid].double()
    for name, values in (("prediction", estimate), ("disparity", truth)):
        broken = int((~values.isfinite()).sum())
        if broken:
            raise ValueError(f"{name} is not finite at {broken} of {values.numel()} valid pixels")
    return (estimate - truth).abs(), truth


def _mean(values: Tensor) -> float:
    return values.double().mean().item() if values.numel() else math.nan
