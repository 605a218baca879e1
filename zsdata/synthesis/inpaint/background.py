"""Random background: holes show another photo in this one's colours, as in MfS-Stereo (Watson et al., ECCV 2020)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

STEPS_PER_LEVEL = 16  # statistics are taken of whole sixteenths of a grey level, so that integer sums are exact in any order


class RandomBackground:
    """Fills the holes of right views with another photo, after colour transfer (Reinhard et al. 2001: mean and deviation per channel).

    The transfer is done in RGB, not in a perceptual space: a linear map, whose statistics are exact on every device and in every batch.
    """

    needs = ("background",)

    def __call__(
        self,
        right: Tensor,
        inpaint_mask: Tensor,
        generators: Sequence[np.random.Generator | None] | None = None,
        background: Tensor | None = None,
    ) -> Tensor:
        """Returns `right` with its holes filled; known pixels are unchanged bit for bit.

        Args:
            right: float [B, C, H, W], RGB 0..255, anything in the holes.
            inpaint_mask: bool [B, 1, H, W], True in the holes.
            generators: one for each sample, or None; only used without `background`.
            background: float [B, C, H, W], RGB 0..255, another photo for each sample. Without it the image itself serves, mirrored and
                rolled by an offset that the sample's generator draws, or by half of its size without a generator; its own holes have
                its mean colour.

        Raises:
            ValueError: for shapes or dtypes that do not fit.
        """
        _check(right, inpaint_mask, generators, background)
        known = ~inpaint_mask
        mean, deviation = _statistics(right, known)
        if background is None:
            itself = torch.where(known, right, mean.to(right.dtype)).flip(-1)
            background = torch.stack([_rolled(image, generators[i] if generators else None) for i, image in enumerate(itself)])
        background_mean, background_deviation = _statistics(background, torch.ones_like(known))
        gain = torch.where(background_deviation > 0, deviation / background_deviation, 1)
        nothing_known = ~known.flatten(1).any(1).view(-1, 1, 1, 1)
        gain = torch.where(nothing_known, 1, gain).to(background.dtype)
        mean = torch.where(nothing_known, background_mean, mean).to(background.dtype)
        transferred = (background - background_mean.to(background.dtype)) * gain + mean
        return torch.where(inpaint_mask, transferred.clamp(0, 255).to(right.dtype), right)


def _statistics(images: Tensor, counted: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of each image's channels over `counted` [B, 1, H, W], float64 [B, C, 1, 1]; 0 where nothing counts."""
    levels = (images * STEPS_PER_LEVEL).round().long().masked_fill(~counted, 0)
    count = counted.sum((2, 3), keepdim=True).clamp(min=1)
    total, squares = levels.sum((2, 3), keepdim=True), (levels * levels).sum((2, 3), keepdim=True)
    mean = total.double() / count
    variance = (squares.double() / count - mean * mean).clamp(min=0)
    return mean / STEPS_PER_LEVEL, variance.sqrt() / STEPS_PER_LEVEL


def _rolled(image: Tensor, generator: np.random.Generator | None) -> Tensor:
    height, width = image.shape[-2:]
    offset = (height // 2, width // 2) if generator is None else (int(generator.integers(height)), int(generator.integers(width)))
    return image.roll(offset, (-2, -1))


def _check(right: Tensor, inpaint_mask: Tensor, generators: Sequence[np.random.Generator | None] | None, background: Tensor | None) -> None:
    if right.ndim != 4 or not right.is_floating_point():
        raise ValueError(f"right is a float [B, C, H, W] image; got {right.dtype} {list(right.shape)}")
    expected = [right.shape[0], 1, *right.shape[2:]]
    if list(inpaint_mask.shape) != expected or inpaint_mask.dtype != torch.bool:
        raise ValueError(f"inpaint_mask is bool {expected}, True in the holes; got {inpaint_mask.dtype} {list(inpaint_mask.shape)}")
    if generators is not None and len(generators) != len(right):
        raise ValueError(f"generators has one entry for each of {len(right)} samples; got {len(generators)}")
    if background is not None and background.shape != right.shape:
        raise ValueError(f"background has the shape of right, {list(right.shape)}; got {list(background.shape)}")
