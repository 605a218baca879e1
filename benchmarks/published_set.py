"""Reading a pre-built set of pairs, as training on one does: decode the six files of a pair, then augment whole images and cut a crop.

What the published training does to a pair (github.com/Windsrain/ZeroStereo: dataset/zero_dataset.py, util/augmentor.py and the numbers of
config/train_stereo.yaml; torchvision's colour jitter on Pillow images), written anew as the reference of a measurement. It follows the
published steps and data types, since they are the cost, with one exception in its favour: images are decoded by OpenCV and not by Pillow.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch
from PIL import Image, ImageEnhance
from skimage.filters import gaussian
from torch import Tensor

from zsdata.exported import ExportedPair

CROP = (384, 512)
NOISE_STD = 0.02  # of the range
BLUR_PROBABILITY = 0.5
BRIGHTNESS = CONTRAST = (0.6, 1.4)
SATURATION = (0.0, 1.4)
HUE_TURNS = 0.5 / 3.14
ASYMMETRIC_PROBABILITY = 0.2
ERASE_PROBABILITY, ERASE_BOXES, ERASE_SIDE_PX = 0.5, 2, (50, 100)
SCALE_EXPONENT, STRETCH_PROBABILITY, STRETCH_EXPONENT = (-0.2, 0.4), 0.8, 0.2
ROW_JITTER_PX = 2

NEAREST_NEIGHBOUR = {"valid", "nonocclusion", "inpaint"}


def decode(pair: ExportedPair) -> tuple[Any, ...]:
    """The six files: two images uint8 [H, W, 3] in OpenCV's BGR, two labels float32 [H, W], two masks uint8 [H, W]."""
    return (
        cv2.imread(str(pair.left), cv2.IMREAD_COLOR),
        cv2.imread(str(pair.right), cv2.IMREAD_COLOR),
        np.load(pair.disparity),
        np.load(pair.confidence),
        cv2.imread(str(pair.nonocclusion), cv2.IMREAD_GRAYSCALE),
        cv2.imread(str(pair.inpaint), cv2.IMREAD_GRAYSCALE),
    )


def decode_and_augment(pair: ExportedPair, random: np.random.RandomState) -> dict[str, Tensor]:
    """A training sample: float32 [C, h, w] each, augmented and clean images, labels, masks and valid; cut to CROP."""
    left, right, disparity, confidence, nonocclusion, inpaint = decode(pair)
    left, right = (cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.float32) for image in (left, right))
    maps = {
        "left": left,
        "right": right,
        "left_clean": left,
        "right_clean": right,
        "disparity": disparity.astype(np.float32),
        "confidence": confidence.astype(np.float32),
        "nonocclusion": (nonocclusion == 255).astype(np.float32),
        "inpaint": (inpaint == 255).astype(np.float32),
        "valid": (disparity > 0).astype(np.float32),
    }
    maps["right"] = grain(maps["right"], random)
    maps["left"], maps["right"] = jitter_both(maps["left"], maps["right"], random)
    maps["right"] = erase(maps["right"], random)
    maps = cut(resize(maps, random), random)
    return {name: torch.from_numpy(np.atleast_3d(values)).permute(2, 0, 1).float() for name, values in maps.items()}


def grain(image: np.ndarray, random: np.random.RandomState) -> np.ndarray:
    image = np.clip(image / 255.0 + random.randn(*image.shape) * NOISE_STD, 0, 1) * 255.0
    return gaussian(image, sigma=random.rand(), channel_axis=-1) if random.rand() < BLUR_PROBABILITY else image


def jitter_both(left: np.ndarray, right: np.ndarray, random: np.random.RandomState) -> list[np.ndarray]:
    """One jitter for both images, laid one below the other, or one for each."""
    if random.rand() < ASYMMETRIC_PROBABILITY:
        return [jitter_colours(image, random) for image in (left, right)]
    return np.split(jitter_colours(np.concatenate([left, right]), random), 2)


def jitter_colours(image: np.ndarray, random: np.random.RandomState) -> np.ndarray:
    """Brightness, contrast, saturation and hue in a drawn order, as torchvision does it to Pillow images; float [H, W, 3] to float32."""
    picture = Image.fromarray(image.astype(np.uint8))
    brightness, contrast, saturation = (random.uniform(*limits) for limits in (BRIGHTNESS, CONTRAST, SATURATION))
    hue = random.uniform(-HUE_TURNS, HUE_TURNS)
    for step in random.permutation(4):
        if step == 0:
            picture = ImageEnhance.Brightness(picture).enhance(brightness)
        elif step == 1:
            picture = ImageEnhance.Contrast(picture).enhance(contrast)
        elif step == 2:
            picture = ImageEnhance.Color(picture).enhance(saturation)
        else:
            picture = rotate_hue(picture, hue)
    return np.array(picture, dtype=np.float32)


def rotate_hue(picture: Image.Image, turns: float) -> Image.Image:
    hue, saturation, value = picture.convert("HSV").split()
    rotated = np.array(hue) + np.uint8(int(turns * 255) % 256)  # wraps round
    return Image.merge("HSV", (Image.fromarray(rotated), saturation, value)).convert("RGB")


def erase(image: np.ndarray, random: np.random.RandomState) -> np.ndarray:
    if random.rand() < ERASE_PROBABILITY:
        colour = image.reshape(-1, 3).mean(axis=0)
        for _ in range(random.randint(1, ERASE_BOXES + 1)):
            x, y = random.randint(image.shape[1]), random.randint(image.shape[0])
            width, height = random.randint(*ERASE_SIDE_PX, size=2)
            image[y : y + height, x : x + width] = colour
    return image


def resize(maps: dict[str, np.ndarray], random: np.random.RandomState) -> dict[str, np.ndarray]:
    """All nine maps, whole, by one scale and stretch."""
    height, width = maps["left"].shape[:2]
    least = max((CROP[0] + 1) / height, (CROP[1] + 1) / width)
    scale_x = scale_y = 2 ** random.uniform(*SCALE_EXPONENT)
    if random.rand() < STRETCH_PROBABILITY:
        scale_x *= 2 ** random.uniform(-STRETCH_EXPONENT, STRETCH_EXPONENT)
        scale_y *= 2 ** random.uniform(-STRETCH_EXPONENT, STRETCH_EXPONENT)
    scale_x, scale_y = max(scale_x, least), max(scale_y, least)
    resized = {
        name: cv2.resize(
            values, None, fx=scale_x, fy=scale_y, interpolation=cv2.INTER_NEAREST if name in NEAREST_NEIGHBOUR else cv2.INTER_LINEAR
        )
        for name, values in maps.items()
    }
    resized["disparity"] = resized["disparity"] * scale_x
    return resized


def cut(maps: dict[str, np.ndarray], random: np.random.RandomState) -> dict[str, np.ndarray]:
    """One window for all, but the augmented right image up to ROW_JITTER_PX rows off."""
    height, width = maps["left"].shape[:2]
    jitter = min(ROW_JITTER_PX, (height - CROP[0]) // 2)
    top = random.randint(jitter, height - CROP[0] - jitter + 1)
    left = random.randint(width - CROP[1] + 1)
    right_top = top + random.randint(-jitter, jitter + 1)
    tops = {name: right_top if name == "right" else top for name in maps}
    return {name: np.ascontiguousarray(values[tops[name] : tops[name] + CROP[0], left : left + CROP[1]]) for name, values in maps.items()}
