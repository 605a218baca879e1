"""How close an inpainter comes to what the right camera really saw: PSNR and SSIM in the holes of warped real pairs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from trainers.pairs_on_disk import StereoPair
from zsdata.losses import structural_similarity
from zsdata.seeding import rng
from zsdata.synthesis.disparity import dilate_disparity
from zsdata.synthesis.inpaint import Inpainter
from zsdata.synthesis.warp import forward_warp

DENSE = 0.9  # share of pixels with a true disparity; a sparser truth tears surfaces, and its holes are none of the scene


class HoleCase(NamedTuple):
    """A warped pair. Images are float32 [1, 3, H, W], RGB 0..255; masks bool [1, 1, H, W], right view."""

    name: str
    truth: Tensor  # the true right image
    warped: Tensor  # what the left image gives, 0 in holes
    inpaint_mask: Tensor
    scored: Tensor  # the hole pixels that count: both ends of their run of holes come from true disparities


def hole_cases(pairs: Iterable[StereoPair], size: tuple[int, int]) -> tuple[list[HoleCase], list[str]]:
    """What the pairs ask an inpainter, and the names of those left out: of a sparse truth, or without a hole to score.

    The left image is warped by its true disparity, dilated as in the stream; where that is unknown, the farther neighbour in the row stands
    in. What is larger than `size` (height, width, pixels) is cut to it, in the middle.
    """
    cases, left_out = [], []
    for pair in pairs:
        case = _hole_case(pair, size) if pair.valid.mean() >= DENSE else None
        if case is not None and case.scored.any():
            cases.append(case)
        else:
            left_out.append(pair.name)
    return cases, left_out


def score_holes(inpaint: Inpainter, case: HoleCase, number: int, seed: int = 0) -> dict[str, Any]:
    """{"name", "pixels", "psnr", "ssim"}: PSNR in dB and mean SSIM (7x7) over the scored hole pixels, with the true image around them.

    Args:
        inpaint: as `load_inpainter` returns it, one that needs no more than image and holes.
        number: of the case, for the noise; the same number gives the same noise.
    """
    made = inpaint(case.warped, case.inpaint_mask, [rng(seed, 0, number, "validation")]).float().clamp(0, 255)
    image = torch.where(case.inpaint_mask, made.to(case.truth.device), case.truth)
    scored = case.scored.expand_as(image)
    error = (image - case.truth)[scored].double().square().mean().item()
    similarity = structural_similarity(case.truth / 255, image / 255)[scored].double().mean().item()
    psnr = 10 * float(np.log10(255**2 / max(error, 1e-10)))
    return {"name": case.name, "pixels": int(case.scored.sum()), "psnr": psnr, "ssim": similarity}


def mean_hole_scores(scores: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Means over the pairs."""
    return {name: float(np.mean([score[name] for score in scores])) for name in ("psnr", "ssim")}


def _hole_case(pair: StereoPair, size: tuple[int, int]) -> HoleCase:
    known = torch.from_numpy(pair.valid)[None, None].float() * 255
    left, truth = (torch.from_numpy(image).permute(2, 0, 1)[None].float() for image in (pair.left, pair.right))
    disparity = dilate_disparity(torch.from_numpy(_without_gaps(pair))[None, None])
    warped = forward_warp(torch.cat([left, known], dim=1), disparity)
    hole = warped.inpaint_mask[0, 0].numpy()
    from_truth = F.pad((warped.right[0, 3] == 255), (1, 1), value=True).numpy()  # beside the image nothing speaks against a hole
    first, last = _run_ends(hole)
    rows = np.arange(len(hole))[:, None]
    scored = torch.from_numpy(hole & from_truth[rows, first] & from_truth[rows, last + 2])[None, None]
    middle = tuple(
        slice(max(0, (whole - part) // 2), max(0, (whole - part) // 2) + part) for whole, part in zip(hole.shape, size, strict=True)
    )
    parts = (truth, warped.right[:, :3], warped.inpaint_mask, scored)
    return HoleCase(pair.name, *(part[(..., *middle)].contiguous() for part in parts))


def _without_gaps(pair: StereoPair) -> np.ndarray:
    """The true disparity; in gaps that of the farther end."""
    first, last = _run_ends(~pair.valid)
    padded = np.pad(np.where(pair.valid, pair.disparity, np.inf), ((0, 0), (1, 1)), constant_values=np.inf)
    rows = np.arange(len(padded))[:, None]
    farther = np.minimum(padded[rows, first], padded[rows, last + 2])
    smallest = pair.disparity[pair.valid].min()  # of a row without any
    return np.where(pair.valid, pair.disparity, np.where(np.isfinite(farther), farther, smallest)).astype(np.float32)


def _run_ends(inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For every pixel the first and the last column of its run of pixels that are `inside`, bool [H, W]; other pixels: their own."""
    width = inside.shape[1]
    column = np.arange(width)
    outside_before = np.maximum.accumulate(np.where(inside, -1, column), axis=1)
    outside_after = np.minimum.accumulate(np.where(inside, width, column)[:, ::-1], axis=1)[:, ::-1]
    return np.where(inside, outside_before + 1, column), np.where(inside, outside_after - 1, column)
