"""What is known of a photo's depth, whatever is drawn from it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from zsdata.synthesis.confidence import flip_confidence, flip_consistency, normalize_inverse_depth

NEAREST = 65_535  # the inverse depth of the photo's nearest point; a step is 1/500 px of the largest disparity that any photo is given
CERTAIN = 255  # the confidence of a label that is trusted entirely


class DepthMaps(NamedTuple):
    """Depth of photos as whole numbers, so that it can be kept and comes back bit for bit.

    Attributes:
        inverse_depth: uint16 [B, 1, h, w], 0 (farthest) to NEAREST.
        confidence: uint8 [B, 1, h, w], 0 to CERTAIN.
        consistency: float64 [B], the mean flip consistency before normalisation.
        first_row: of the maps in the photo, where they are a part of it.
    """

    inverse_depth: Tensor
    confidence: Tensor
    consistency: Tensor
    first_row: int = 0


def depth_maps(estimate: Tensor, mirrored: Tensor | None) -> DepthMaps:
    """What is known from inverse depth, float [B, 1, h, w], and, in the same frame, that of the mirrored photo.

    Without the latter every label has confidence 1.
    """
    inverse_depth = normalize_inverse_depth(estimate)
    if mirrored is None:
        confidence = torch.full_like(inverse_depth, CERTAIN, dtype=torch.uint8)
        consistency = torch.ones(len(inverse_depth), dtype=torch.float64)
    else:
        mirrored = normalize_inverse_depth(mirrored)
        confidence = (flip_confidence(inverse_depth, mirrored) * CERTAIN).round_().int().to(torch.uint8)
        consistency = flip_consistency(inverse_depth, mirrored)
    return DepthMaps((inverse_depth * NEAREST).round_().int().to(torch.uint16), confidence, consistency)
