"""How a training is accelerated: one process, or several that each hold the whole network; its tracker; what its optimizer knows."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator, DistributedType
from accelerate.optimizer import AcceleratedOptimizer
from accelerate.tracking import GeneralTracker
from accelerate.utils import GradientAccumulationPlugin
from torch.optim.lr_scheduler import LRScheduler

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
            # A step has as many batches at the end of an epoch as ever; how many, each trainer says.
            gradient_accumulation_plugin=GradientAccumulationPlugin(num_steps=1, sync_with_dataloader=False),
        )
    if tracker is not None and not accelerator.log_with:
        raise ImportError(f"the tracker {tracker} is not installed: pip install {tracker}, or choose another one with --tracker, or none")
    if accelerator.distributed_type not in WHOLE_ON_EACH:
        raise ValueError(
            f"accelerate launch was told to use {accelerator.distributed_type.value}; these trainers keep the whole network on each GPU, "
            "or in each process on the CPU, and save nothing else: launch with --multi_gpu or --cpu, or run `accelerate config` again"
        )
    if accelerator.scaler is not None:  # its first steps may only find the scale; torch takes a schedule that goes on for a mistake
        warnings.filterwarnings("ignore", "Detected call of `lr_scheduler.step")
    return accelerator


def optimizer_state(optimizer: AcceleratedOptimizer, schedule: LRScheduler, accelerator: Accelerator) -> dict[str, Any]:
    """What a run that is resumed needs of them: tensors and numbers."""
    return {
        "optimizer": optimizer.state_dict(),
        "schedule": schedule.state_dict(),
        "scaler": accelerator.scaler.state_dict() if accelerator.scaler is not None else {},
    }


def load_optimizer_state(state: dict[str, Any], optimizer: AcceleratedOptimizer, schedule: LRScheduler, accelerator: Accelerator) -> None:
    """Goes on from `optimizer_state`. The optimizer has been through `accelerator.prepare`: that would take its step counters, one for
    each weight, to the GPU, and every step would wait for each of them."""
    optimizer.load_state_dict(state["optimizer"])
    schedule.load_state_dict(state["schedule"])
    if accelerator.scaler is not None and state["scaler"]:
        accelerator.scaler.load_state_dict(state["scaler"])
