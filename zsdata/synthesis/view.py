"""The view: which part of a photo becomes the pair, drawn before anything is computed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class ViewConfig:
    """How a crop is cut from a photo; scales are exponents of two, as in RAFT-Stereo's spatial augmentation."""

    min_scale: float = -0.2
    max_scale: float = 0.4
    max_stretch: float = 0.2  # width and height each differ from the common scale by up to this exponent
    stretch_probability: float = 0.8
    mirror_probability: float = 0.5

    def __post_init__(self) -> None:
        if not -4 <= self.min_scale <= self.max_scale <= 4:
            raise ValueError(f"scales are exponents of two, -4 <= min_scale <= max_scale <= 4; got {self.min_scale}..{self.max_scale}")
        if not 0 <= self.max_stretch <= 2:
            raise ValueError(f"max_stretch is an exponent of two in 0..2; got {self.max_stretch}")
        for name in ("stretch_probability", "mirror_probability"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is in 0..1; got {getattr(self, name)}")


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

    @property
    def scale_x(self) -> float:
        """Pixels of the result per pixel of the photo, horizontally."""
        return self.width / self.window[3]


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

    scale = max(2**exponent, height / photo_height, width / photo_width)  # one scale for both sides: a small photo keeps its aspect
    window_width = min(photo_width, max(1, round(width / (scale * 2**stretch_x))))
    window_height = min(photo_height, max(1, round(height / (scale * 2**stretch_y))))
    left = int(draws[4] * (photo_width - window_width + 1))
    top = int(draws[5] * (photo_height - window_height + 1))

    beyond = min(photo_width - left - window_width, math.ceil(largest_share * photo_width) + 1)
    margin = round(beyond * width / window_width)
    window = (top, left, window_height, window_width + (beyond if margin else 0))
    return View(bool(draws[6] < config.mirror_probability), window, height, width + margin, margin)


def view_photo(photo: np.ndarray, view: View) -> np.ndarray:
    """The view's part of an RGB photo: uint8 [H, W, 3] to uint8 [height, width, 3], averaged where it shrinks, bilinear where it grows."""
    top, left, height, width = _window_in_photo(view, photo.shape[1])
    part = photo[top : top + height, left : left + width]
    shrinks = view.height * view.width < height * width
    part = cv2.resize(part, (view.width, view.height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.ascontiguousarray(part[:, ::-1]) if view.mirror else part


def view_map(values: Tensor, view: View, photo_size: tuple[int, int]) -> Tensor:
    """The view's part of a map over the whole photo, bilinear: float [B, C, h, w] of any resolution to [B, C, height, width]."""
    top, left, height, width = _window_in_photo(view, photo_size[1])
    rows, columns = values.shape[-2:]
    values = _resample(values, -2, top * rows / photo_size[0], height * rows / photo_size[0], view.height)
    values = _resample(values, -1, left * columns / photo_size[1], width * columns / photo_size[1], view.width)
    return values.flip(-1) if view.mirror else values


def _window_in_photo(view: View, photo_width: int) -> tuple[int, int, int, int]:
    top, left, height, width = view.window
    return (top, photo_width - left - width if view.mirror else left, height, width)


def _resample(values: Tensor, axis: int, start: float, extent: float, count: int) -> Tensor:
    """Linear interpolation at the centres of `count` equal parts of start..start + extent along one axis (pixel i covers i..i + 1)."""
    position = torch.arange(count, dtype=torch.float64) + 0.5
    position = (position * (extent / count) + (start - 0.5)).clamp_(0, values.shape[axis] - 1)
    first = position.floor().long()
    second = (first + 1).clamp_(max=values.shape[axis] - 1)
    share = (position - first).to(values.dtype).to(values.device)
    shape = (-1, 1) if axis == -2 else (-1,)
    first_values = values.index_select(axis, first.to(values.device))
    second_values = values.index_select(axis, second.to(values.device))
    return torch.lerp(first_values, second_values, share.view(shape))
