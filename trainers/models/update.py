"""The recurrent update of RAFT-Stereo: GRUs at up to three resolutions turn correlations into a step of the flow.

Modules carry the published parameter names; `08`, `16`, `32` mean full, half and quarter of the features' resolution.
IGEV-Stereo shares the GRUs and the convex upsampling.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class StepHead(nn.Module):
    """Hidden state to a step [B, outputs, h, w] of the estimate."""

    def __init__(self, inputs: int, outputs: int, hidden: int = 256) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, hidden, 3, padding=1)
        self.conv2 = nn.Conv2d(hidden, outputs, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv2(F.relu(self.conv1(x)))


class ConvGRU(nn.Module):
    """A GRU of 3x3 convolutions whose gates get a constant context each."""

    def __init__(self, hidden: int, inputs: int) -> None:
        super().__init__()
        self.convz = nn.Conv2d(hidden + inputs, hidden, 3, padding=1)
        self.convr = nn.Conv2d(hidden + inputs, hidden, 3, padding=1)
        self.convq = nn.Conv2d(hidden + inputs, hidden, 3, padding=1)

    def forward(self, h: Tensor, context: tuple[Tensor, ...], *inputs: Tensor) -> Tensor:
        context_z, context_r, context_q = context
        x = torch.cat(inputs, dim=1)
        hx = torch.cat([h, x], dim=1)
        z = torch.sigmoid(self.convz(hx) + context_z)
        r = torch.sigmoid(self.convr(hx) + context_r)
        q = torch.tanh(self.convq(torch.cat([r * h, x], dim=1)) + context_q)
        return (1 - z) * h + z * q


class MotionEncoder(nn.Module):
    """Correlations and the flow [B, 2, h, w] that they were looked up with, together as [B, 128, h, w]."""

    outputs = 128

    def __init__(self, correlations: int) -> None:
        super().__init__()
        self.convc1 = nn.Conv2d(correlations, 64, 1)
        self.convc2 = nn.Conv2d(64, 64, 3, padding=1)
        self.convf1 = nn.Conv2d(2, 64, 7, padding=3)
        self.convf2 = nn.Conv2d(64, 64, 3, padding=1)
        self.conv = nn.Conv2d(64 + 64, self.outputs - 2, 3, padding=1)

    def forward(self, flow: Tensor, correlations: Tensor) -> Tensor:
        c = F.relu(self.convc2(F.relu(self.convc1(correlations))))
        f = F.relu(self.convf2(F.relu(self.convf1(flow))))
        motion = F.relu(self.conv(torch.cat([c, f], dim=1)))
        return torch.cat([motion, flow.to(motion.dtype)], dim=1)


class GRULevels(nn.Module):
    """The GRUs of all levels, updated coarse to fine, each seeing the neighbouring levels.

    Args:
        names: of the GRUs' parameters, finest level first.
        motion: channels of what the finest GRU is told of the estimate.
        hidden_dims: channels of the hidden states, coarsest level first.
        levels: how many of the three are used, the finest first; all exist, as in the published weights.
    """

    def __init__(self, names: tuple[str, str, str], motion: int, hidden_dims: tuple[int, int, int], levels: int) -> None:
        super().__init__()
        coarse, middle, fine = hidden_dims
        self.names, self.levels = names, levels
        self.add_module(names[0], ConvGRU(fine, motion + (middle if levels > 1 else 0)))
        self.add_module(names[1], ConvGRU(middle, fine + (coarse if levels > 2 else 0)))
        self.add_module(names[2], ConvGRU(coarse, middle))

    def grus(self) -> list[nn.Module]:
        return [self.get_submodule(name) for name in self.names]

    def unused(self) -> list[nn.Module]:
        """The GRUs that so few levels do not touch."""
        return self.grus()[self.levels :]

    def update_coarse(self, hidden: list[Tensor], context: list[tuple[Tensor, ...]], finest: int) -> list[Tensor]:
        """New hidden states of the levels from the coarsest down to `finest` (1: half, 2: quarter resolution)."""
        hidden = list(hidden)
        _, middle, coarse = self.grus()
        if self.levels > 2 and finest <= 2:
            hidden[2] = coarse(hidden[2], context[2], halve(hidden[1]))
        if self.levels > 1 and finest <= 1:
            coarser = [resize_like(hidden[2], hidden[1])] if self.levels > 2 else []
            hidden[1] = middle(hidden[1], context[1], halve(hidden[0]), *coarser)
        return hidden

    def update_all(self, hidden: list[Tensor], context: list[tuple[Tensor, ...]], motion: Tensor) -> list[Tensor]:
        """New hidden states of all levels."""
        hidden = self.update_coarse(hidden, context, finest=1)
        coarser = [resize_like(hidden[1], hidden[0])] if self.levels > 1 else []
        hidden[0] = self.grus()[0](hidden[0], context[0], motion, *coarser)
        return hidden


class UpdateBlock(GRULevels):
    """One update of all levels, and the step of the flow that follows from it."""

    def __init__(self, correlations: int, hidden_dims: tuple[int, int, int], levels: int, upsampling: int) -> None:
        super().__init__(("gru08", "gru16", "gru32"), MotionEncoder.outputs, hidden_dims, levels)
        fine = hidden_dims[-1]
        self.encoder = MotionEncoder(correlations)
        self.flow_head = StepHead(fine, 2)  # the vertical half exists in the published weights and is not used
        self.mask = nn.Sequential(nn.Conv2d(fine, 256, 3, padding=1), nn.ReLU(inplace=True), nn.Conv2d(256, upsampling**2 * 9, 1))

    def forward(
        self, hidden: list[Tensor], context: list[tuple[Tensor, ...]], correlations: Tensor, flow: Tensor
    ) -> tuple[list[Tensor], Tensor]:
        """New hidden states of all levels, and the step of the flow [B, 2, h, w]."""
        hidden = self.update_all(hidden, context, self.encoder(flow, correlations))
        return hidden, self.flow_head(hidden[0])

    def upsampling_weights(self, hidden: Tensor) -> Tensor:
        """Logits [B, 9 f^2, h, w] for `convex_upsample`; the factor is the published balance of gradients."""
        return 0.25 * self.mask(hidden)


def halve(x: Tensor) -> Tensor:
    return F.avg_pool2d(x, 3, stride=2, padding=1)


def resize_like(x: Tensor, reference: Tensor) -> Tensor:
    return F.interpolate(x, reference.shape[2:], mode="bilinear", align_corners=True)


def convex_upsample(flow: Tensor, weights: Tensor, factor: int) -> Tensor:
    """Each fine value is a weighted mean of the 3x3 coarse ones around it, times `factor`.

    Args:
        flow: [B, 1, h, w] in coarse pixels; 0 beside the image.
        weights: logits [B, 9 factor^2, h, w]: neighbour (row by row), then fine row, then fine column.
        factor: of resolution.
    Returns:
        [B, 1, h factor, w factor] in fine pixels.
    """
    batch, _, height, width = flow.shape
    weights = weights.view(batch, 9, factor, factor, height, width).softmax(dim=1)
    neighbours = F.unfold(factor * flow, 3, padding=1).view(batch, 9, 1, 1, height, width)
    fine = (weights * neighbours).sum(dim=1)
    return fine.permute(0, 3, 1, 4, 2).reshape(batch, 1, height * factor, width * factor)
