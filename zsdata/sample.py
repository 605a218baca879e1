"""What a training pair is: its fields, shapes, units and frames.

========================  =======  ================  =============================================================
field                     dtype    shape             meaning
========================  =======  ================  =============================================================
left, right               float32  [B, 3, H, W]      RGB, 0..255, augmented: what the matcher sees
disparity                 float32  [B, 1, H, W]      pixels of this crop, > 0, left frame: left (x, y) is right (x - d, y)
confidence                float32  [B, 1, H, W]      0..1, left frame: how far the label can be trusted
masks.nonocclusion        bool     [B, 1, H, W]      left frame: True where the left pixel is visible in the right image
masks.inpaint             bool     [B, 1, H, W]      right frame: True where the right pixel is seen by no left pixel (was invented)
masks.valid               bool     [B, 1, H, W]      left frame: True where the label may supervise
left_clean, right_clean   float32  [B, 3, H, W]      the same pair before augmentation
meta                      list     B dictionaries    where the sample came from and how it was drawn (plain JSON values)
========================  =======  ================  =============================================================

A single pair has the same fields without the leading B, and one dictionary as `meta`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.data._utils.collate import default_collate_fn_map


class Masks(NamedTuple):
    """Three boolean maps; the table at the top of this file says what is True in each and in whose frame."""

    nonocclusion: Tensor
    inpaint: Tensor
    valid: Tensor


@dataclass(frozen=True)
class StereoBatch:
    """One training pair, or a batch of them; `left, right, disparity, confidence, masks = batch` unpacks it."""

    left: Tensor
    right: Tensor
    disparity: Tensor
    confidence: Tensor
    masks: Masks
    left_clean: Tensor
    right_clean: Tensor
    meta: Any

    def __iter__(self) -> Iterator[Any]:
        return iter((self.left, self.right, self.disparity, self.confidence, self.masks))

    def __len__(self) -> int:
        """How many pairs are in the batch."""
        if self.left.ndim == 3:
            raise TypeError("a single pair has no length; collate pairs with StereoBatch.stack first")
        return self.left.shape[0]

    def __getitem__(self, index: int) -> StereoBatch:
        """Pair `index` of a batch."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"pair {index} of a batch of {len(self)}")
        pair = self._map(lambda tensor: tensor[index])
        return replace(pair, meta=self.meta[index])

    def _map(self, change: Any) -> StereoBatch:
        changed = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Masks):
                value = Masks(*map(change, value))
            elif isinstance(value, Tensor):
                value = change(value)
            changed[field.name] = value
        return StereoBatch(**changed)

    def to(self, *args: Any, **kwargs: Any) -> StereoBatch:
        """Moves every tensor to a device, as `Tensor.to(device, non_blocking=...)` does; dtypes are part of the contract and stay."""
        if any(isinstance(value, torch.dtype) for value in (*args, *kwargs.values())):
            raise TypeError("StereoBatch.to moves a batch to a device; convert the dtype of a single field yourself")
        return self._map(lambda tensor: tensor.to(*args, **kwargs))

    def pin_memory(self) -> StereoBatch:
        """The same batch in page-locked memory."""
        return self._map(lambda tensor: tensor.pin_memory())

    @staticmethod
    def stack(pairs: Sequence[StereoBatch]) -> StereoBatch:
        """Single pairs to one batch, in order."""
        if not pairs:
            raise ValueError("a batch needs at least one pair, got none")
        stacked = {}
        for field in fields(StereoBatch):
            values = [getattr(pair, field.name) for pair in pairs]
            if field.name == "masks":
                stacked["masks"] = Masks(*map(torch.stack, zip(*values, strict=True)))
            elif field.name == "meta":
                stacked["meta"] = values
            else:
                stacked[field.name] = torch.stack(values)
        return StereoBatch(**stacked)


# A torch DataLoader around the stream collates pairs as `stack` does.
default_collate_fn_map[StereoBatch] = lambda pairs, *, collate_fn_map=None: StereoBatch.stack(pairs)
