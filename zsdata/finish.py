"""The finish: what the training device does to a batch that the workers prepared. Holes are filled, then both images are augmented."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass

import torch

from zsdata.augment import AugmentConfig, augment
from zsdata.meter import Meter
from zsdata.sample import Masks, StereoBatch
from zsdata.seeding import rng
from zsdata.synthesis.inpaint import Inpainter, fill
from zsdata.worker import Prepared, single_thread


@dataclass(frozen=True)
class Finisher:
    """Prepared batches to finished ones, on one device. Nothing here depends on which samples share a batch."""

    inpainter: Inpainter
    augmentation: AugmentConfig
    micro_batch: int
    device: torch.device

    @torch.no_grad()
    def __call__(self, prepared: Prepared, meter: Meter) -> StereoBatch:
        """A batch of prepared samples (with a batch axis) to a StereoBatch on the device; its images and labels are new tensors.

        On the CPU one thread does it: the workers have the others, and no sum depends on how many there are."""
        with single_thread() if self.device.type == "cpu" else nullcontext():
            return self._finish(prepared, meter)

    def _finish(self, prepared: Prepared, meter: Meter) -> StereoBatch:
        with meter.stage("transfer"):
            left, right, disparity, confidence, nonocclusion, inpaint = (
                tensor.to(self.device, non_blocking=True)
                for tensor in (
                    prepared.left,
                    prepared.right,
                    prepared.disparity,
                    prepared.confidence,
                    prepared.nonocclusion,
                    prepared.inpaint,
                )
            )
            context = {name: tensor.to(self.device, non_blocking=True).float() for name, tensor in prepared.context.items()}
        left_clean = left.float()
        with meter.stage("inpaint"):
            filled = fill(self.inpainter, right.float(), inpaint, self._generators(prepared, "inpaint"), context, self.micro_batch)
            width = left.shape[-1]  # the right view reaches further, for the inpainter's sake
            right_clean, inpaint = filled[..., :width].contiguous(), inpaint[..., :width].contiguous()
        with meter.stage("augment"):
            left, right = augment(left_clean, right_clean, self._generators(prepared, "augment"), self.augmentation)
        masks = Masks(nonocclusion, inpaint, valid=disparity > 0)
        return StereoBatch(left, right, disparity, confidence, masks, left_clean, right_clean, prepared.meta)

    @staticmethod
    def _generators(prepared: Prepared, purpose: str):
        return [rng(meta["seed"], meta["epoch"], meta["index"], purpose) for meta in prepared.meta]
