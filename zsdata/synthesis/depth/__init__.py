"""Depth estimators: from a name to a callable.

A depth estimator is anything that maps images, float32 [B, 3, H, W] RGB 0..255, to inverse depth, float32 [B, 1, H, W], larger is nearer,
in any scale and offset. It is normalised per photo afterwards.

One that has more to offer is asked for it: `with_mirrored(images) -> (inverse_depth, mirrored)` estimates photo and mirrored photo
together; `prepare` and `predict_mirrored` let its two halves run in two places; `warm_up(size, samples)` makes it ready and says what
memory it takes (see `PretrainedDepth`).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from zsdata.synthesis.depth.options import STORED, DepthNetwork

DepthEstimator = Callable[[Tensor], Tensor]


def as_network(depth: str | os.PathLike[str] | DepthNetwork | DepthEstimator) -> DepthNetwork | None:
    """The network behind the stream's `depth` argument; None for the built-in estimator, stored depth and callables."""
    if isinstance(depth, DepthNetwork):
        return depth
    if callable(depth) or depth_name(depth) in ("builtin", STORED):
        return None
    return DepthNetwork(depth_name(depth))


def depth_name(depth: str | os.PathLike[str]) -> str:
    """The stream's `depth` argument as text, where it is neither a network with options nor a callable.

    Raises:
        TypeError: it is none of these.
    """
    if not isinstance(depth, str | os.PathLike) or not isinstance(os.fspath(depth), str):
        raise TypeError(f'depth is "builtin", "stored", a Hub id, a folder, a DepthNetwork or a callable; got {depth!r}')
    return os.fspath(depth)


def load_depth(
    depth: str | os.PathLike[str] | DepthNetwork | DepthEstimator, device: str | torch.device = "cpu", **options: Any
) -> DepthEstimator:
    """Turns the stream's `depth` argument into a callable `depth(images) -> inverse_depth`.

    Args:
        depth: "builtin"; a Hub id or a local folder in the transformers format (needs the "depth" extra), or a `DepthNetwork` with
            options; or a callable, returned as it is.
        device: where a network is put; the built-in estimator follows its input.
        options: of a network given by name, those of `DepthNetwork`: `resolution`, `revision`, `dtype`, ...

    Raises:
        TypeError: options for something that takes none, or something that is no `depth`.
        ValueError: "stored", which is no estimator.
    """
    if isinstance(depth, DepthNetwork):
        if options:
            raise TypeError(f"a DepthNetwork has its options already; got {sorted(options)} beside it")
        network = depth
    elif callable(depth):
        if options:
            raise TypeError(f"a callable estimator takes no options; got {sorted(options)}")
        return depth
    elif depth_name(depth) == "builtin":
        if options:
            raise TypeError(f'depth="builtin" takes no options; got {sorted(options)}')
        from zsdata.synthesis.depth.builtin import BuiltinDepth

        return BuiltinDepth()
    elif depth_name(depth) == STORED:
        raise ValueError(
            f'depth="{STORED}" is no estimator: it stands for the maps beside the photos (KEY.depth.npy, KEY.depth.png), which '
            "ZeroStereoStream reads; here, name an estimator"
        )
    else:
        network = DepthNetwork(depth_name(depth), **options)
    from zsdata.synthesis.depth.pretrained import PretrainedDepth

    return PretrainedDepth(network, device)
