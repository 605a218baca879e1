"""The ZeroStereo loss: the label where it can be trusted, the photograph where it cannot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from zsdata.sample import Masks
from zsdata.synthesis.backward_warp import backward_warp

SSIM_WINDOW_PX = 7
# (0.01 L)^2 and (0.03 L)^2 of the SSIM paper for images in 0..1, that is L = 1.
SSIM_MEAN_CONSTANT = 0.01**2
SSIM_VARIANCE_CONSTANT = 0.03**2
# RAFT-Stereo tunes gamma for 16 predictions and stretches it over however many there are.
GAMMA_STEPS = 15
PHOTOMETRIC_TERMS = ("nonocclusion", "ordinary")


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
    photometric: str = "nonocclusion",
    mean_over_ranks: Callable[[Tensor], Tensor] | None = None,
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
        photometric: "nonocclusion" for (1 - C) L_np as above, or "ordinary" for the L_p of every pixel, neither weighed nor masked
            (the first row of the paper's loss analysis).
        mean_over_ranks: the mean of a tensor over all ranks, where several train one network: the means are then those of the pairs of
            all ranks together, as soon as gradients and values are averaged over the ranks. None: of this batch.
    Returns:
        The loss, a scalar that `backward()` works on even where every mask is empty (an empty mask contributes 0), and detached
        scalars to log: "epe" (px), "bad_1", "bad_3" (shares in 0..1) of the last prediction over the supervised pixels;
        "disparity_term" and "photometric_term" of the last prediction, "initial_term" where there is one.
    Raises:
        ValueError, TypeError: no prediction, a shape or a mask dtype that does not fit, an option out of its range.
    """
    _check(predictions, left_clean, right_clean, disparity, confidence, masks, initial_prediction, gamma, mu, beta, photometric)
    supervised = masks.valid & (disparity < max_disparity)  # False for NaN too
    # A label that does not supervise is replaced before it meets a prediction: masking afterwards would leave NaN in the gradient.
    label = torch.where(supervised, disparity, 0.0).float()
    confidence = torch.where(masks.valid, confidence, confidence.nan_to_num(0.0, 0.0, 0.0)).float()
    if photometric == "ordinary":
        judged, weight = torch.ones_like(supervised), torch.ones_like(confidence)
    else:
        judged, weight = masks.nonocclusion & backward_warp(~masks.inpaint, disparity, mode="nearest", padding="zeros"), 1 - confidence
    counts = torch.stack([supervised.sum(), judged.sum()]).float()
    if mean_over_ranks is not None:
        counts = mean_over_ranks(counts)
    supervised_count, judged_count = torch.where(counts > 0, counts, 1.0)

    def mean(values: Tensor) -> Tensor:
        return torch.where(supervised, values, 0.0).sum() / supervised_count

    photometric_weight = torch.where(judged, weight, 0.0) * (mu / judged_count)
    pair = _Pair.of(left_clean.float() / 255, right_clean.float() / 255, beta)

    def photometric_term(prediction: Tensor) -> Tensor:
        if mu == 0:
            return prediction.new_zeros(())
        return _with_its_gradient(lambda prediction: (photometric_weight * pair.photometric_loss(prediction)).sum(), prediction)

    loss = label.new_zeros(())
    disparity_term = photometric_value = label.new_zeros(())
    for prediction, prediction_weight in zip(predictions, sequence_weights(len(predictions), gamma), strict=True):
        prediction = prediction.float()
        disparity_term = mean(confidence * (prediction - label).abs())
        photometric_value = photometric_term(prediction)
        loss = loss + prediction_weight * (disparity_term + photometric_value)
    error = (predictions[-1].detach().float() - label).abs()
    metrics = {
        "epe": mean(error),
        "bad_1": mean((error > 1).float()),
        "bad_3": mean((error > 3).float()),
        "disparity_term": disparity_term.detach(),
        "photometric_term": photometric_value.detach(),
    }
    if initial_prediction is not None:
        initial_prediction = initial_prediction.float()
        error = F.smooth_l1_loss(initial_prediction, label, reduction="none")
        initial_term = mean(confidence * error) + photometric_term(initial_prediction)
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
    return _photometric_loss(_Statistics.of(left), reconstruction, beta)


def structural_similarity(first: Tensor, second: Tensor) -> Tensor:
    """SSIM of each pixel's 7x7 neighbourhood (uniform window, reflected borders) for images [B, C, H, W] in 0..1."""
    return _structural_similarity(_Statistics.of(first), second)


class _Statistics(NamedTuple):
    """An image, and the mean and variance of its windows: found once, whatever it is compared with."""

    image: Tensor
    mean: Tensor
    variance: Tensor

    @staticmethod
    def of(image: Tensor) -> _Statistics:
        mean, square_mean = window_means(torch.cat([image, image * image], dim=1)).chunk(2, dim=1)
        return _Statistics(image, mean, square_mean - mean**2)


class _Pair(NamedTuple):
    """A pair in 0..1, to judge disparities by."""

    left: _Statistics
    right: Tensor
    beta: float

    @staticmethod
    def of(left: Tensor, right: Tensor, beta: float) -> _Pair:
        return _Pair(_Statistics.of(left), right, beta)

    def photometric_loss(self, disparity: Tensor) -> Tensor:
        return _photometric_loss(self.left, backward_warp(self.right, disparity), self.beta)


def _photometric_loss(left: _Statistics, reconstruction: Tensor, beta: float) -> Tensor:
    dissimilarity = ((1 - _structural_similarity(left, reconstruction)) / 2).clamp(0, 1)
    difference = (left.image - reconstruction).abs()
    return (beta * dissimilarity + (1 - beta) * difference).mean(1, keepdim=True)


def _structural_similarity(first: _Statistics, second: Tensor) -> Tensor:
    means = window_means(torch.cat([second, second * second, first.image * second], dim=1))
    second_mean, square_mean, product_mean = means.chunk(3, dim=1)
    variances = first.variance + square_mean - second_mean**2
    covariance = product_mean - first.mean * second_mean
    numerator = (2 * first.mean * second_mean + SSIM_MEAN_CONSTANT) * (2 * covariance + SSIM_VARIANCE_CONSTANT)
    return numerator / ((first.mean**2 + second_mean**2 + SSIM_MEAN_CONSTANT) * (variances + SSIM_VARIANCE_CONSTANT))


def window_means(image: Tensor) -> Tensor:
    """The mean of each pixel's SSIM window, borders reflected; [B, C, H, W], H and W at least 4, to the same."""
    return cast(Tensor, _WindowMeans.apply(image))


class _WindowMeans(torch.autograd.Function):
    """Window sums by doubling, first down then across: 8 additions where a pooling reads 49 values, an order of magnitude on the CPU."""

    @staticmethod
    def forward(ctx: Any, image: Tensor) -> Tensor:
        ctx.save_for_backward(image)
        return _window_sums(F.pad(image, (SSIM_WINDOW_PX // 2,) * 4, mode="reflect")) / SSIM_WINDOW_PX**2

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (image,) = ctx.saved_tensors
        everywhere = _window_sums(F.pad(gradient / SSIM_WINDOW_PX**2, (SSIM_WINDOW_PX - 1,) * 4))
        return torch.ops.aten.reflection_pad2d_backward(everywhere, image, [SSIM_WINDOW_PX // 2] * 4)


def _window_sums(image: Tensor) -> Tensor:
    """Sums of all whole 7x7 windows: [..., H, W] to [..., H - 6, W - 6]."""
    for axis in (-2, -1):
        size = image.shape[axis]
        two = image.narrow(axis, 0, size - 1) + image.narrow(axis, 1, size - 1)
        four = two.narrow(axis, 0, size - 3) + two.narrow(axis, 2, size - 3)
        three = two.narrow(axis, 4, size - 6).add(image.narrow(axis, 6, size - 6))
        image = four.narrow(axis, 0, size - 6) + three
    return image


def _with_its_gradient(term: Callable[[Tensor], Tensor], prediction: Tensor) -> Tensor:
    """term(prediction), a scalar, whose gradient is found at once: the maps behind 22 SSIMs would fill gigabytes until the backward pass,
    and finding them there again would cost half as much again."""
    if not (torch.is_grad_enabled() and prediction.requires_grad):
        return term(prediction)
    return cast(Tensor, _GradientAtOnce.apply(prediction, term))


class _GradientAtOnce(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, prediction: Tensor, term: Callable[[Tensor], Tensor]) -> Tensor:
        with torch.enable_grad():
            prediction = prediction.detach().requires_grad_()
            value = term(prediction)
            ctx.save_for_backward(*torch.autograd.grad(value, prediction))
        return value.detach()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        (gradient,) = ctx.saved_tensors
        return upstream * gradient, None


def sequence_weights(count: int, gamma: float) -> list[float]:
    """Weights of `count` predictions, the last one 1; the first one is gamma^15 whatever the count (a single one weighs 1)."""
    adjusted = gamma ** (GAMMA_STEPS / max(count - 1, 1))
    return [adjusted ** (count - 1 - i) for i in range(count)]


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
    photometric: str,
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
    if photometric not in PHOTOMETRIC_TERMS:
        raise ValueError(f"photometric is one of {', '.join(PHOTOMETRIC_TERMS)}; got {photometric!r}")
