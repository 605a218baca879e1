"""The ZeroStereo loss: the label where it can be trusted, the photograph where it cannot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from zsdata.sample import Masks
from zsdata.synthesis.backward_warp import backward_warp

SSIM_WINDOW_PX = 7
# (0.01 L)^2 and (0.03 L)^2 of the SSIM paper for images in 0..1, that is L = 1.
SSIM_MEAN_CONSTANT = 0.01**2
SSIM_VARIANCE_CONSTANT = 0.03**2
# RAFT-Stereo tunes gamma for 16 predictions and stretches it over however many there are.
GAMMA_STEPS = 15


def zero_stereo_loss(
    predictions: Sequence[Tensor],
    left_clean: Tensor,
    right_clean: Tensor,
    disparity: Tensor,
    confidence: Tensor,
    masks: Masks,
    initial_prediction: Tensor | None = None,
    gamma: float = 0.9,
    mu: float = 0.1,
    beta: float = 0.85,
    max_disparity: float = 700,
) -> tuple[Tensor, dict[str, Tensor]]:
    """L_Zero of the paper (section "Stereo Training"), summed over the predictions of an iterative matcher.

    For one prediction: mean over `valid` of C L_d, plus mu times the mean over the known, non-occluded pixels of (1 - C) L_p.
    Prediction i of n weighs g^(n - 1 - i) with g = gamma^(15 / (n - 1)), as in RAFT-Stereo. An initial prediction (IGEV-Stereo's
    regression of the cost volume) adds the same sum once more with weight 1 and a smooth L1 (beta 1) for L_d.

    Args:
        predictions: n >= 1 disparities [B, 1, H, W] in pixels, positive, first iteration first.
        left_clean, right_clean: the pair before augmentation, [B, 3, H, W], 0..255 (the photometric term is computed on 0..1).
        disparity: the label, [B, 1, H, W], pixels, left view. Not looked at where `masks.valid` is False, NaN and inf included.
        confidence: C, [B, 1, H, W], 0..1, left view.
        masks: bool [B, 1, H, W]: nonocclusion (left view), inpaint (right view), valid (left view); see `zsdata.sample`.
        initial_prediction: [B, 1, H, W] or None.
        gamma: how much less an early prediction counts, in (0, 1].
        mu: weight of the photometric term, >= 0; with 0 that term is not computed.
        beta: share of SSIM in the photometric term, in [0, 1].
        max_disparity: labels of this many pixels or more do not supervise.
    Returns:
        The loss, a scalar that `backward()` works on even where every mask is empty (an empty mask contributes 0), and detached
        scalars to log: "epe" (px), "bad_1", "bad_3" (shares in 0..1) of the last prediction over the supervised pixels;
        "disparity_term" and "photometric_term" of the last prediction, "initial_term" where there is one.
    Raises:
        ValueError, TypeError: no prediction, a shape or a mask dtype that does not fit, an option out of its range.
    """
    _check(predictions, left_clean, right_clean, disparity, confidence, masks, initial_prediction, gamma, mu, beta)
    left_clean, right_clean = left_clean.float() / 255, right_clean.float() / 255
    supervised = masks.valid & (disparity < max_disparity)  # False for NaN too
    # A label that does not supervise is replaced before it meets a prediction: masking afterwards would leave NaN in the gradient.
    label = torch.where(supervised, disparity, 0.0).float()
    confidence = torch.where(masks.valid, confidence, confidence.nan_to_num(0.0, 0.0, 0.0)).float()
    known = backward_warp(~masks.inpaint, disparity, mode="nearest", padding="zeros")
    photometric_mask = masks.nonocclusion & known

    def weighted_photometric_loss(prediction: Tensor) -> Tensor:
        photometric = photometric_loss(left_clean, backward_warp(right_clean, prediction), beta)
        return mu * _masked_mean((1 - confidence) * photometric, photometric_mask)

    def photometric_term(prediction: Tensor) -> Tensor:
        if mu == 0:
            return prediction.new_zeros(())
        # Made anew in the backward pass: the maps behind 22 SSIMs would fill gigabytes, and cost next to nothing beside a matcher.
        term = checkpoint(weighted_photometric_loss, prediction, use_reentrant=False, preserve_rng_state=False)
        return cast(Tensor, term)

    loss = label.new_zeros(())
    disparity_term = photometric = label.new_zeros(())
    for prediction, weight in zip(predictions, sequence_weights(len(predictions), gamma), strict=True):
        prediction = prediction.float()
        disparity_term = _masked_mean(confidence * (prediction - label).abs(), supervised)
        photometric = photometric_term(prediction)
        loss = loss + weight * (disparity_term + photometric)
    metrics = _last_prediction_metrics(predictions[-1].detach().float(), label, supervised)
    metrics |= {"disparity_term": disparity_term.detach(), "photometric_term": photometric.detach()}
    if initial_prediction is not None:
        initial_prediction = initial_prediction.float()
        error = F.smooth_l1_loss(initial_prediction, label, reduction="none")
        initial_term = _masked_mean(confidence * error, supervised) + photometric_term(initial_prediction)
        loss = loss + initial_term
        metrics["initial_term"] = initial_term.detach()
    return loss, metrics


def photometric_loss(left: Tensor, reconstruction: Tensor, beta: float = 0.85) -> Tensor:
    """L_p of the paper: beta (1 - SSIM) / 2 + (1 - beta) L1, each averaged over the colours.

    Args:
        left, reconstruction: [B, C, H, W], 0..1, H and W at least 4.
        beta: share of SSIM, in [0, 1].
    Returns:
        [B, 1, H, W], 0..1.
    """
    dissimilarity = ((1 - structural_similarity(left, reconstruction)) / 2).clamp(0, 1)
    difference = (left - reconstruction).abs()
    return beta * dissimilarity.mean(1, keepdim=True) + (1 - beta) * difference.mean(1, keepdim=True)


def structural_similarity(first: Tensor, second: Tensor) -> Tensor:
    """SSIM of each pixel's 7x7 neighbourhood (uniform window, reflected borders) for images [B, C, H, W] in 0..1."""

    def mean(image: Tensor) -> Tensor:
        margin = SSIM_WINDOW_PX // 2
        return F.avg_pool2d(F.pad(image, (margin,) * 4, mode="reflect"), SSIM_WINDOW_PX, stride=1)

    first_mean, second_mean = mean(first), mean(second)
    variances = mean(first * first) - first_mean**2 + mean(second * second) - second_mean**2
    covariance = mean(first * second) - first_mean * second_mean
    numerator = (2 * first_mean * second_mean + SSIM_MEAN_CONSTANT) * (2 * covariance + SSIM_VARIANCE_CONSTANT)
    return numerator / ((first_mean**2 + second_mean**2 + SSIM_MEAN_CONSTANT) * (variances + SSIM_VARIANCE_CONSTANT))


def sequence_weights(count: int, gamma: float) -> list[float]:
    """Weights of `count` predictions, the last one 1; the first one is gamma^15 whatever the count (a single one weighs 1)."""
    adjusted = gamma ** (GAMMA_STEPS / max(count - 1, 1))
    return [adjusted ** (count - 1 - i) for i in range(count)]


def _masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    return torch.where(mask, values, 0.0).sum() / mask.sum().clamp(min=1)


def _last_prediction_metrics(prediction: Tensor, label: Tensor, supervised: Tensor) -> dict[str, Tensor]:
    error = (prediction - label).abs()
    return {
        "epe": _masked_mean(error, supervised),
        "bad_1": _masked_mean((error > 1).float(), supervised),
        "bad_3": _masked_mean((error > 3).float(), supervised),
    }


def _check(
    predictions: Sequence[Tensor],
    left_clean: Tensor,
    right_clean: Tensor,
    disparity: Tensor,
    confidence: Tensor,
    masks: Masks,
    initial_prediction: Tensor | None,
    gamma: float,
    mu: float,
    beta: float,
) -> None:
    if isinstance(predictions, Tensor) or len(predictions) == 0:
        raise ValueError("predictions is a list of one or more disparities [B, 1, H, W]; put a single one in a list")
    if disparity.ndim != 4 or disparity.shape[1] != 1:
        raise ValueError(f"disparity is [B, 1, H, W]; got {list(disparity.shape)}")
    batch, _, height, width = disparity.shape
    maps = {f"predictions[{i}]": prediction for i, prediction in enumerate(predictions)}
    maps |= {"confidence": confidence} | {f"masks.{name}": mask for name, mask in masks._asdict().items()}
    if initial_prediction is not None:
        maps["initial_prediction"] = initial_prediction
    for name, value in maps.items():
        if value.shape != disparity.shape:
            raise ValueError(f"{name} has the shape of disparity, {list(disparity.shape)}; got {list(value.shape)}")
    for name, mask in masks._asdict().items():
        if mask.dtype != torch.bool:
            raise TypeError(f"masks.{name} is bool; got {mask.dtype}")
    for name, image in {"left_clean": left_clean, "right_clean": right_clean}.items():
        if image.ndim != 4 or image.shape[1] != 3 or image.shape[0] != batch or image.shape[2:] != disparity.shape[2:]:
            raise ValueError(f"{name} is [{batch}, 3, {height}, {width}], the size of disparity; got {list(image.shape)}")
    if mu > 0 and min(height, width) <= SSIM_WINDOW_PX // 2:
        raise ValueError(f"the photometric term needs at least {SSIM_WINDOW_PX // 2 + 1} px each way; got {height} x {width}")
    for name, value, fits, allowed in (
        ("gamma", gamma, 0 < gamma <= 1, "(0, 1]"),
        ("mu", mu, mu >= 0, "[0, inf)"),
        ("beta", beta, 0 <= beta <= 1, "[0, 1]"),
    ):
        if not fits:
            raise ValueError(f"{name} is in {allowed}; got {value}")
