"""The Accelerator of a training: one process, or several that each hold the whole network; and a tracker that is there."""

from __future__ import annotations

import warnings
from pathlib import Path

import torch
from accelerate import Accelerator, DistributedType
from accelerate.tracking import GeneralTracker

WHOLE_ON_EACH = (DistributedType.NO, DistributedType.MULTI_CPU, DistributedType.MULTI_GPU)


def open_accelerator(mixed_precision: str | None, tracker: str | GeneralTracker | None, output: Path) -> Accelerator:
    """As `accelerate launch` set it up.

    Raises:
        ImportError: the tracker's package is not installed.
        ValueError: the network would be cut into shards, or run in another way that these trainers know nothing of.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "`log_with=")  # said as an error below
        accelerator = Accelerator(
            cpu=not torch.accelerator.is_available(),  # without it, ranks that torchrun starts on a CPU do not find each other
            mixed_precision=mixed_precision,
            log_with=tracker,
            project_dir=str(output),
        )
    if tracker is not None and not accelerator.log_with:
        raise ImportError(f"the tracker {tracker} is not installed: pip install {tracker}, or choose another one with --tracker, or none")
    if accelerator.distributed_type not in WHOLE_ON_EACH:
        raise ValueError(
            f"accelerate launch was told to use {accelerator.distributed_type.value}; these trainers keep the whole network on each GPU, "
            "or in each process on the CPU, and save nothing else: launch with --multi_gpu or --cpu, or run `accelerate config` again"
        )
    return accelerator
