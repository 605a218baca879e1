"""Convolutions with their norm and leaky ReLU, the bricks of IGEV-Stereo, named `conv` and `bn` as published."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from trainers.models.rank_norm import RankBatchNorm3d

Norm2d = type[nn.BatchNorm2d] | type[nn.InstanceNorm2d]


class ConvBlock(nn.Module):
    """A convolution without bias, a norm, a leaky ReLU."""

    def __init__(self, conv: nn.Module, norm: nn.Module) -> None:
        super().__init__()
        self.conv = conv
        self.bn = norm

    def forward(self, x: Tensor) -> Tensor:
        return F.leaky_relu(self.bn(self.conv(x)), inplace=True)


def conv_2d(inputs: int, outputs: int, kernel: int = 3, stride: int = 1, norm: Norm2d = nn.InstanceNorm2d) -> ConvBlock:
    return ConvBlock(nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2, bias=False), norm(outputs))


def conv_3d(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> ConvBlock:
    return ConvBlock(nn.Conv3d(inputs, outputs, kernel, stride, padding=kernel // 2, bias=False), RankBatchNorm3d(outputs))


def double_3d(inputs: int, outputs: int) -> ConvBlock:
    """Twice the resolution of all three axes."""
    return ConvBlock(nn.ConvTranspose3d(inputs, outputs, 4, stride=2, padding=1, bias=False), RankBatchNorm3d(outputs))


class JoinFiner(nn.Module):
    """Features at twice the resolution, joined with finer ones of `outputs` channels: 2 outputs channels."""

    def __init__(self, inputs: int, outputs: int, norm: Norm2d = nn.InstanceNorm2d) -> None:
        super().__init__()
        self.conv1 = ConvBlock(nn.ConvTranspose2d(inputs, outputs, 4, stride=2, padding=1, bias=False), norm(outputs))
        self.conv2 = conv_2d(2 * outputs, 2 * outputs, norm=norm)

    def forward(self, x: Tensor, finer: Tensor) -> Tensor:
        return self.conv2(torch.cat([self.conv1(x), finer], dim=1))
