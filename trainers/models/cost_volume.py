"""The geometry encoding volume of IGEV-Stereo: a cost for each pixel and disparity, weighed by the image and filtered in 3D."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from trainers.models.conv_blocks import conv_2d, conv_3d, double_3d

# Three halvings of the disparity axis in the hourglass, which starts at 1/4 resolution.
DISPARITY_MULTIPLE_PX = 4 * 2**3


def groupwise_correlation(left: Tensor, right: Tensor, disparities: int, groups: int) -> Tensor:
    """How well features of the left view match those of the right view (Guo et al., CVPR 2019).

    Args:
        left, right: features [B, C, H, W].
        disparities: D; 0, ..., D - 1 are tried.
        groups: of channels, C a multiple.
    Returns:
        [B, groups, D, H, W]: the mean over a group of left (x) times right (x - d); 0 where x - d lies beside the image.
    """
    width = left.shape[-1]
    planes = []
    for disparity in range(disparities):
        shift = min(disparity, width)
        product = left[..., shift:] * right[..., : width - shift]
        planes.append(F.pad(product.unflatten(1, (groups, -1)).mean(2), (shift, 0)))
    return torch.stack(planes, dim=2)


def expected_disparity(scores: Tensor) -> Tensor:
    """The mean of 0, ..., D - 1 under the softmax of scores [B, D, H, W], as [B, 1, H, W]."""
    disparities = torch.arange(scores.shape[1], device=scores.device, dtype=scores.dtype)
    return torch.einsum("bdhw,d->bhw", scores.softmax(dim=1), disparities)[:, None]


class FeatureAttention(nn.Module):
    """Weighs the channels of a volume [B, C, D, H, W] in 0..1 by what the image features [B, F, H, W] show."""

    def __init__(self, channels: int, features: int) -> None:
        super().__init__()
        inner = features // 2
        self.feat_att = nn.Sequential(conv_2d(features, inner, kernel=1, norm=nn.BatchNorm2d), nn.Conv2d(inner, channels, 1))

    def forward(self, volume: Tensor, features: Tensor) -> Tensor:
        return torch.sigmoid(self.feat_att(features))[:, :, None] * volume


class Hourglass(nn.Module):
    """Filters a volume at 1/4 resolution through 1/8, 1/16 and 1/32 and back, with feature attention at each step.

    Args:
        channels: of the volume.
        features: channels of the image features at 1/8, 1/16 and 1/32.
    """

    def __init__(self, channels: int, features: tuple[int, int, int]) -> None:
        super().__init__()
        eighth, sixteenth, thirty_second = 2 * channels, 4 * channels, 6 * channels
        self.conv1 = nn.Sequential(conv_3d(channels, eighth, stride=2), conv_3d(eighth, eighth))
        self.conv2 = nn.Sequential(conv_3d(eighth, sixteenth, stride=2), conv_3d(sixteenth, sixteenth))
        self.conv3 = nn.Sequential(conv_3d(sixteenth, thirty_second, stride=2), conv_3d(thirty_second, thirty_second))
        self.conv3_up = double_3d(thirty_second, sixteenth)
        self.conv2_up = double_3d(sixteenth, eighth)
        self.conv1_up = nn.Sequential()
        self.conv1_up.add_module("conv", nn.ConvTranspose3d(eighth, channels, 4, stride=2, padding=1, bias=False))
        self.agg_0 = aggregation(sixteenth)
        self.agg_1 = aggregation(eighth)
        self.feature_att_8 = FeatureAttention(eighth, features[0])
        self.feature_att_16 = FeatureAttention(sixteenth, features[1])
        self.feature_att_32 = FeatureAttention(thirty_second, features[2])
        self.feature_att_up_16 = FeatureAttention(sixteenth, features[1])
        self.feature_att_up_8 = FeatureAttention(eighth, features[0])

    def forward(self, volume: Tensor, features: list[Tensor]) -> Tensor:
        """The volume [B, channels, D, H, W] filtered; D, H and W multiples of 8."""
        features_8, features_16, features_32 = features
        volume_8 = self.feature_att_8(self.conv1(volume), features_8)
        volume_16 = self.feature_att_16(self.conv2(volume_8), features_16)
        volume_32 = self.feature_att_32(self.conv3(volume_16), features_32)
        volume_16 = self.agg_0(torch.cat([self.conv3_up(volume_32), volume_16], dim=1))
        volume_16 = self.feature_att_up_16(volume_16, features_16)
        volume_8 = self.agg_1(torch.cat([self.conv2_up(volume_16), volume_8], dim=1))
        volume_8 = self.feature_att_up_8(volume_8, features_8)
        return self.conv1_up(volume_8)


def aggregation(channels: int) -> nn.Sequential:
    """Two volumes of as many channels, one behind the other, to one."""
    return nn.Sequential(conv_3d(2 * channels, channels, kernel=1), conv_3d(channels, channels), conv_3d(channels, channels))
