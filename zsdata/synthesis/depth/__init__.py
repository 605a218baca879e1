"""Depth estimators: from a name to a callable.

A depth estimator is anything that maps images, float32 [B, 3, H, W] RGB 0..255, to inverse depth, float32 [B, 1, H, W], larger is nearer,
in any scale and offset. It is normalised per photo afterwards.
"""

from __future__ import annotations

import os
from collections.abc import Callable

import torch
from torch import Tensor

DepthEstimator = Callable[[Tensor], Tensor]


def load_depth(depth: str | os.PathLike[str] | DepthEstimator, device: str | torch.device = "cpu") -> DepthEstimator:
    """Turns the stream's `depth` argument into a callable `depth(images) -> inverse_depth`.

    Args:
        depth: "builtin"; a Hub id or a local folder in the transformers format (needs the "depth" extra); or a callable, returned as it is.
        device: where a network is put; the built-in estimator follows its input.
    """
    if callable(depth):
        return depth
    name = os.fspath(depth)
    if name == "builtin":
        from zsdata.synthesis.depth.builtin import BuiltinDepth

        return BuiltinDepth()
    from zsdata.synthesis.depth.pretrained import PretrainedDepth

    return PretrainedDepth(name, device)
