"""One example: a true right image, and as much of it as a left view tells (paper, section "Fine-tuning Protocol").

From stereo: the left image is warped by the true disparity; where nothing lands, the true right image is what to restore.
From a single photo, without any stereo: the photo is taken for the right image, with a disparity drawn for it. Which of its pixels a left
view shows is then a question of geometry alone, the one that the warp answers for the left image, seen in a mirror: a mirror swaps the
two cameras. What no left view shows is masked, and the photo itself is the truth.

Neither is cut before it is warped: what lies beside a crop hides part of it, or lands in it. A crop that shows no hole makes way for
another of the same rows: it teaches nothing, and in use it would not reach the network.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from trainers.inpaint_data.stored_maps import StereoFrame
from zsdata.augment import AugmentConfig, augment
from zsdata.faults import BadPhoto
from zsdata.quality import QualityGate
from zsdata.synthesis.disparity import SMALLEST_DISPARITY_PX, AdaptiveDisparity, dilate_disparity, sharpen_disparity
from zsdata.synthesis.view import ViewConfig
from zsdata.synthesis.warp import forward_warp

Draw = Callable[[str], np.random.Generator]  # the numbers of one example for a purpose

# The paper's "symmetric color augmentation": RAFT-Stereo's jitter with the same numbers for both images, and nothing else.
_JITTER = AugmentConfig()
SYMMETRIC_COLOUR = replace(
    AugmentConfig.none(),
    jitter_probability=_JITTER.jitter_probability,
    asymmetric_probability=0.0,
    brightness=_JITTER.brightness,
    contrast=_JITTER.contrast,
    saturation=_JITTER.saturation,
    hue_turns=_JITTER.hue_turns,
)
STREAM_VIEW, STREAM_GATE = ViewConfig(), QualityGate()  # of the pairs whose holes are to be filled


class Example(NamedTuple):
    """What the U-Net is asked (`warped` outside of `inpaint_mask`) and what it is to answer (`right`)."""

    right: Tensor  # float32 [1, 3, H, W], RGB 0..255, the truth
    warped: Tensor  # float32 [1, 3, H, W], RGB 0..255: the right view as the left one gives it, 0 in its holes
    inpaint_mask: Tensor  # bool [1, 1, H, W], right view: True where the left view shows nothing


def from_stereo(frame: StereoFrame, size: tuple[int, int], draw: Draw) -> Example:
    """An example of a stereo pair with its true disparity.

    Mirrored half of the time where the right view's disparity is known too: then the cameras change places. A pair that is smaller than
    the crop is enlarged to it. Objects grow by a pixel, as in the stream, since their rim has mixed colours; but the truth needs no
    sharper edges.

    Args:
        size: (height, width) of the crop, in pixels.
    """
    mirror, *place, instead = draw("view").random(4)
    left, right, disparity = frame.left, frame.right, frame.disparity
    if frame.right_disparity is not None and mirror < 0.5:
        left, right, disparity = (np.ascontiguousarray(part[:, ::-1]) for part in (frame.right, frame.left, frame.right_disparity))
    height, width = _enlarged(left.shape[:2], size)
    if (height, width) != left.shape[:2]:
        grow = width / left.shape[1]
        left, right = (cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR) for image in (left, right))
        disparity = cv2.resize(disparity, (width, height), interpolation=cv2.INTER_NEAREST_EXACT) * np.float32(grow)

    rows, columns = _window((height, width), size, place)
    known = torch.from_numpy(np.isfinite(disparity))[None, None]
    grown = dilate_disparity(torch.from_numpy(np.nan_to_num(disparity, nan=0.0))[None, None])
    grown = grown.masked_fill(~known, torch.nan)  # covers nothing
    left, right = augment(_image(left[rows]), _image(right[rows]), [draw("augment")], SYMMETRIC_COLOUR)
    warped = forward_warp(left, grown[..., rows, :])
    columns = _with_hole(columns, warped.inpaint_mask, instead)
    return Example(
        right[..., columns].contiguous(), warped.right[..., columns].contiguous(), warped.inpaint_mask[..., columns].contiguous()
    )


def from_photo(photo: np.ndarray, inverse_depth: Tensor, scale: AdaptiveDisparity, size: tuple[int, int], draw: Draw) -> Example:
    """An example of a photo, taken for a right image.

    Mirrored half of the time. A photo that is smaller than the crop is enlarged to it; one that is wider than two crops is brought to
    that width, as in the stream, which makes no wider holes either. The disparity is made as in the stream: dilated and sharpened. A crop
    with more holes than the stream lets pass is refused: that of a strip, which was enlarged.

    Args:
        photo: uint8 [H, W, 3], RGB.
        inverse_depth: float32 [1, 1, H, W], in [0, 1], larger is nearer.
        scale: draws the disparity of the nearest point.
        size: (height, width) of the crop, in pixels.

    Raises:
        BadPhoto: too many holes.
    """
    mirror, *place, instead = draw("view").random(4)
    if mirror < 0.5:
        photo, inverse_depth = np.ascontiguousarray(photo[:, ::-1]), inverse_depth.flip(-1)
    taken = STREAM_VIEW.taken_width(photo.shape[1], size[1]) / photo.shape[1]
    height, width = _enlarged((round(photo.shape[0] * taken), round(photo.shape[1] * taken)), size)
    if (height, width) != photo.shape[:2]:
        photo = cv2.resize(photo, (width, height), interpolation=cv2.INTER_AREA if width < photo.shape[1] else cv2.INTER_LINEAR)
        inverse_depth = F.interpolate(inverse_depth, (height, width), mode="bilinear", align_corners=False)

    rows, columns = _window((height, width), size, place)
    disparity = inverse_depth * (scale.draw_scale(draw("disparity"), width) * width)
    disparity = sharpen_disparity(dilate_disparity(disparity)).clamp(min=SMALLEST_DISPARITY_PX)
    hidden = hidden_from_left(disparity[..., rows, :])
    columns = _with_hole(columns, hidden, instead)
    inpaint_mask = hidden[..., columns].contiguous()
    hole_share = float(inpaint_mask.float().mean())
    if hole_share > STREAM_GATE.max_hole_share:
        raise BadPhoto(f"too many holes: {hole_share:.0%} of the crop would be invented")
    crop = _image(photo[rows, columns])
    _, right = augment(crop, crop, [draw("augment")], SYMMETRIC_COLOUR)
    return Example(right, right.masked_fill(inpaint_mask, 0), inpaint_mask)


def hidden_from_left(disparity: Tensor) -> Tensor:
    """Which pixels of a right view the left camera cannot see: behind something nearer, or outside of its frame.

    Args:
        disparity: float32 [B, 1, H, W], pixels, of the right view: right (x, y) is left (x + d, y).

    Returns:
        bool [B, 1, H, W], True where the left view does not show the point.
    """
    mirrored = disparity.flip(-1)
    return ~forward_warp(mirrored, mirrored).nonocclusion_mask.flip(-1)


def _enlarged(image: tuple[int, int], crop: tuple[int, int]) -> tuple[int, int]:
    """The size of the image, or the smallest of the same aspect that the crop fits into."""
    factor = max(1.0, crop[0] / image[0], crop[1] / image[1])
    return max(crop[0], round(image[0] * factor)), max(crop[1], round(image[1] * factor))


def _window(image: tuple[int, int], crop: tuple[int, int], place: list[float]) -> tuple[slice, slice]:
    top, left = (int(share * (whole - part + 1)) for share, whole, part in zip(place, image, crop, strict=True))
    return slice(top, top + crop[0]), slice(left, left + crop[1])


def _with_hole(columns: slice, inpaint_mask: Tensor, share: float) -> slice:
    """`columns` where they show a hole of `inpaint_mask`, [1, 1, H, W]; else as many others that do, each as likely, drawn by `share` in
    [0, 1). Where none do, `columns` stay."""
    width = columns.stop - columns.start
    shows_hole = inpaint_mask.flatten(0, 2).any(0).unfold(0, width, 1).any(1)  # by the first column
    if shows_hole[columns.start] or not shows_hole.any():
        return columns
    choices = shows_hole.nonzero().flatten()
    left = int(choices[int(share * len(choices))])
    return slice(left, left + width)


def _image(image: np.ndarray) -> Tensor:
    """uint8 [H, W, 3] to float32 [1, 3, H, W]."""
    return torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None].to(torch.float32, memory_format=torch.contiguous_format)
