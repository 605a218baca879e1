"""MobileNetV2 (Sandler et al., CVPR 2018) down to 1/32 of the resolution, without its last stage and its classifier.

Parameters are named as in IGEV-Stereo's checkpoints: the stages of timm's `mobilenetv2_100`, one block per resolution.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import torch.nn.functional as F
from torch import Tensor, nn

from trainers.models.checkpoint import read_weights, some

STEM_CHANNELS = 32
# Channels at 1/2, 1/4, 1/8, 1/16 and 1/32.
CHANNELS = (16, 24, 32, 96, 160)
EXPANSION = 6
# Where timm's stages 0 to 5 went.
TIMM_STAGES = ("block0.0", "block1.0", "block2.0", "block3.0", "block3.1", "block4.0")
TIMM_LEFT_OUT = ("blocks.6.", "conv_head.", "bn2.", "classifier.")  # the last stage, the head, and its norm


class DepthwiseSeparable(nn.Module):
    """A 3x3 convolution of each channel by itself, and a linear mix of them."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv_dw = nn.Conv2d(inputs, inputs, 3, padding=1, groups=inputs, bias=False)
        self.bn1 = nn.BatchNorm2d(inputs)
        self.conv_pw = nn.Conv2d(inputs, outputs, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        return self.bn2(self.conv_pw(relu6(self.bn1(self.conv_dw(x)))))


class InvertedResidual(nn.Module):
    """To six times the channels, 3x3 each by itself, and back; plus the input where the shape stays."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        wide = EXPANSION * inputs
        self.conv_pw = nn.Conv2d(inputs, wide, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(wide)
        self.conv_dw = nn.Conv2d(wide, wide, 3, stride=stride, padding=1, groups=wide, bias=False)
        self.bn2 = nn.BatchNorm2d(wide)
        self.conv_pwl = nn.Conv2d(wide, outputs, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(outputs)
        self.residual = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        y = relu6(self.bn1(self.conv_pw(x)))
        y = relu6(self.bn2(self.conv_dw(y)))
        y = self.bn3(self.conv_pwl(y))
        return x + y if self.residual else y


class MobileNetV2(nn.Module):
    """Images [B, 3, H, W] in -1..1 to features at 1/4, 1/8, 1/16 and 1/32 of the resolution, with CHANNELS[1:] channels."""

    def __init__(self) -> None:
        super().__init__()
        half, quarter, eighth, sixteenth, thirty_second = CHANNELS
        self.conv_stem = nn.Conv2d(3, STEM_CHANNELS, 3, stride=2, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(STEM_CHANNELS)
        self.block0 = nn.Sequential(nn.Sequential(DepthwiseSeparable(STEM_CHANNELS, half)))
        self.block1 = nn.Sequential(stage(half, quarter, 2, stride=2))
        self.block2 = nn.Sequential(stage(quarter, eighth, 3, stride=2))
        self.block3 = nn.Sequential(stage(eighth, 64, 4, stride=2), stage(64, sixteenth, 3, stride=1))
        self.block4 = nn.Sequential(stage(sixteenth, thirty_second, 3, stride=2))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                # Keeps the signal's size by itself. With torch's default it shrinks to 1e-7, and frozen norms would not bring it back.
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")

    def forward(self, images: Tensor) -> list[Tensor]:
        x = self.block0(relu6(self.bn1(self.conv_stem(images))))
        features = []
        for block in (self.block1, self.block2, self.block3, self.block4):
            x = block(x)
            features.append(x)
        return features


def load_imagenet_weights(backbone: MobileNetV2, path: str | PathLike[str]) -> None:
    """Loads the weights of timm's `mobilenetv2_100`, which the published training starts from.

    Args:
        backbone: keeps what it has besides a MobileNetV2.
        path: timm's .safetensors or .pth file; its last stage and classifier are left out.
    Raises:
        FileNotFoundError: no such file.
        ValueError: a file of another kind or of another network; says what is missing and what is left over.
    """
    weights = {name: tensor for name, tensor in read_weights(Path(path)).items() if not name.startswith(TIMM_LEFT_OUT)}
    own = backbone.state_dict()
    names = {_timm_name(name): name for name in MobileNetV2().state_dict()}
    missing = [
        f"{timm} {list(own[name].shape)}"
        for timm, name in names.items()
        if not name.endswith("num_batches_tracked") and (timm not in weights or weights[timm].shape != own[name].shape)
    ]
    left_over = [name for name in weights if name not in names]
    if missing or left_over:
        lists = f"missing: {some(missing) or 'nothing'}; left over: {some(left_over) or 'nothing'}"
        raise ValueError(f"{path} is no mobilenetv2_100 of timm ({lists})")
    backbone.load_state_dict(own | {names[timm]: tensor for timm, tensor in weights.items()})


def _timm_name(name: str) -> str:
    for i, prefix in enumerate(TIMM_STAGES):
        if name.startswith(f"{prefix}."):
            return f"blocks.{i}" + name.removeprefix(prefix)
    return name


def stage(inputs: int, outputs: int, blocks: int, stride: int) -> nn.Sequential:
    shapes = [(inputs, stride)] + [(outputs, 1)] * (blocks - 1)
    return nn.Sequential(*(InvertedResidual(channels, outputs, step) for channels, step in shapes))


def relu6(x: Tensor) -> Tensor:
    return F.relu6(x, inplace=True)
