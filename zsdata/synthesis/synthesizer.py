"""The synthesizer: the method section of the paper, step by step. The only file that knows their order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch.nn.functional as F
from torch import Tensor

from zsdata.field_types import check_types
from zsdata.meter import Meter
from zsdata.synthesis.depth import DepthEstimator
from zsdata.synthesis.depth.maps import CERTAIN, NEAREST, DepthMaps, depth_maps
from zsdata.synthesis.disparity import SMALLEST_DISPARITY_PX, dilate_disparity, sharpen_disparity
from zsdata.synthesis.view import View, view_map
from zsdata.synthesis.warp import forward_warp

INPAINT_CONTEXT_PX = 32  # a hole at the crop's right edge is filled from its background, which begins beyond that edge


class Synthesized(NamedTuple):
    """A pair before inpainting. The left view has the crop's size; the right view reaches INPAINT_CONTEXT_PX columns beyond its right edge.

    The fields are those of `StereoBatch` and `Warped`.
    """

    left: Tensor
    disparity: Tensor
    confidence: Tensor
    nonocclusion_mask: Tensor
    right: Tensor
    inpaint_mask: Tensor
    right_disparity: Tensor


@dataclass(frozen=True, kw_only=True)
class SynthesisConfig:
    """How depth becomes disparity."""

    dilate_px: int = 1  # the rim of an object moves with it (paper, supplement, "Forward Warping")
    flip_confidence: bool = True  # TCG; without it every label has confidence 1 and the mirrored photo needs no depth

    def __post_init__(self) -> None:
        check_types(self)
        if self.dilate_px < 0:
            raise ValueError(f"dilate_px is 0 or more; got {self.dilate_px}")


def estimate_depth(depth: DepthEstimator, photos: Tensor, config: SynthesisConfig) -> DepthMaps:
    """Depth of the photos and of the mirrored photos, and how far they agree.

    Args:
        depth: an estimator as `load_depth` returns it.
        photos: float32 [B, 3, h, w], RGB 0..255.
    """
    together = getattr(depth, "with_mirrored", None)
    if not config.flip_confidence:
        return depth_maps(_checked(depth(photos), photos), None)
    if together is not None:
        estimate, mirrored = (_checked(maps, photos) for maps in together(photos))
    else:
        estimate, mirrored = _checked(depth(photos), photos), _checked(depth(photos.flip(-1)), photos).flip(-1)
    return depth_maps(estimate, mirrored)


def predict_depth(depth: Any, prepared: Sequence[Tensor], sizes: Sequence[tuple[int, int]], config: SynthesisConfig) -> Iterator[DepthMaps]:
    """As `estimate_depth`, of photos of several sizes that an estimator with two halves has prepared elsewhere.

    Args:
        depth: an estimator with `predict` and `predict_mirrored`.
        prepared: what its `prepare` made of each photo.
        sizes: (height, width) of the photos.

    Returns:
        One map per photo. The network has done its work when this returns; each map is made when it is taken.
    """
    if config.flip_confidence:
        estimates: Iterator[tuple[Tensor, Tensor | None]] = depth.predict_mirrored(prepared, sizes)
    else:
        estimates = ((estimate, None) for estimate in depth.predict(prepared, sizes))
    return (depth_maps(*maps) for maps in estimates)


def synthesize(photo_view: Tensor, depth: DepthMaps, view: View, scale: float, config: SynthesisConfig, meter: Meter) -> Synthesized:
    """The right view of one photo's view, with holes, and both masks.

    Args:
        photo_view: uint8 [1, 3, height, width], RGB, the view's part of the photo, margin included.
        depth: of the photo, at least the rows that the view shows.
        view: where the crop lies in the photo.
        scale: disparity of the photo's nearest point as a share of its width.
        meter: counts the seconds of each step.
    """
    with meter.stage("disparity"):
        largest_px = scale * depth.inverse_depth.shape[-1] * view.scale_x
        disparity = view_map(depth.inverse_depth, view, depth.first_row).mul_(largest_px / NEAREST)
        disparity = dilate_disparity(disparity, config.dilate_px)
        confidence = view_map(depth.confidence, view, depth.first_row)[..., : view.width - view.margin].div(CERTAIN)
    with meter.stage("sharpen"):
        disparity = sharpen_disparity(disparity).clamp_(min=SMALLEST_DISPARITY_PX)
    with meter.stage("warp"):
        width = view.width - view.margin
        warped = forward_warp(photo_view, disparity, columns=min(width + INPAINT_CONTEXT_PX, view.width))

    missing = max(0, INPAINT_CONTEXT_PX - view.margin)  # the photo ends there: nothing is known of it
    return Synthesized(
        left=photo_view[..., :width],
        disparity=disparity[..., :width],
        confidence=confidence,
        nonocclusion_mask=warped.nonocclusion_mask[..., :width],
        right=F.pad(warped.right, (0, missing)) if missing else warped.right,
        inpaint_mask=F.pad(warped.inpaint_mask, (0, missing), value=True) if missing else warped.inpaint_mask,
        right_disparity=F.pad(warped.right_disparity, (0, missing)) if missing else warped.right_disparity,
    )


def _checked(inverse_depth: Any, photos: Tensor) -> Tensor:
    expected = (photos.shape[0], 1, *photos.shape[2:])
    if not isinstance(inverse_depth, Tensor):
        raise ValueError(f"the depth estimator must return a tensor, [B, 1, H, W] = {list(expected)}; got {type(inverse_depth).__name__}")
    if tuple(inverse_depth.shape) != expected:
        raise ValueError(f"the depth estimator must return [B, 1, H, W] = {list(expected)}; got {list(inverse_depth.shape)}")
    if inverse_depth.device != photos.device:
        raise ValueError(f"the depth estimator must return its maps on {photos.device}, where the photos are; got {inverse_depth.device}")
    return inverse_depth
