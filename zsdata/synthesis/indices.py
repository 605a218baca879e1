"""Where a mask is True: dense maps to the short lists that the exact steps work on."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def flat_indices(mask: Tensor) -> Tensor:
    """Indices into the flattened mask, int64, ascending. On the CPU numpy finds them, four times as fast as torch."""
    if mask.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.flatten().nonzero().squeeze(1)
