"""What a matcher is judged by: the errors of one disparity map, over the pixels that have a ground truth.

Each function takes tensors of one shape, counts the pixels where `valid` is True, and averages in float64. A picture without a valid
pixel has no error: the result is NaN, for the caller to leave out of a mean over pictures (and to count).
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

# KITTI 2015: a pixel is an outlier where it is off by more than 3 px and by more than 5 % of the true disparity.
D1_PIXELS = 3.0
D1_SHARE = 0.05

# An edge of the scene: neighbouring points whose true disparities differ by more than a sloping surface's do.
EDGE_JUMP_PX = 2.0
EDGE_REACH_PX = 4  # laser ground truth has a value every few pixels; points further apart say nothing about what lies between
EDGE_MARGIN_PX = 5  # matchers blur and fatten edges by about this much


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


def disparity_edges(
    disparity: Tensor,
    valid: Tensor,
    *,
    jump_px: float = EDGE_JUMP_PX,
    reach_px: int = EDGE_REACH_PX,
    margin_px: int = EDGE_MARGIN_PX,
) -> Tensor:
    """Where the scene has a depth edge: "errors on edges" are those of the valid pixels in here.

    A discontinuity lies between two known pixels of one row or column that have no other known pixel between them, stand at most
    `reach_px` apart and differ in true disparity by more than `jump_px`. The region is every pixel within `margin_px`, counted in rows
    and columns alike (a square), of either of the two.

    Args:
        disparity: the ground truth in pixels, floating point, [..., H, W]. Not looked at where `valid` is False.
        valid: bool, as large, True where it is known.
    Returns:
        bool, as large; also True for pixels in the region that are not valid.
    Raises:
        ValueError, TypeError: shapes that differ, a mask that is not bool, a number out of range.
    """
    if disparity.shape != valid.shape or disparity.ndim < 2:
        raise ValueError(f"disparity and valid have one shape [..., H, W]; got {list(disparity.shape)} and {list(valid.shape)}")
    if valid.dtype != torch.bool:
        raise TypeError(f"valid is bool; got {valid.dtype}")
    if not jump_px > 0 or reach_px < 1 or margin_px < 0:
        raise ValueError(f"jump_px is positive, reach_px at least 1, margin_px at least 0; got {jump_px}, {reach_px} and {margin_px}")
    jumps = _row_jumps(disparity, valid, jump_px, reach_px) | _row_jumps(disparity.mT, valid.mT, jump_px, reach_px).mT
    planes = jumps.reshape(-1, 1, *jumps.shape[-2:]).float()
    return F.max_pool2d(planes, 2 * margin_px + 1, stride=1, padding=margin_px).bool().reshape(jumps.shape)


def _row_jumps(disparity: Tensor, valid: Tensor, jump_px: float, reach_px: int) -> Tensor:
    """bool: both ends of every discontinuity along the last axis."""
    ends = torch.zeros_like(valid)
    for step in range(1, min(reach_px, valid.shape[-1] - 1) + 1):
        neighbours = valid[..., :-step] & valid[..., step:]
        for between in range(1, step):
            neighbours &= ~valid[..., between : between - step]
        jump = neighbours & ((disparity[..., step:] - disparity[..., :-step]).abs() > jump_px)
        ends[..., :-step] |= jump
        ends[..., step:] |= jump
    return ends


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
