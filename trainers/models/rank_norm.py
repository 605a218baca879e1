"""Batch norm of volumes by the statistics of all ranks' pairs: N ranks learn what one rank with N times the batch learns.

The published IGEV-Stereo keeps the batch norms of its images frozen (`Matcher.freeze_bn`), but not those of its cost volumes: no
pre-trained statistics exist for them. Its trainers let every GPU normalise by its own pairs, so that the number of GPUs changes the
network; with one rank there is no difference to it. torch's own SyncBatchNorm does not run on the CPU and cannot be compiled whole.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.distributed as distributed
from torch import Tensor, nn

VOLUME_AXES = (0, 2, 3, 4)


class RankBatchNorm3d(nn.BatchNorm3d):
    """BatchNorm3d, the same to the letter in evaluation and on one rank; in training on several, each holding as many pairs, the mean
    and the variance are those of all pairs together, and gradients flow through them to all ranks."""

    def forward(self, input: Tensor) -> Tensor:
        ranks = distributed.get_world_size() if distributed.is_available() and distributed.is_initialized() else 1
        if not self.training or ranks == 1:
            return super().forward(input)
        assert self.running_mean is not None and self.running_var is not None
        assert self.num_batches_tracked is not None and self.momentum is not None
        volume = input.float()  # under autocast it may be in half precision, in which sums of so many values drown
        mean = mean_over_ranks(volume.mean(VOLUME_AXES))
        centred = volume - _along_channels(mean)
        variance = mean_over_ranks(centred.square().mean(VOLUME_AXES))
        with torch.no_grad():
            values = ranks * volume.numel() // volume.shape[1]
            self.num_batches_tracked += 1
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(variance * (values / (values - 1)), self.momentum)
        scale = self.weight * (variance + self.eps).rsqrt()
        return (centred * _along_channels(scale) + _along_channels(self.bias)).to(input.dtype)


@torch.library.custom_op("zsdata::mean_over_ranks", mutates_args=(), schema="(Tensor values) -> Tensor")
def mean_over_ranks(values: Tensor) -> Tensor:
    """The mean of `values` over all ranks, which all must ask for. One opaque operation, which torch.compile need not look into."""
    total = values.clone()
    distributed.all_reduce(total)
    return total / distributed.get_world_size()


@mean_over_ranks.register_fake
def _like(values: Tensor) -> Tensor:
    return torch.empty_like(values)


def _gradient(context: Any, gradient: Tensor) -> Tensor:
    """Every rank's loss depends on every rank's values, by 1 / ranks."""
    return mean_over_ranks(gradient.contiguous())


mean_over_ranks.register_autograd(_gradient)


def _along_channels(values: Tensor) -> Tensor:
    return values[:, None, None, None]
