"""Semi-global block matching (OpenCV): what a matcher without any training reaches."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

# The search goes this far: the nearest surfaces of the public benchmarks lie at a sixth of the width.
LARGEST_DISPARITY_SHARE = 0.25
DISPARITY_STEP = 16  # OpenCV searches whole multiples of it, and returns sixteenths of a pixel
BLOCK_PX = 5


def sgbm(left: Tensor, right: Tensor) -> Tensor:
    """Disparity [B, 1, H, W], float32, of RGB images [B, 3, H, W], 0..255, on their device; computed on the CPU.

    Pixels that SGBM rejects get the smaller of the nearest accepted disparities to the left and right in their row, which is the
    background's (0 in a row without any).
    """
    pictures = [image.round().clamp(0, 255).byte().permute(0, 2, 3, 1).cpu().numpy() for image in (left, right)]
    disparities = np.stack([_match(*pair) for pair in zip(*pictures, strict=True)])
    return torch.from_numpy(disparities)[:, None].to(left.device)


def _match(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    reach = int(np.ceil(LARGEST_DISPARITY_SHARE * left.shape[1] / DISPARITY_STEP)) * DISPARITY_STEP
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=reach,
        blockSize=BLOCK_PX,
        P1=8 * 3 * BLOCK_PX**2,  # OpenCV's advice for three channels
        P2=32 * 3 * BLOCK_PX**2,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    # SGBM gives nothing for columns left of its reach; a margin lets it match as much of them as the right image shows.
    wide = [cv2.copyMakeBorder(image, 0, 0, reach, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    disparity = matcher.compute(*wide)[:, reach:].astype(np.float32) / DISPARITY_STEP
    return _fill_from_background(disparity, disparity >= 0)


def _fill_from_background(disparity: np.ndarray, accepted: np.ndarray) -> np.ndarray:
    def last_accepted(values: np.ndarray, known: np.ndarray) -> np.ndarray:
        column = np.where(known, np.arange(values.shape[1]), -1)
        column = np.maximum.accumulate(column, axis=1)
        return np.where(column >= 0, np.take_along_axis(values, column.clip(min=0), axis=1), np.inf)

    before = last_accepted(disparity, accepted)
    after = last_accepted(disparity[:, ::-1], accepted[:, ::-1])[:, ::-1]
    background = np.minimum(before, after)
    return np.where(np.isfinite(background), background, 0).astype(np.float32)
