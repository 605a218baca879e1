"""RAFT-Stereo (Lipson, Teed and Deng, 3DV 2021): recurrent updates of a disparity from row-wise correlations.

Options, parameter names and numbers are those of the published code, so that its checkpoints load and give what they gave.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from trainers.models import correlation
from trainers.models.correlation import correlation_on_demand, correlation_pyramid
from trainers.models.extractor import NORMS, TRUNK_CHANNELS, ContextEncoder, FeatureEncoder, ResidualBlock
from trainers.models.matcher import Matcher, check_padded
from trainers.models.update import UpdateBlock, convex_upsample

CORRELATIONS = {"reg": correlation_pyramid, "alt": correlation_on_demand}


class RAFTStereo(Matcher):
    """The network; build it with `load_matcher("raft_stereo", **options)`.

    Args:
        hidden_dims: channels of the GRUs' hidden states, coarsest level first.
        corr_implementation: "reg" keeps all correlations, "alt" computes them when they are looked up: less memory, the same numbers.
        corr_levels, corr_radius: levels of the correlation pyramid, and how many pixels a lookup sees to each side.
        n_downsample: features have 1 / 2^n_downsample of the resolution, 2 or 3.
        context_norm: "batch", "group", "instance" or "none" in the context encoder.
        n_gru_layers: how many resolutions have a GRU, 1 to 3.
        slow_fast_gru: the coarse GRUs are updated more often than the fine one.
        shared_backbone: one encoder for features and context.
    """

    PARTS = ("_encode", "_update", "_upsample")

    def __init__(
        self,
        hidden_dims: Sequence[int] = (128, 128, 128),
        corr_implementation: str = "reg",
        corr_levels: int = 4,
        corr_radius: int = 4,
        n_downsample: int = 2,
        context_norm: str = "batch",
        n_gru_layers: int = 3,
        slow_fast_gru: bool = False,
        shared_backbone: bool = False,
    ) -> None:
        super().__init__()
        for name, value, choices in (
            ("corr_implementation", corr_implementation, tuple(CORRELATIONS)),
            ("n_downsample", n_downsample, (2, 3)),
            ("context_norm", context_norm, NORMS),
            ("n_gru_layers", n_gru_layers, (1, 2, 3)),
        ):
            if value not in choices:
                raise ValueError(f"{name} is one of {', '.join(map(repr, choices))}; got {value!r}")
        if len(hidden_dims) != 3 or min(hidden_dims) < 1:
            raise ValueError(f"hidden_dims is three channel counts, coarsest level first; got {list(hidden_dims)}")
        if corr_levels < 1 or corr_radius < 1:
            raise ValueError(f"corr_levels and corr_radius are at least 1; got {corr_levels} and {corr_radius}")
        coarse, middle, fine = hidden_dims
        self.correlate = CORRELATIONS[corr_implementation]
        self.corr_levels, self.corr_radius = corr_levels, corr_radius
        self.n_gru_layers, self.slow_fast_gru = n_gru_layers, slow_fast_gru
        self.upsampling = 2**n_downsample
        self.cnet = ContextEncoder(context_norm, n_downsample, (coarse, middle, fine))
        self.update_block = UpdateBlock(corr_levels * (2 * corr_radius + 1), (coarse, middle, fine), n_gru_layers, self.upsampling)
        self.context_zqr_convs = nn.ModuleList(nn.Conv2d(dim, 3 * dim, 3, padding=1) for dim in (fine, middle, coarse)[:n_gru_layers])
        self.shared_backbone = shared_backbone
        if shared_backbone:
            block = ResidualBlock(TRUNK_CHANNELS, TRUNK_CHANNELS, "instance")
            self.conv2 = nn.Sequential(block, nn.Conv2d(TRUNK_CHANNELS, 256, 3, padding=1))
        else:
            self.fnet = FeatureEncoder(n_downsample)
        # Published checkpoints hold the weights of all levels. Those that this configuration never uses take no gradient, which
        # would otherwise stop distributed training.
        unused = [*self.cnet.unused(n_gru_layers), *self.update_block.unused()]
        for module in unused:
            module.requires_grad_(False)

    def forward(self, left: Tensor, right: Tensor, iterations: int = 22, every_iteration: bool = True) -> tuple[None, list[Tensor]]:
        """Disparities of the left view, first iteration first.

        Args:
            left, right: RGB, 0..255, [B, 3, H, W], H and W multiples of 32 (`predict` takes any size).
            iterations: how many updates, at least 1.
            every_iteration: False upsamples the last prediction only, and the list holds just that one.
        Returns:
            None (RAFT-Stereo has no initial prediction), and positive disparities [B, 1, H, W], float32, in pixels.
        """
        check_padded(left, right, least_width_px=self.upsampling * 2 ** (self.corr_levels - 1))
        if iterations < 1:
            raise ValueError(f"iterations is at least 1; got {iterations}")
        hidden, context, left_features, right_features = self._encode(2 * (left / 255) - 1, 2 * (right / 255) - 1)
        full_precision = torch.autocast(left.device.type, enabled=False)  # correlations and disparities overflow or lose steps in half
        with full_precision:
            lookup = self.correlate(left_features.float(), right_features.float(), self.corr_levels, self.corr_radius)
        batch, _, height, width = left_features.shape
        x = torch.arange(width, device=left.device, dtype=torch.float32).expand(batch, 1, height, width)
        # Inside, the published network thinks in horizontal flow, right minus left column: minus the disparity.
        flow = torch.zeros_like(x)
        sequence = []
        for i in range(iterations):
            flow = flow.detach()
            with full_precision:
                correlations = lookup(x + flow)
            hidden, flow = self._update(hidden, context, correlations, flow)
            if every_iteration or i == iterations - 1:
                sequence.append(self._upsample(flow, hidden[0]))
        return None, sequence

    def compile_parts(self, **options: Any) -> None:
        super().compile_parts(**options)
        if self.correlate is correlation_pyramid:
            look_up = torch.compile(correlation.look_up, fullgraph=True, dynamic=False, **options)
            self.correlate = partial(correlation_pyramid, look_up=look_up)

    def _update(
        self, hidden: list[Tensor], context: list[tuple[Tensor, ...]], correlations: Tensor, flow: Tensor
    ) -> tuple[list[Tensor], Tensor]:
        """Hidden states and flow [B, 1, h, w] after one update."""
        if self.slow_fast_gru:
            for finest in range(self.n_gru_layers - 1, 0, -1):
                hidden = self.update_block.update_coarse(hidden, context, finest)
        hidden, step = self.update_block(hidden, context, correlations, torch.cat([flow, torch.zeros_like(flow)], dim=1))
        return hidden, flow + step[:, :1].float()

    def _upsample(self, flow: Tensor, hidden: Tensor) -> Tensor:
        """The disparity at full resolution."""
        weights = self.update_block.upsampling_weights(hidden)
        with torch.autocast(flow.device.type, enabled=False):
            return -convex_upsample(flow, weights.float(), self.upsampling)

    def _encode(self, left: Tensor, right: Tensor) -> tuple[list[Tensor], list[tuple[Tensor, ...]], Tensor, Tensor]:
        """First hidden states and gate contexts of each GRU level, and the features of both views; images in -1..1."""
        both = torch.cat([left, right])
        if self.shared_backbone:
            trunk = self.cnet(both)
            features = self.conv2(trunk)
            outputs = self.cnet.heads(trunk[: len(left)], self.n_gru_layers)
        else:
            features = self.fnet(both)
            outputs = self.cnet.heads(self.cnet(left), self.n_gru_layers)
        hidden = [torch.tanh(output[0]) for output in outputs]
        context = [conv(torch.relu(output[1])).chunk(3, dim=1) for output, conv in zip(outputs, self.context_zqr_convs, strict=True)]
        left_features, right_features = features.chunk(2)
        return hidden, context, left_features, right_features
