"""Training-Free Confidence Generation: a depth estimate is trusted where the mirrored photo gives the same one."""

from __future__ import annotations

import torch
from torch import Tensor


def normalize_inverse_depth(inverse_depth: Tensor) -> Tensor:
    """Brings each map to 0..1 by its own minimum and maximum: 0 is the farthest point of the photo, 1 the nearest.

    Args:
        inverse_depth: float [B, 1, H, W], any scale and offset, larger is nearer.

    Returns:
        float32 [B, 1, H, W] in [0, 1]. A flat map (one value everywhere) gives 0 everywhere.

    Raises:
        ValueError: where a value is not finite.
    """
    inverse_depth = inverse_depth.float()
    low = inverse_depth.amin((1, 2, 3), keepdim=True)
    extent = inverse_depth.amax((1, 2, 3), keepdim=True) - low
    if not torch.isfinite(extent).all():
        raise ValueError(
            "inverse depth must be finite; got NaN or infinity. An estimator may overflow in half precision, fp16 above all: let it "
            'compute in float32 (DepthNetwork: dtype="float32")'
        )
    return ((inverse_depth - low) / torch.where(extent > 0, extent, 1.0)).clamp_(0, 1)


def flip_confidence(inverse_depth: Tensor, mirrored: Tensor) -> Tensor:
    """Confidence C of the paper (section "Training-Free Confidence Generation"): u = 1 - |D - D'|, brought to 0..1 by its extremes.

    Args:
        inverse_depth: float [B, 1, H, W] in [0, 1], normalised, of the photo.
        mirrored: the same for the mirrored photo, already mirrored back.

    Returns:
        float32 [B, 1, H, W] in [0, 1]; 1 everywhere where both maps agree to the same degree everywhere.
    """
    if inverse_depth.shape != mirrored.shape:
        raise ValueError(f"both maps must have one shape; got {list(inverse_depth.shape)} and {list(mirrored.shape)}")
    difference = (inverse_depth.float() - mirrored.float()).abs_()
    low = difference.amin((1, 2, 3), keepdim=True)
    high = difference.amax((1, 2, 3), keepdim=True)
    return ((high - difference) / torch.where(high > low, high - low, 1.0)).masked_fill(high <= low, 1.0).clamp_(0, 1)


def flip_consistency(inverse_depth: Tensor, mirrored: Tensor) -> Tensor:
    """How much of a whole photo's depth survives mirroring: the mean of u = 1 - |D - D'| before it is normalised; float64 [B]."""
    return 1 - (inverse_depth.double() - mirrored.double()).abs().mean((1, 2, 3))
