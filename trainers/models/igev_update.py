"""The recurrent update of IGEV-Stereo: that of RAFT-Stereo for a disparity, under its own published names.

`04`, `08`, `16` in the names are the share of the image's resolution.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from trainers.models.update import GRULevels, StepHead

# Of what the finest GRU saw, for the upsampling to full resolution.
UPSAMPLING_CHANNELS = 32


class MotionEncoder(nn.Module):
    """Geometry and the disparity [B, 1, h, w] that it was looked up with, together as [B, 128, h, w]."""

    outputs = 128

    def __init__(self, geometry: int) -> None:
        super().__init__()
        self.convc1 = nn.Conv2d(geometry, 64, 1)
        self.convc2 = nn.Conv2d(64, 64, 3, padding=1)
        self.convd1 = nn.Conv2d(1, 64, 7, padding=3)
        self.convd2 = nn.Conv2d(64, 64, 3, padding=1)
        self.conv = nn.Conv2d(64 + 64, self.outputs - 1, 3, padding=1)

    def forward(self, disparity: Tensor, geometry: Tensor) -> Tensor:
        c = F.relu(self.convc2(F.relu(self.convc1(geometry))))
        d = F.relu(self.convd2(F.relu(self.convd1(disparity))))
        motion = F.relu(self.conv(torch.cat([c, d], dim=1)))
        return torch.cat([motion, disparity.to(motion.dtype)], dim=1)


class IGEVUpdateBlock(GRULevels):
    """One update of all levels, and the step of the disparity that follows from it."""

    def __init__(self, geometry: int, hidden_dims: tuple[int, int, int], levels: int) -> None:
        super().__init__(("gru04", "gru08", "gru16"), MotionEncoder.outputs, hidden_dims, levels)
        fine = hidden_dims[-1]
        self.encoder = MotionEncoder(geometry)
        self.disp_head = StepHead(fine, 1)
        self.mask_feat_4 = nn.Sequential(nn.Conv2d(fine, UPSAMPLING_CHANNELS, 3, padding=1), nn.ReLU(inplace=True))

    def forward(
        self, hidden: list[Tensor], context: list[tuple[Tensor, ...]], geometry: Tensor, disparity: Tensor
    ) -> tuple[list[Tensor], Tensor]:
        """New hidden states of all levels, and the step of the disparity [B, 1, h, w]."""
        hidden = self.update_all(hidden, context, self.encoder(disparity, geometry))
        return hidden, self.disp_head(hidden[0])

    def upsampling_features(self, hidden: Tensor) -> Tensor:
        """[B, 32, h, w] of the finest hidden state."""
        return self.mask_feat_4(hidden)
