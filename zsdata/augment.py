"""Photometric augmentation: two photographs of one scene, as two real cameras would take them.

Drawn, each sample from its own generator, and applied in this order; disparity, confidence and masks hold before and after.

1. right image: vertical jitter by whole pixels (RAFT-Stereo), then the vertical part of a rectification error;
2. each camera: exposure and white balance, vignetting; the lens's blur; the sensor's noise. Blur and noise of the right image alone are
   the "Gaussian augmentation" of MfS-Stereo (paper, section "Stereo Matching Model Training");
3. both images, with the same numbers or with numbers of their own: brightness, contrast, saturation and hue in a drawn order, then gamma
   (RAFT-Stereo's colour jitter);
4. both images to grey; 5. right image: occlusion boxes of its mean colour (RAFT-Stereo's eraser).

Scale and stretch belong to the view, which is drawn before the pair is made. Light comes before colour processing, and noise after
blur, as in a camera; the published training blurs its noise too, so that in the half of the pairs that is blurred its noise is weaker.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from zsdata import camera

Range = tuple[float, float]

# The optical centre of a lens lies off the middle of the picture by up to this much, in half diagonals.
OPTICAL_CENTRE_OFFSET = 0.1


@dataclass(frozen=True, kw_only=True)
class AugmentConfig:
    """How often and how strongly a pair is changed. A range (low, high) is drawn from uniformly.

    The colour jitter, vertical jitter, eraser, and the right image's noise and blur are the published training's; the effects of real rigs
    below them are additions, moderate and each on in a minority of the pairs. `AugmentConfig.none()` changes nothing.
    """

    # Colour jitter (RAFT-Stereo).
    jitter_probability: float = 1.0
    asymmetric_probability: float = 0.2  # of a jittered pair: each image has numbers of its own
    brightness: Range = (0.6, 1.4)  # factors
    contrast: Range = (0.6, 1.4)
    saturation: Range = (0.0, 1.4)  # from 0: the published training sees grey images this way
    hue_turns: float = 0.5 / 3.14  # up to this much of a turn either way
    gamma: Range = (1.0, 1.0)  # exponent on 0..1; off in the published training

    # Right image only (RAFT-Stereo, MfS-Stereo).
    vertical_jitter_px: int = 2  # whole pixels, up or down
    eraser_probability: float = 0.5
    eraser_boxes: tuple[int, int] = (1, 2)
    eraser_side_px: tuple[int, int] = (50, 100)
    noise_probability: float = 1.0
    noise_std: Range = (5.1, 5.1)  # grey levels; 0.02 of the range
    blur_probability: float = 0.5
    blur_sigma_px: Range = (0.0, 1.0)

    # What the cameras of a rig do.
    rectification_probability: float = 0.3
    rectification_error_px: float = 0.5  # vertical, right image: offset, rotation and stretch each reach up to this at the edge
    gain_probability: float = 0.3
    exposure_gain: Range = (0.85, 1.15)  # one factor per camera
    white_balance_gain: Range = (0.95, 1.05)  # one factor per camera and channel
    vignetting_probability: float = 0.2
    vignetting_falloff: Range = (0.0, 0.4)  # share of light lost in the corners, both lenses; their optical centres differ
    defocus_probability: float = 0.1
    defocus_sigma_px: Range = (0.0, 1.5)  # one per camera
    sensor_noise_probability: float = 0.2
    sensor_noise_std: Range = (0.0, 3.0)  # grey levels; one per pair, both cameras
    grey_probability: float = 0.1

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if name.endswith("_probability"):
                self._check_number(name, getattr(self, name), "a probability", 0, 1)
        self._check_number("hue_turns", self.hue_turns, "a share of a full turn", 0, 0.5)
        self._check_number("rectification_error_px", self.rectification_error_px, "pixels at the edge", 0, 16)
        self._check_whole("vertical_jitter_px", self.vertical_jitter_px, "whole pixels", 0, 64)
        for name in ("brightness", "contrast", "saturation", "exposure_gain", "white_balance_gain"):
            self._check_range(name, "factors", 0, 10)
        self._check_range("gamma", "exponents", 0.1, 10)
        self._check_range("vignetting_falloff", "a share of the light", 0, 1)
        for name in ("noise_std", "sensor_noise_std"):
            self._check_range(name, "grey levels", 0, 255)
        for name in ("blur_sigma_px", "defocus_sigma_px"):
            self._check_range(name, "pixels", 0, 10)
        for name, what, high in (("eraser_boxes", "a number of boxes", 16), ("eraser_side_px", "whole pixels", 65535)):
            self._check_range(name, what, 1, high)
            for value in getattr(self, name):
                self._check_whole(name, value, what, 1, high)

    @staticmethod
    def _check_number(name: str, value: object, what: str, low: float, high: float) -> None:
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise ValueError(f"{name} is {what} in {low}..{high}; got {value!r}")

    def _check_whole(self, name: str, value: object, what: str, low: int, high: int) -> None:
        self._check_number(name, value, what, low, high)
        if not isinstance(value, int):
            raise ValueError(f"{name} is {what} and takes an int; got {value!r}")

    def _check_range(self, name: str, what: str, low: float, high: float) -> None:
        value = getattr(self, name)
        if not isinstance(value, tuple | list) or len(value) != 2:
            raise ValueError(f"{name} is a range (low, high) of {what}; got {value!r}")
        for end in value:
            self._check_number(name, end, what, low, high)
        if value[0] > value[1]:
            raise ValueError(f"{name} is a range (low, high) with low <= high; got {value!r}")

    @classmethod
    def none(cls) -> AugmentConfig:
        """Everything off: the pair comes out as it went in. `dataclasses.replace` switches single effects on."""
        off = {name: 0.0 for name in cls.__dataclass_fields__ if name.endswith("_probability")}
        return replace(cls(), vertical_jitter_px=0, **off)


@torch.no_grad()
def augment(left: Tensor, right: Tensor, generators: Sequence[np.random.Generator], config: AugmentConfig) -> tuple[Tensor, Tensor]:
    """Augments a batch of pairs; see the top of this file.

    A pair comes out the same alone and in any batch, to the bit on the CPU: all its numbers come from its own generator, in a fixed
    order, also those that are then not needed.

    Args:
        left, right: float32 [B, 3, H, W], RGB, 0..255 (what lies beyond is clamped); not written into.
        generators: one per pair, `zsdata.seeding.rng(seed, epoch, index, "augment")`; used up by the call.
        config: what to do.
    Returns:
        left and right, new tensors of the same kind, finite, within 0..255.
    Raises:
        ValueError: images or generators do not fit together.
    """
    if left.ndim != 4 or left.shape[1] != 3 or left.shape != right.shape or {left.dtype, right.dtype} != {torch.float32}:
        raise ValueError(
            "augment takes left and right as float32 [B, 3, H, W] of one shape; "
            f"got {left.dtype} {list(left.shape)} and {right.dtype} {list(right.shape)}"
        )
    if len(generators) != len(left):
        raise ValueError(f"augment takes one generator per pair; got {len(generators)} for {len(left)} pairs")
    drawn = [_draw(generator, config, *left.shape[-2:]) for generator in generators]
    if left.device.type != "cpu":
        return _apply(left, right, drawn) if drawn else (left.clone(), right.clone())
    # One pair at a time stays in the processor's cache, which is several times faster than a whole batch.
    augmented_left, augmented_right = torch.empty_like(left), torch.empty_like(right)
    for i, numbers in enumerate(drawn):
        augmented_left[i : i + 1], augmented_right[i : i + 1] = _apply(left[i : i + 1], right[i : i + 1], [numbers])
    return augmented_left, augmented_right


def _draw(generator: np.random.Generator, config: AugmentConfig, height: int, width: int) -> dict[str, np.ndarray]:
    """All numbers of one pair, each with a row for the left and one for the right image; an effect that is off has neutral numbers.

    Each call of `between`, `whole` and `happens` takes one number from the generator, so no probability or range shifts another draw.
    """

    def between(low: float, high: float) -> float:
        return low + (high - low) * generator.random()

    def whole(low: int, high: int) -> int:
        return low + math.floor((high - low + 1) * generator.random())

    def happens(probability: float) -> bool:
        return generator.random() < probability

    def colour() -> tuple[np.ndarray, list[float], float]:
        order = np.argsort(generator.random(4))
        factors = [between(*config.brightness), between(*config.contrast), between(*config.saturation)]
        return order, [*factors, between(-config.hue_turns, config.hue_turns)], between(*config.gamma)

    keys = generator.integers(-(2**63), 2**63 - 1, size=2, dtype=np.int64)

    jittered, asymmetric = happens(config.jitter_probability), happens(config.asymmetric_probability)
    colours = [colour(), colour()]
    if not asymmetric:
        colours[1] = colours[0]
    if not jittered:
        colours = [(np.arange(4), list(NEUTRAL), 1.0)] * 2

    shift = whole(-config.vertical_jitter_px, config.vertical_jitter_px)
    misaligned = happens(config.rectification_probability)
    reach = config.rectification_error_px
    misalignment = np.array([between(-reach, reach) for _ in range(3)]) * misaligned

    gained = happens(config.gain_probability)
    gains = []
    for _ in range(2):
        exposure = between(*config.exposure_gain)
        gain = [exposure * between(*config.white_balance_gain) for _ in range(3)]
        gains.append(gain if gained else [1.0, 1.0, 1.0])
    vignetted = happens(config.vignetting_probability)
    falloff = between(*config.vignetting_falloff) * vignetted
    centres = [[between(-OPTICAL_CENTRE_OFFSET, OPTICAL_CENTRE_OFFSET) / math.sqrt(2) for _ in range(2)] for _ in range(2)]

    defocused = happens(config.defocus_probability)
    sigmas = [between(*config.defocus_sigma_px) * defocused for _ in range(2)]
    blurred = happens(config.blur_probability)
    sigmas[1] = math.hypot(sigmas[1], between(*config.blur_sigma_px) * blurred)  # two blurs in a row add their variances
    grainy = happens(config.sensor_noise_probability)
    sensor_std = between(*config.sensor_noise_std) * grainy
    noisy = happens(config.noise_probability)
    right_std = math.hypot(sensor_std, between(*config.noise_std) * noisy)

    grey = happens(config.grey_probability)

    erased = happens(config.eraser_probability)
    count = whole(*config.eraser_boxes) * erased
    boxes = np.zeros((2, config.eraser_boxes[1], 4), dtype=np.int64)
    for k in range(config.eraser_boxes[1]):  # a box that reaches over the frame is cut off by it, as in RAFT-Stereo
        x, y = whole(0, width - 1), whole(0, height - 1)
        box = (x, y, x + whole(*config.eraser_side_px), y + whole(*config.eraser_side_px))
        if k < count:
            boxes[1, k] = box

    levels = np.arange(256) / 255
    return {
        "key": keys,
        "order": np.stack([order for order, _, _ in colours]),
        "colour": np.array([numbers for _, numbers, _ in colours], dtype=np.float32),
        "symmetric": np.array([not asymmetric] * 2),
        "gamma": np.array([gamma for _, _, gamma in colours]),
        "curve": np.stack([255 * levels**gamma for _, _, gamma in colours]).astype(np.float32),
        "shift": np.array([0, shift]),
        "misalignment": np.stack([np.zeros(3), misalignment]).astype(np.float32),
        "gain": np.array(gains, dtype=np.float32),
        "falloff": np.array([falloff, falloff], dtype=np.float32),
        "centre": np.array(centres, dtype=np.float32),
        "sigma": np.array(sigmas),
        "noise_std": np.array([sensor_std, right_std], dtype=np.float32),
        "grey": np.array([grey, grey]),
        "box": boxes,
    }


# What leaves an image as it is: factors of brightness, contrast and saturation, turns of hue; columns of "colour", values of "order".
NEUTRAL = (1.0, 1.0, 1.0, 0.0)
BRIGHTNESS, CONTRAST, SATURATION, HUE = range(4)


def _apply(left: Tensor, right: Tensor, drawn: Sequence[dict[str, np.ndarray]]) -> tuple[Tensor, Tensor]:
    """Applies drawn numbers to a batch; both images of all pairs go through an operation together, and only where it is wanted.

    What is wanted is known on the host, so nothing waits for the device.
    """
    images = torch.cat([left, right])
    host = {name: np.concatenate([pair[name][None] for pair in drawn], 0).swapaxes(0, 1) for name in drawn[0]}
    host = {name: np.ascontiguousarray(rows).reshape(len(images), *rows.shape[2:]) for name, rows in host.items()}

    def on_device(rows: np.ndarray) -> Tensor:
        return torch.from_numpy(rows).to(images.device, non_blocking=True)

    def change(wanted: np.ndarray, operation: Callable[..., Tensor], *parameters: Tensor) -> None:
        nonlocal images
        rows = np.flatnonzero(wanted)
        if len(rows) == len(images):
            images = operation(images, *parameters)
        elif len(rows):
            index = on_device(rows)
            images.index_copy_(0, index, operation(images[index], *(parameter[index] for parameter in parameters)))

    change(host["shift"] != 0, camera.shift_rows, on_device(host["shift"]))
    change(np.any(host["misalignment"] != 0, axis=1), camera.misalign_rows, *on_device(host["misalignment"]).unbind(1))
    exposed = np.any(host["gain"] != 1, axis=1) | (host["falloff"] != 0)
    change(exposed, camera.expose, on_device(host["gain"]), on_device(host["falloff"]), on_device(host["centre"]))
    if host["sigma"].any():
        kernels = camera.gaussian_half_kernels(host["sigma"].tolist()).to(images.device, non_blocking=True)
        change(host["sigma"] != 0, camera.blur, kernels)
    change(host["noise_std"] != 0, camera.add_noise, on_device(host["key"]), on_device(host["noise_std"]))

    colour = on_device(host["colour"]).unbind(1)
    # Contrast turns about the mean of the image, or of both images of a symmetric pair: RAFT-Stereo lays them side by side as one.
    itself = np.arange(len(images))
    partner = on_device(np.where(host["symmetric"], (itself + len(left)) % len(images), itself))
    for step in range(4):
        wanted = [(host["order"][:, step] == which) & (host["colour"][:, which] != np.float32(NEUTRAL[which])) for which in range(4)]
        change(wanted[BRIGHTNESS], camera.scale_brightness, colour[BRIGHTNESS])
        if wanted[CONTRAST].any():
            mean = camera.mean_luma(images)
            change(wanted[CONTRAST], camera.scale_contrast, colour[CONTRAST], (mean + mean[partner]) / 2)
        change(wanted[SATURATION], camera.scale_saturation, colour[SATURATION])
        change(wanted[HUE], camera.rotate_hue, colour[HUE])
    change(host["gamma"] != 1, camera.apply_curve, on_device(host["curve"]))

    change(host["grey"], camera.to_grey)
    boxed = np.any(host["box"] != 0, axis=(1, 2))
    if boxed.any():
        change(boxed, camera.erase, on_device(host["box"]), camera.mean_colour(images))
    images.clamp_(0, 255)
    return images[: len(left)], images[len(left) :]
