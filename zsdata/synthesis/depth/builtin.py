"""Depth without weights: surfaces that end on image edges, ordered by where they stand, how they look and what they enclose."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .cues import Cues, find_cues
from .regions import Array, Labels, Partition, merge, region_mean, region_sum, superpixels

WORKING_SIDE_PX = 448  # long side at which surfaces are found; a larger photo only refines where they end
SURFACE_LIMIT = 10.0  # border strength (see regions.merge) that separates two surfaces

# Chosen for the order of the true disparities of twelve benchmark pairs; benchmarks/depth.py refits them with each pair left out.
# Only the ratios matter.
WEIGHTS = Cues(row=0.15, contact=0.45, base=0.23, detail=0.36, chroma=0.36, enclosed=0.3)

DIFFUSION_STEPS = 40
DIFFUSION_STRENGTH = 2.5  # pull of a neighbour of the same colour, per pixel of common border, against a superpixel's own cues
DIFFUSION_CONTRAST = 10.0  # border contrast at which that pull has fallen to 60 %
SLOPE_PRIOR = 0.03  # image heights: a surface smaller than this shows no slope of its own

_said = False


class BuiltinDepthWarning(UserWarning):
    """Said once per process: the built-in depth is for trying out."""


class BuiltinDepth:
    """Inverse depth from classic cues; no weights, no download, no state.

    The photo is cut into superpixels by a watershed, which merge into surfaces up to a border strength. Every superpixel gets a
    nearness from six cues (`find_cues`); nearness diffuses between superpixels of like colour, and each surface takes the plane
    that fits its superpixels. So depth is linear inside a surface and jumps only where surfaces meet, which is on an image edge.

    Mirroring: every cue treats left and right alike. What does not is what a photo leaves open: the watershed's seeds lie on a
    grid that starts at the left border, take the first of equally smooth pixels, and flood first come, first served. On a
    clear edge any seed gives the same superpixels; along weak edges and in even or finely textured areas they shift by some
    pixels, other borders merge first, and the surfaces there change. So `flip_confidence` is low where the segmentation is a guess.

    It is deterministic: the same photo gives the same bits in any batch, whatever the number of threads.
    """

    def __call__(self, images: Tensor) -> Tensor:
        """Estimates inverse depth.

        Args:
            images: float [B, 3, H, W], RGB, 0..255, any H and W from 1, any device.
        Returns:
            float32 [B, 1, H, W] on the device of `images`: relative inverse depth in 0..1 without unit, larger is nearer.
        Raises:
            ValueError: `images` has another shape or dtype, or a value that is not finite.
        """
        if images.ndim != 4 or images.shape[1] != 3 or 0 in images.shape[2:] or not images.is_floating_point():
            raise ValueError(f"images must be a float tensor [B, 3, H, W] in 0..255, got {images.dtype} {list(images.shape)}")
        warn_once()
        photos = images.detach().to("cpu", torch.float32).contiguous().numpy()
        maps = np.empty((len(photos), 1, *photos.shape[2:]), np.float32)
        for photo, inverse_depth in zip(photos, maps, strict=True):
            inverse_depth[0] = _estimate(photo)
        return torch.from_numpy(maps).to(images.device)


def warn_once() -> None:
    """Says once per process that a neural estimator is better for real training."""
    global _said
    if not _said:
        _said = True
        warnings.warn(
            "The built-in depth is for trying out and for tests; for real training use a neural estimator, for example "
            'depth="depth-anything/Depth-Anything-V2-Small-hf".',
            BuiltinDepthWarning,
            stacklevel=3,
        )


class Scene(NamedTuple):
    """A photo cut up: `labels` [h, w] name superpixels, `finest` and `surfaces` group them, `x` and `y` are their centres (0..1)."""

    labels: Labels
    finest: Partition
    surfaces: Partition
    x: Array
    y: Array
    cues: Cues


class Planes(NamedTuple):
    """Inverse depth of each surface: `offset + slope_x * x + slope_y * y`, x and y from 0 to 1 over the image."""

    offset: Array
    slope_x: Array
    slope_y: Array


def _estimate(photo: NDArray[np.float32]) -> NDArray[np.float32]:
    """Inverse depth [H, W] of one photo [3, H, W]."""
    image = working_image(photo)
    scene = analyse(image)
    nearness = np.average(np.stack(scene.cues), 0, np.array(WEIGHTS))
    labels = _labels_at_full_size(scene, image, photo)
    depth = render(fit_planes(scene, nearness), labels)
    # A plane may overshoot at the far corner of its surface, and one such corner would squeeze the normalised range.
    np.clip(depth, np.float32(nearness.min()), np.float32(nearness.max()), out=depth)
    return np.asarray(cv2.medianBlur(depth, 5), np.float32)  # speckle of the labels; a plane and a straight edge pass unchanged


def working_image(photo: NDArray[np.float32]) -> NDArray[np.uint8]:
    """RGB [h, w, 3] of a photo [3, H, W], its long side at most `WORKING_SIDE_PX`."""
    height, width = photo.shape[1:]
    scale = min(1.0, WORKING_SIDE_PX / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = np.stack([cv2.resize(channel, size, interpolation=cv2.INTER_AREA) for channel in photo], 2)
    if not np.isfinite(small).all():
        raise ValueError("images must be finite, got NaN or infinity")
    return np.rint(small).clip(0, 255).astype(np.uint8)


def analyse(image: NDArray[np.uint8]) -> Scene:
    """Cuts an RGB image [h, w, 3] into superpixels and surfaces and finds the cues of the superpixels."""
    height, width = image.shape[:2]
    labels, finest = superpixels(image)
    surfaces = [finest, *merge(finest, SURFACE_LIMIT)][-1]
    flat = labels.ravel()
    x = region_sum(flat, np.tile((np.arange(width) + 0.5) / width, height)) / finest.pixels
    y = region_sum(flat, np.repeat((np.arange(height) + 0.5) / height, width)) / finest.pixels
    cues = find_cues(image, labels, finest, [surfaces, *merge(surfaces, np.inf)], y)
    return Scene(labels, finest, surfaces, x, y, cues)


def fit_planes(scene: Scene, nearness: Array) -> Planes:
    """The plane of each surface through the diffused nearness of its superpixels (least squares, slopes shrunk on small surfaces)."""
    nearness = _diffused(scene.finest, nearness)
    surface, pixels = scene.surfaces.region_of, scene.finest.pixels

    def mean(value: Array) -> Array:
        return region_mean(surface, value, pixels)

    value, x, y = mean(nearness), mean(scene.x), mean(scene.y)
    dv, dx, dy = nearness - value[surface], scene.x - x[surface], scene.y - y[surface]
    xx, yy, xy = mean(dx * dx) + SLOPE_PRIOR**2, mean(dy * dy) + SLOPE_PRIOR**2, mean(dx * dy)
    vx, vy = mean(dv * dx), mean(dv * dy)
    determinant = xx * yy - xy * xy
    slope_x, slope_y = (vx * yy - vy * xy) / determinant, (vy * xx - vx * xy) / determinant
    return Planes(value - slope_x * x - slope_y * y, slope_x, slope_y)


def _diffused(finest: Partition, value: Array) -> Array:
    """`value` per superpixel drawn towards neighbours of like colour: no steps inside an even area, all steps at strong borders."""
    hold = DIFFUSION_STRENGTH * finest.length * np.exp(-0.5 * np.square((finest.contrast + 0.5 * finest.gradient) / DIFFUSION_CONTRAST))
    source = np.concatenate([finest.second, finest.first])
    target = np.concatenate([finest.first, finest.second])
    hold = np.concatenate([hold, hold])
    total = 1 + region_sum(target, hold, len(value))
    diffused = value
    for _ in range(DIFFUSION_STEPS):
        diffused = (value + region_sum(target, hold * diffused[source], len(value))) / total
    return diffused


def render(planes: Planes, labels: NDArray[np.integer]) -> NDArray[np.float32]:
    """Inverse depth of surface labels [H, W] of any size."""
    height, width = labels.shape
    offset, slope_x, slope_y = (np.asarray(part, np.float32) for part in planes)
    x = ((np.arange(width) + 0.5) / width).astype(np.float32)
    y = ((np.arange(height) + 0.5) / height).astype(np.float32)[:, None]
    return offset[labels] + slope_x[labels] * x + slope_y[labels] * y


def _labels_at_full_size(scene: Scene, image: NDArray[np.uint8], photo: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Surface labels [H, W] of the photo [3, H, W].

    Near a border a pixel of the photo chooses, among the superpixels around it, the one of its colour.
    """
    labels = scene.surfaces.region_of.astype(np.uint16)[scene.labels]
    height, width = photo.shape[1:]
    if labels.shape == (height, width):
        return labels
    h, w = labels.shape
    row, column = (2 * np.arange(height) + 1) * h // (2 * height), (2 * np.arange(width) + 1) * w // (2 * width)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    border = cv2.dilate(labels, cross) != cv2.erode(labels, cross)
    full = labels[np.ix_(row, column)]
    at = np.flatnonzero(border[np.ix_(row, column)])

    # One pixel of padding, so that a neighbour is an offset into the flat array.
    superpixel = np.pad(scene.labels, 1, mode="edge").ravel()
    here = row[at // width] * (w + 2) + column[at % width] + w + 3
    flat = scene.labels.ravel()
    distances = np.zeros((5, len(at)), np.float32)
    offsets = (0, -1, 1, -w - 2, w + 2)
    for channel in range(3):
        mean = (region_sum(flat, image[..., channel].ravel()) / scene.finest.pixels).astype(np.float32)[superpixel]
        value = photo[channel].reshape(-1)[at]
        for distance, offset in zip(distances, offsets, strict=True):
            difference = mean[here + offset]
            difference -= value
            difference *= difference
            distance += difference
    nearest = here + np.array(offsets)[distances.argmin(0)]
    full[at // width, at % width] = scene.surfaces.region_of.astype(np.uint16)[superpixel[nearest]]
    return full
