"""IGEV-Stereo (Xu et al., CVPR 2023): recurrent updates of a disparity that starts from a filtered cost volume.

Options, parameter names and numbers are those of the published code, so that its checkpoints load and give what they gave.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from trainers.models import geometry_encoding
from trainers.models.conv_blocks import JoinFiner, conv_2d, conv_3d
from trainers.models.cost_volume import DISPARITY_MULTIPLE_PX, FeatureAttention, Hourglass, expected_disparity, groupwise_correlation
from trainers.models.extractor import ContextEncoder
from trainers.models.igev_update import UPSAMPLING_CHANNELS, IGEVUpdateBlock
from trainers.models.matcher import Matcher, check_padded
from trainers.models.mobilenet import CHANNELS, MobileNetV2
from trainers.models.update import convex_upsample

# The disparity is found at 1/4 of the resolution.
UPSAMPLING = 4
GROUPS = 8
STEM_CHANNELS = (32, 48)
# Backbone on its way back up, at 1/4, 1/8 and 1/16: what comes from below beside what was there.
PYRAMID_CHANNELS = (2 * CHANNELS[1], 2 * CHANNELS[2], 2 * CHANNELS[3])
MATCHING_CHANNELS = PYRAMID_CHANNELS[0] + STEM_CHANNELS[1]


class FeaturePyramid(MobileNetV2):
    """Images in -1..1 to features at 1/4, 1/8, 1/16 and 1/32, the coarse ones brought back into the fine ones."""

    def __init__(self) -> None:
        super().__init__()
        quarter, eighth, sixteenth = PYRAMID_CHANNELS
        self.deconv32_16 = JoinFiner(CHANNELS[4], CHANNELS[3])
        self.deconv16_8 = JoinFiner(sixteenth, CHANNELS[2])
        self.deconv8_4 = JoinFiner(eighth, CHANNELS[1])
        self.conv4 = conv_2d(quarter, quarter)

    def forward(self, images: Tensor) -> list[Tensor]:
        quarter, eighth, sixteenth, thirty_second = super().forward(images)
        sixteenth = self.deconv32_16(thirty_second, sixteenth)
        eighth = self.deconv16_8(sixteenth, eighth)
        return [self.conv4(self.deconv8_4(eighth, quarter)), eighth, sixteenth, thirty_second]


class IGEVStereo(Matcher):
    """The network; build it with `load_matcher("igev_stereo", **options)`.

    Args:
        hidden_dims: channels of the GRUs' hidden states, coarsest level first.
        corr_levels, corr_radius: levels of the lookup's pyramids, and how many steps it sees to each side.
        n_downsample: the GRUs work at 1 / 2^n_downsample of the resolution; 2, that of the cost volume.
        n_gru_layers: how many resolutions have a GRU, 1 to 3.
        max_disp: the cost volume covers 0 to this many pixels, a multiple of 32. Updates may go beyond.
        slow_fast_gru: the coarse GRUs are updated more often than the fine one.
    """

    PARTS = ("_encode", "_regress", "_upsample_initial", "_context", "_update", "_upsample")

    def __init__(
        self,
        hidden_dims: Sequence[int] = (128, 128, 128),
        corr_levels: int = 2,
        corr_radius: int = 4,
        n_downsample: int = 2,
        n_gru_layers: int = 3,
        max_disp: int = 192,
        slow_fast_gru: bool = False,
    ) -> None:
        super().__init__()
        for name, value, choices in (("n_downsample", n_downsample, (2,)), ("n_gru_layers", n_gru_layers, (1, 2, 3))):
            if value not in choices:
                raise ValueError(f"{name} is one of {', '.join(map(repr, choices))}; got {value!r}")
        if len(hidden_dims) != 3 or min(hidden_dims) < 1:
            raise ValueError(f"hidden_dims is three channel counts, coarsest level first; got {list(hidden_dims)}")
        if corr_levels < 1 or corr_radius < 1:
            raise ValueError(f"corr_levels and corr_radius are at least 1; got {corr_levels} and {corr_radius}")
        if max_disp < 1 or max_disp % DISPARITY_MULTIPLE_PX:
            raise ValueError(f"max_disp is a multiple of {DISPARITY_MULTIPLE_PX}; got {max_disp}")
        self.disparities = max_disp // UPSAMPLING
        self.least_width_px = UPSAMPLING * 2 ** (corr_levels - 1)
        if max_disp < self.least_width_px:
            raise ValueError(f"max_disp {max_disp} is too small for {corr_levels} corr_levels, which need {self.least_width_px}")
        coarse, middle, fine = hidden_dims
        self.corr_levels, self.corr_radius = corr_levels, corr_radius
        self.n_gru_layers, self.slow_fast_gru = n_gru_layers, slow_fast_gru
        self.encode_geometry = geometry_encoding.geometry_encoding

        self.cnet = ContextEncoder("batch", n_downsample, (coarse, middle, fine), names=("outputs04", "outputs08", "outputs16"))
        geometry_channels = corr_levels * (2 * corr_radius + 1) * (GROUPS + 1)
        self.update_block = IGEVUpdateBlock(geometry_channels, (coarse, middle, fine), n_gru_layers)
        self.context_zqr_convs = nn.ModuleList(nn.Conv2d(dim, 3 * dim, 3, padding=1) for dim in (fine, middle, coarse)[:n_gru_layers])

        self.feature = FeaturePyramid()
        half, quarter = STEM_CHANNELS
        self.stem_2 = nn.Sequential(conv_2d(3, half, stride=2), *plain_conv(half))
        self.stem_4 = nn.Sequential(conv_2d(half, quarter, stride=2), *plain_conv(quarter))

        # From 1/4 to full resolution: the initial disparity by the image alone, ...
        self.spx_4 = nn.Sequential(conv_2d(MATCHING_CHANNELS, CHANNELS[1]), *plain_conv(CHANNELS[1]))
        self.spx_2 = JoinFiner(CHANNELS[1], half)
        self.spx = nn.Sequential(nn.ConvTranspose2d(2 * half, 9, 4, stride=2, padding=1))
        # ... the updated ones by the hidden state.
        self.spx_2_gru = JoinFiner(UPSAMPLING_CHANNELS, half, norm=nn.BatchNorm2d)
        self.spx_gru = nn.Sequential(nn.ConvTranspose2d(2 * half, 9, 4, stride=2, padding=1))

        self.conv = conv_2d(MATCHING_CHANNELS, MATCHING_CHANNELS)
        self.desc = nn.Conv2d(MATCHING_CHANNELS, MATCHING_CHANNELS, 1)
        self.corr_stem = conv_3d(GROUPS, GROUPS)
        self.corr_feature_att = FeatureAttention(GROUPS, MATCHING_CHANNELS)
        self.cost_agg = Hourglass(GROUPS, (*PYRAMID_CHANNELS[1:], CHANNELS[4]))
        self.classifier = nn.Conv3d(GROUPS, 1, 3, padding=1, bias=False)
        # Published checkpoints hold the weights of all levels. Those that this configuration never uses take no gradient, which
        # would otherwise stop distributed training.
        for module in [*self.cnet.unused(n_gru_layers), *self.update_block.unused()]:
            module.requires_grad_(False)

    def forward(
        self, left: Tensor, right: Tensor, iterations: int = 22, every_iteration: bool = True
    ) -> tuple[Tensor | None, list[Tensor]]:
        """Disparities of the left view: the initial one, regressed from the cost volume, and one per update, first update first.

        Args:
            left, right: RGB, 0..255, [B, 3, H, W], H and W multiples of 32 (`predict` takes any size).
            iterations: how many updates, at least 1.
            every_iteration: False upsamples the last prediction only: the initial one is None, and the list holds just the last.
        Returns:
            Positive disparities [B, 1, H, W], float32, in pixels.
        """
        check_padded(left, right, self.least_width_px)
        if iterations < 1:
            raise ValueError(f"iterations is at least 1; got {iterations}")
        left, right = 2 * (left / 255) - 1, 2 * (right / 255) - 1
        half_resolution, features, left_matching, right_matching = self._encode(left, right)
        volume, disparity = self._regress(features, left_matching, right_matching)
        full_precision = torch.autocast(left.device.type, enabled=False)  # correlations and disparities overflow or lose steps in half
        with full_precision:
            lookup = self.encode_geometry(volume.float(), left_matching.float(), right_matching.float(), self.corr_levels, self.corr_radius)
        initial = self._upsample_initial(disparity, features[0], half_resolution) if every_iteration else None
        hidden, context = self._context(left)
        sequence = []
        for i in range(iterations):
            disparity = disparity.detach()
            with full_precision:
                geometry = lookup(disparity)
            hidden, disparity = self._update(hidden, context, geometry, disparity)
            if every_iteration or i == iterations - 1:
                sequence.append(self._upsample(disparity, hidden[0], half_resolution))
        return initial, sequence

    def compile_parts(self, **options: Any) -> None:
        super().compile_parts(**options)
        look_up = torch.compile(geometry_encoding.look_up, fullgraph=True, dynamic=False, **options)
        self.encode_geometry = partial(geometry_encoding.geometry_encoding, look_up=look_up)

    def _encode(self, left: Tensor, right: Tensor) -> tuple[Tensor, list[Tensor], Tensor, Tensor]:
        """Of the left view, features at 1/2 and at 1/4, 1/8, 1/16 and 1/32; of both views, those to match, at 1/4. Images in -1..1."""
        both = torch.cat([left, right])
        half_resolution = self.stem_2(both)
        quarter, *coarser = self.feature(both)
        quarter = torch.cat([quarter, self.stem_4(half_resolution)], dim=1)
        left_matching, right_matching = self.desc(self.conv(quarter)).chunk(2)
        features = [level.chunk(2)[0] for level in (quarter, *coarser)]
        return half_resolution.chunk(2)[0], features, left_matching, right_matching

    def _regress(self, features: list[Tensor], left_matching: Tensor, right_matching: Tensor) -> tuple[Tensor, Tensor]:
        """The geometry encoding volume, and the disparity [B, 1, h, w] in it."""
        with torch.autocast(left_matching.device.type, enabled=False):
            volume = groupwise_correlation(left_matching.float(), right_matching.float(), self.disparities, GROUPS)
        volume = self.corr_feature_att(self.corr_stem(volume), features[0])
        volume = self.cost_agg(volume, features[1:])
        scores = self.classifier(volume)[:, 0]
        with torch.autocast(scores.device.type, enabled=False):
            return volume, expected_disparity(scores.float())

    def _context(self, left: Tensor) -> tuple[list[Tensor], list[tuple[Tensor, ...]]]:
        """First hidden states and gate contexts of each GRU level."""
        outputs = self.cnet.heads(self.cnet(left), self.n_gru_layers)
        hidden = [torch.tanh(output[0]) for output in outputs]
        context = [conv(torch.relu(output[1])).chunk(3, dim=1) for output, conv in zip(outputs, self.context_zqr_convs, strict=True)]
        return hidden, context

    def _update(
        self, hidden: list[Tensor], context: list[tuple[Tensor, ...]], geometry: Tensor, disparity: Tensor
    ) -> tuple[list[Tensor], Tensor]:
        """Hidden states and disparity [B, 1, h, w] after one update."""
        if self.slow_fast_gru:
            for finest in range(self.n_gru_layers - 1, 0, -1):
                hidden = self.update_block.update_coarse(hidden, context, finest)
        hidden, step = self.update_block(hidden, context, geometry, disparity)
        return hidden, disparity + step.float()

    def _upsample_initial(self, disparity: Tensor, features: Tensor, half_resolution: Tensor) -> Tensor:
        """The initial disparity at full resolution, by the image alone."""
        return upsample(disparity, self.spx(self.spx_2(self.spx_4(features), half_resolution)))

    def _upsample(self, disparity: Tensor, hidden: Tensor, half_resolution: Tensor) -> Tensor:
        """An updated disparity at full resolution, by the hidden state."""
        features = self.update_block.upsampling_features(hidden)
        return upsample(disparity, self.spx_gru(self.spx_2_gru(features, half_resolution)))


def plain_conv(channels: int) -> list[nn.Module]:
    return [nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.InstanceNorm2d(channels), nn.ReLU(inplace=True)]


def upsample(disparity: Tensor, weights: Tensor) -> Tensor:
    """Disparity [B, 1, h, w] to full resolution, by logits [B, 9, 4 h, 4 w] of each fine pixel's 3x3 coarse neighbours."""
    with torch.autocast(disparity.device.type, enabled=False):
        return convex_upsample(disparity, F.pixel_unshuffle(weights.float(), UPSAMPLING), UPSAMPLING)
