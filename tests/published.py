"""Reference values of the published matchers and loss, and the weights they were made with (see tests/data/published/README.md)."""

from __future__ import annotations

import json
from math import prod, sqrt
from pathlib import Path
from zlib import crc32

import numpy as np
import torch
from torch import Tensor

FOLDER = Path(__file__).parent / "data" / "published"


def published_values(name: str) -> dict[str, Tensor]:
    """The arrays of one .npz file."""
    with np.load(FOLDER / f"{name}.npz") as arrays:
        return {key: torch.from_numpy(arrays[key]) for key in arrays.files}


def published_weights(name: str) -> dict[str, Tensor]:
    """A state dictionary with every published name: each tensor is drawn from its own name."""
    shapes = json.loads((FOLDER / f"{name}.json").read_text())
    return {key: _weight(key, tuple(shape)) for key, shape in shapes.items()}


def _weight(name: str, shape: tuple[int, ...]) -> Tensor:
    if not shape:
        return torch.tensor(0)
    r = np.random.default_rng(crc32(name.encode())).standard_normal(shape).astype(np.float32)
    if name.endswith("running_var"):
        r = 1 + 0.1 * np.abs(r)
    elif name.endswith(("running_mean", "bias")):
        r = 0.1 * r
    elif len(shape) == 1:
        r = 1 + 0.1 * r
    else:
        r = r / np.float32(sqrt(prod(shape[1:])))
    return torch.from_numpy(r.astype(np.float32))
