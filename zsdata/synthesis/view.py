"""The view: which part of a photo becomes the pair, drawn before anything is computed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from zsdata.field_types import check_types


@dataclass(frozen=True, kw_only=True)
class ViewConfig:
    """How a crop is cut from a photo; scales are exponents of two, as in RAFT-Stereo's spatial augmentation.

    Disparity goes by the photo's width: of a photo of 12 megapixels in its own pixels, a crop of 512 columns would show disparities of
    several hundred pixels, and mostly what one camera alone sees. So a photo that is wider than `max_width` crops is taken for one that
    is as wide as these; those of the published training are not.
    """

    max_width: float = 2.0
    min_scale: float = -0.2
    max_scale: float = 0.4
    max_stretch: float = 0.2  # width and height each differ from the common scale by up to this exponent
    stretch_probability: float = 0.8
    mirror_probability: float = 0.5

    def __post_init__(self) -> None:
        check_types(self)
        if not self.max_width >= 1:
            raise ValueError(f"max_width is a number of crops, 1 or more; got {self.max_width}")
        if not -4 <= self.min_scale <= self.max_scale <= 4:
            raise ValueError(f"scales are exponents of two, -4 <= min_scale <= max_scale <= 4; got {self.min_scale}..{self.max_scale}")
        if not 0 <= self.max_stretch <= 2:
            raise ValueError(f"max_stretch is an exponent of two in 0..2; got {self.max_stretch}")
        for name in ("stretch_probability", "mirror_probability"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is in 0..1; got {getattr(self, name)}")

    def taken_width(self, photo_width: int, crop_width: int) -> float:
        """Pixels across of what a photo is taken for; see `max_width`."""
        return min(photo_width, self.max_width * crop_width)


REDUCTIONS = (8, 4, 2)  # by which a JPEG can be decoded at a fraction of its size, for a fraction of the time


class View(NamedTuple):
    """A window of the photo (mirrored first, where `mirror` says so) and the size it is brought to.

    The window reaches beyond the crop's right edge by `margin` columns of the result, as far as the photo goes: their points land inside
    the right image. The crop is the first `width - margin` columns.
    """

    mirror: bool
    window: tuple[int, int, int, int]  # top, left, height, width in pixels of the photo
    height: int
    width: int  # of the result, margin included
    margin: int
    reduction: int = 1  # the photo may be decoded at one part in so many: the window's sides and place are multiples of it

    @property
    def scale_x(self) -> float:
        """Pixels of the result per pixel of the photo, horizontally."""
        return self.width / self.window[3]

    @property
    def rows(self) -> tuple[int, int]:
        """First and last row of the photo that are shown, the last one excluded."""
        return self.window[0], self.window[0] + self.window[2]


def draw_view(
    photo_size: tuple[int, int], crop_size: tuple[int, int], generator: np.random.Generator, config: ViewConfig, largest_share: float
) -> View:
    """Draws scale, stretch, mirror and crop window.

    Args:
        photo_size, crop_size: (height, width). A photo smaller than the crop is enlarged to it.
        largest_share: the largest disparity as a share of the photo's width; it sets the margin.
    """
    photo_height, photo_width = photo_size
    height, width = crop_size
    draws = generator.random(7)
    exponent = config.min_scale + (config.max_scale - config.min_scale) * draws[0]
    stretched = draws[1] < config.stretch_probability
    stretch_x, stretch_y = (config.max_stretch * (2 * draw - 1) if stretched else 0.0 for draw in draws[2:4])

    scale = config.taken_width(photo_width, width) / photo_width * 2**exponent
    scale = max(scale, height / photo_height, width / photo_width)  # one scale for both sides: a small photo keeps its aspect
    window_width = min(photo_width, max(1, round(width / (scale * 2**stretch_x))))
    window_height = min(photo_height, max(1, round(height / (scale * 2**stretch_y))))
    reduction = _reduction(photo_size, crop_size, (window_height, window_width))
    window_width -= window_width % reduction
    window_height -= window_height % reduction
    left = int(draws[4] * ((photo_width - window_width) // reduction + 1)) * reduction
    top = int(draws[5] * ((photo_height - window_height) // reduction + 1)) * reduction

    beyond = min(photo_width - left - window_width, reduction * math.ceil((largest_share * photo_width + 1) / reduction))
    margin = round(beyond * width / window_width)
    window = (top, left, window_height, window_width + (beyond if margin else 0))
    return View(bool(draws[6] < config.mirror_probability), window, height, width + margin, margin, reduction)


def whole_view(photo_size: tuple[int, int]) -> View:
    """The whole photo as it is."""
    height, width = photo_size
    return View(mirror=False, window=(0, 0, height, width), height=height, width=width, margin=0)


def _reduction(photo_size: tuple[int, int], crop_size: tuple[int, int], window_size: tuple[int, int]) -> int:
    """The largest by which the photo's sides can be divided and still leave every pixel of the crop one of the window's."""
    for reduction in REDUCTIONS:
        divides = all(side % reduction == 0 for side in photo_size)
        if divides and all(side // reduction >= crop for side, crop in zip(window_size, crop_size, strict=True)):
            return reduction
    return 1


def view_photo(photo: np.ndarray, view: View, reduction: int = 1) -> np.ndarray:
    """The view's part of an RGB photo: uint8 [H, W, 3] to uint8 [height, width, 3], bilinear, or averaged
    where less than half of the pixels remain: less shrinking leaves nothing to alias, and averaging takes five times as long.

    Args:
        photo: the whole one, decoded at one part in `reduction` (1 or the view's own).
    """
    top, left, height, width = (number // reduction for number in _window_in_photo(view, photo.shape[1] * reduction))
    part = photo[top : top + height, left : left + width]
    shrinks = 2 * view.height * view.width < height * width
    if part.shape[:2] != (view.height, view.width):
        part = cv2.resize(part, (view.width, view.height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return cv2.flip(part, 1) if view.mirror else part


def view_map(values: Tensor, view: View, first_row: int = 0) -> Tensor:
    """The view's part of maps of the photo's resolution, bilinear: [B, C, h, w] of any dtype to new float32 [B, C, height, width].

    On the CPU OpenCV interpolates, four times as fast as torch by the same formula.

    Args:
        values: all columns of the photo, and its rows from `first_row` on, as far as the view shows them.
    """
    top, left, height, width = _window_in_photo(view, values.shape[-1])
    part = values[..., top - first_row : top - first_row + height, left : left + width].to(torch.float32, copy=True)
    if part.shape[-2:] != (view.height, view.width):
        if part.device.type == "cpu":
            part = _resize(part, (view.height, view.width))
        else:
            part = F.interpolate(part, (view.height, view.width), mode="bilinear", align_corners=False)
    return part.flip(-1) if view.mirror else part


def _resize(maps: Tensor, size: tuple[int, int]) -> Tensor:
    resized = maps.new_empty(*maps.shape[:2], *size)
    for source, target in zip(maps.flatten(0, 1).numpy(), resized.flatten(0, 1).numpy(), strict=True):
        cv2.resize(source, size[::-1], dst=target, interpolation=cv2.INTER_LINEAR)
    return resized


def _window_in_photo(view: View, photo_width: int) -> tuple[int, int, int, int]:
    top, left, height, width = view.window
    return (top, photo_width - left - width if view.mirror else left, height, width)
