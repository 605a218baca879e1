"""What matchers and pairs are judged by: the errors of a disparity map against its truth, and of the left image against the right one.

All are means in float64 over the pixels where a mask is True. A picture without such a pixel has no error: the result is NaN, for the
caller to leave out of a mean over pictures (and to count).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from zsdata.losses import SSIM_WINDOW_PX, structural_similarity
from zsdata.synthesis.backward_warp import backward_warp

# KITTI 2015: a pixel is an outlier where it is off by more than 3 px and by more than 5 % of the true disparity.
D1_PIXELS = 3.0
D1_SHARE = 0.05

# An edge of the scene: neighbouring points whose true disparities differ by more than a sloping surface's do.
EDGE_JUMP_PX = 2.0
EDGE_REACH_PX = 4  # laser ground truth has a value every few pixels; points further apart say nothing about what lies between
EDGE_MARGIN_PX = 5  # matchers blur and fatten edges by about this much

SSIM_SHARE = 0.85  # beta of the photometric loss, whose value the paper's table of reconstructions gives


class Reconstruction(NamedTuple):
    """How close the left image comes, looked up in the right one (paper, supplement, table "Reconstruction loss"), for images in 0..1.

    As maps float32 [B, 1, H, W], as means float64 [B].

    Attributes:
        abs_err: |left - reconstruction|, mean over the colours.
        ssim: structural similarity of each pixel's neighbourhood (see `zsdata.losses.structural_similarity`), mean over the colours.
        photometric: 0.85 (1 - ssim) / 2 + 0.15 abs_err.
    """

    abs_err: Tensor
    ssim: Tensor
    photometric: Tensor


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


def reconstruction_maps(left: Tensor, right: Tensor, disparity: Tensor) -> Reconstruction:
    """The three measures at every pixel of the left image, for a caller who averages over several masks.

    The reconstruction is `backward_warp`'s: bilinear, the border repeated. SSIM sees its neighbourhood whole, so within 3 px of a
    pixel that cannot be reconstructed it is lower.

    Args:
        left, right: [B, 3, H, W], 0..255, H and W at least 4.
        disparity: [B, 1, H, W] floating point, pixels, left view.
    Raises:
        ValueError: images of another shape than the disparity's, or smaller than that; a disparity that is not finite.
    """
    if not left.shape == right.shape or left.ndim != 4 or min(left.shape[2:]) <= SSIM_WINDOW_PX // 2:
        raise ValueError(
            f"left and right have one shape [B, 3, H, W], at least {SSIM_WINDOW_PX // 2 + 1} px each way; "
            f"got {list(left.shape)} and {list(right.shape)}"
        )
    if not disparity.isfinite().all():  # SSIM would spread it to the pixels around
        raise ValueError("disparity must be finite everywhere; where it is not known give 0, and a mask that leaves these pixels out")
    left, reconstruction = left.float() / 255, backward_warp(right.float() / 255, disparity.float())
    abs_err = (left - reconstruction).abs().mean(1, keepdim=True)
    ssim = structural_similarity(left, reconstruction).mean(1, keepdim=True)
    return Reconstruction(abs_err, ssim, SSIM_SHARE * (1 - ssim) / 2 + (1 - SSIM_SHARE) * abs_err)


def reconstruction_error(left: Tensor, right: Tensor, disparity: Tensor, mask: Tensor | None = None) -> Reconstruction:
    """Each image's means of `reconstruction_maps`: how well a pair and its label (or a matcher's estimate) fit together.

    Args:
        left, right, disparity: as there; `left_clean` and `right_clean` of a batch.
        mask: bool [B, 1, H, W], left view: the pixels that count; None: all. SSIM sees up to 3 px beyond them.
    Returns:
        float64 [B] each; NaN for an image without a pixel that counts.
    Raises:
        ValueError, TypeError: shapes that differ, a mask that is not bool.
    """
    maps = reconstruction_maps(left, right, disparity)
    if mask is None:
        return Reconstruction(*(values.double().mean((1, 2, 3)) for values in maps))
    if mask.dtype != torch.bool:
        raise TypeError(f"mask is bool; got {mask.dtype}")
    if mask.shape != disparity.shape:
        raise ValueError(f"mask and disparity have one shape; got {list(mask.shape)} and {list(disparity.shape)}")
    count = mask.sum((1, 2, 3))
    return Reconstruction(*(torch.where(mask, values, 0.0).double().sum((1, 2, 3)) / count for values in maps))


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
