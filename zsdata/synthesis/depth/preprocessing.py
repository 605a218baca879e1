"""From a photo to what a depth network takes, and from its prediction back to the photo: as the network's own folder says.

The aspect of a photo is kept wherever the network allows it, and sizes are whole patches. Resized photos are kept as whole numbers, as the
image processors of transformers do; that makes them small to send, and the mirrored photo's input the mirror image of the photo's.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor

HALF = (0.5, 0.5, 0.5)
# What transformers' image processors do unless the folder says otherwise, by the name of their class without its ending.
CLASS_DEFAULTS: dict[str, dict[str, Any]] = {
    "CHMv2": {
        "do_resize": False,
        "size_divisor": 16,
        "resample": 3,
        "image_mean": (0.42, 0.411, 0.296),
        "image_std": (0.213, 0.156, 0.143),
    },
    "DPT": {"size": 384, "resample": 3, "image_mean": HALF, "image_std": HALF},
    "DepthPro": {"size": 1536, "resample": 2, "image_mean": HALF, "image_std": HALF, "antialias": False},
    "GLPN": {"do_normalize": False, "resample": 2, "size_divisor": 32},
    "Tipsv2Dpt": {"do_normalize": False, "size": 448, "resample": 2},
    "ZoeDepth": {
        "size": {"height": 384, "width": 512},
        "resample": 2,
        "image_mean": HALF,
        "image_std": HALF,
        "antialias": False,
        "align_corners": True,
        "reflect": True,
    },
}
RESAMPLING = {2: "bilinear", 3: "bicubic"}  # by the number that PIL gives it
HIERARCHICAL_MULTIPLE_PX = 32  # networks that halve their features five times, such as Swin and GLPN
MOST_ASPECT = 4  # of the long side to the short one: the pixels of the network's input grow with it, and memory and time faster
REFLECTED_SHARE = 3  # ZoeDepth reflects 3 sqrt(side / 2) pixels at each edge


@dataclass(frozen=True)
class Preprocessing:
    """How photos are resized and normalised for one network.

    Attributes:
        short_side_px: of the network's input; None is the photo's own.
        multiple_px: both sides are multiples of it.
        square: the network takes squares alone; the aspect is not kept.
        rescale: what grey levels 0..255 are multiplied by before they are normalised.
        mean, std: of the channels, for values that are rescaled.
        mode: how photos are resized: "bilinear" or "bicubic".
        antialias: whether a photo that shrinks is smoothed.
        align_corners: whether the centres of the corner pixels stay where they are; not with `antialias`.
        reflect: whether the photo is continued at its edges by reflection first, and the prediction cut to the photo again.
    """

    short_side_px: int | None
    multiple_px: int
    square: bool
    rescale: float
    mean: tuple[float, ...]
    std: tuple[float, ...]
    mode: str
    antialias: bool
    align_corners: bool
    reflect: bool

    def input_size(self, height: int, width: int) -> tuple[int, int]:
        """(height, width) of the network's input for a photo of this size."""
        if self.square:
            side = max(1, round((self.short_side_px or 1) / self.multiple_px)) * self.multiple_px
            return side, side
        rows, columns = self._margins(height, width)
        height, width = height + 2 * rows, width + 2 * columns
        scale = 1.0 if self.short_side_px is None else self.short_side_px / min(height, width)
        return tuple(max(1, round(side * scale / self.multiple_px)) * self.multiple_px for side in (height, width))  # pyright: ignore

    def refuses(self, height: int, width: int) -> str | None:
        """Why a photo of this size is not shown to the network, as `BadPhoto` takes it, or None.

        A strip is refused: 2048x64 pixels would become 16576x518, which takes minutes and tens of gigabytes, for pairs such as the quality
        gate refuses. A network that takes squares is shown every photo.
        """
        if self.square or max(height, width) <= MOST_ASPECT * min(height, width):
            return None
        return f"too long for the depth network: one side more than {MOST_ASPECT} times the other: {width}x{height}"

    def prepare(self, images: Tensor) -> Tensor:
        """Photos [B, 3, H, W] 0..255, uint8 or float (rounded first), to the network's input before normalisation: uint8 [B, 3, h, w]."""
        size = self.input_size(*images.shape[-2:])
        if images.dtype != torch.uint8:
            images = images.round().clamp(0, 255).to(torch.uint8)
        if self.reflect:
            rows, columns = self._margins(*images.shape[-2:])
            images = F.pad(images.float(), (columns, columns, rows, rows), mode="reflect").to(torch.uint8)
        if tuple(images.shape[-2:]) == size:
            return images
        if self.antialias and images.device.type == "cpu":  # whole numbers all the way, and several times as fast
            return F.interpolate(images, size, mode=self.mode, antialias=True, align_corners=False)
        resized = F.interpolate(images.float(), size, mode=self.mode, antialias=self.antialias, align_corners=self.align_corners)
        return resized.round_().clamp_(0, 255).to(torch.uint8)

    def normalise(self, inputs: Tensor) -> Tensor:
        """uint8 [B, 3, h, w] to float32: rescaled, then by the channels' means and deviations."""
        of_channels = (torch.tensor(values).view(1, 3, 1, 1) for values in (self.mean, self.std))
        mean, std = (values.to(inputs.device, non_blocking=True) for values in of_channels)
        return (inputs.float() * self.rescale - mean) / std

    def restore(self, predicted: Tensor, size: tuple[int, int]) -> Tensor:
        """A prediction [B, 1, h, w] of any size to the photos' size, without what was added at their edges."""
        rows, columns = self._margins(*size)
        height, width = size
        whole = F.interpolate(predicted, (height + 2 * rows, width + 2 * columns), mode="bilinear", align_corners=False)
        return whole[..., rows : rows + height, columns : columns + width].contiguous()

    def _margins(self, height: int, width: int) -> tuple[int, int]:
        """Rows and columns that are added at each edge."""
        if not self.reflect:
            return 0, 0
        return int(math.sqrt(height / 2) * REFLECTED_SHARE), int(math.sqrt(width / 2) * REFLECTED_SHARE)


def _is_number(value: Any, above: float = -math.inf) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and above < value < math.inf


def _are_channels(value: Any, above: float = -math.inf) -> bool:
    return isinstance(value, list | tuple) and len(value) == 3 and all(_is_number(one, above) for one in value)


def _is_size(value: Any) -> bool:
    sides = list(value.values()) if isinstance(value, dict) and value.keys() in ({"height", "width"}, {"shortest_edge"}) else [value]
    return all(isinstance(side, int) and _is_number(side, 0) for side in sides)


# What a folder may say, in words and as a test.
OPTIONS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    **dict.fromkeys(("do_resize", "do_rescale", "do_normalize", "do_pad"), ("true or false", lambda value: isinstance(value, bool))),
    **dict.fromkeys(("rescale_factor", "ensure_multiple_of", "size_divisor"), ("a number above 0", lambda value: _is_number(value, 0))),
    "resample": ("a whole number", lambda value: isinstance(value, int)),
    "size": ("a number of pixels, or height and width", _is_size),
    "image_mean": ("three numbers", _are_channels),
    "image_std": ("three numbers above 0", lambda value: _are_channels(value, 0)),
}


def read_preprocessing(name: str, folder: Any, config: Any, resolution: int | Literal["native"] | None) -> Preprocessing:
    """What the folder of a network says.

    Args:
        name: of the network, for messages.
        folder: its preprocessor_config.json, as JSON has it.
        config: the network's configuration (transformers).
        resolution: as in `DepthNetwork`.

    Raises:
        ValueError: an image processor that is not known, an option that has no such value, or a resolution that the network cannot take.
    """
    if not isinstance(folder, dict):
        raise ValueError(f'depth="{name}": its preprocessor_config.json holds options by name; got {folder!r}. Download it again')
    processor = folder.get("image_processor_type") or folder.get("feature_extractor_type") or ""
    kind = re.sub(r"(ImageProcessor|FeatureExtractor)(Fast|Pil)?$", "", str(processor))
    if kind not in CLASS_DEFAULTS:
        raise ValueError(
            f'depth="{name}" wants its photos prepared by {processor or "an image processor that it does not name"}; known are those of '
            f"{', '.join(CLASS_DEFAULTS)}. Load it yourself and give the stream a callable"
        )
    defaults = CLASS_DEFAULTS[kind]
    told = {**defaults, **{key: value for key, value in folder.items() if value is not None}}
    for option in told.keys() & OPTIONS.keys():
        wanted, fits = OPTIONS[option]
        if not fits(told[option]):
            raise ValueError(
                f'depth="{name}": {option} in its preprocessor_config.json is {wanted}; got {told[option]!r}. Download it again, or load '
                "the network yourself and give the stream a callable"
            )
    if told["resample"] not in RESAMPLING:
        raise ValueError(f'depth="{name}" resizes photos by method {told["resample"]}; known are {RESAMPLING}')

    own = told.get("size") if told.get("do_resize", True) else None
    short_side_px = None if own is None else int(own if isinstance(own, int) else min(own.values()))
    square = _takes_squares_alone(config)
    if resolution is not None:
        if _takes_one_size(config) and resolution != short_side_px:
            raise ValueError(f'depth="{name}" takes {short_side_px}x{short_side_px} pixels and nothing else; got resolution={resolution!r}')
        if square and resolution == "native":
            raise ValueError(f'depth="{name}" takes squares alone: resolution is a number of pixels or None; got "native"')
        short_side_px = None if resolution == "native" else resolution
    normalised = told.get("do_normalize", True)
    return Preprocessing(
        short_side_px=short_side_px,
        multiple_px=_multiple_px(told, config),
        square=square,
        rescale=float(told.get("rescale_factor", 1 / 255)) if told.get("do_rescale", True) else 1.0,
        mean=tuple(told["image_mean"]) if normalised else (0.0, 0.0, 0.0),
        std=tuple(told["image_std"]) if normalised else (1.0, 1.0, 1.0),
        mode=RESAMPLING[told["resample"]],
        antialias=defaults.get("antialias", True),
        align_corners=defaults.get("align_corners", False),
        reflect=defaults.get("reflect", False) and told.get("do_pad", True),
    )


def _takes_squares_alone(config: Any) -> bool:
    """Depth Pro cuts its input into a fixed grid; DPT on a ViT of its own (MiDaS 3.0) takes its tokens for a square."""
    if config.model_type == "depth_pro":
        return True
    return config.model_type == "dpt" and (getattr(config, "backbone_config", None) is None or getattr(config, "is_hybrid", False))


def _takes_one_size(config: Any) -> bool:
    """Depth Pro's grid of patches, and the features that DPT on a hybrid of convolutions and ViT expects, have one size."""
    return config.model_type == "depth_pro" or (config.model_type == "dpt" and getattr(config, "is_hybrid", False))


def _multiple_px(told: Mapping[str, Any], config: Any) -> int:
    backbone = getattr(config, "backbone_config", None)
    patch = getattr(backbone, "patch_size", None) or getattr(config, "patch_size", None)
    if patch is None or hasattr(backbone, "window_size"):
        patch = HIERARCHICAL_MULTIPLE_PX
    wanted = [patch, told.get("ensure_multiple_of") or 1, told.get("size_divisor") or 1]
    return math.lcm(*(int(value) for value in wanted if value >= 1))
