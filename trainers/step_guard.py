"""Steps that would ruin the weights: told alike on all ranks, skipped, counted, and written down with their samples."""

from __future__ import annotations

import json
import math
from collections import deque
from pathlib import Path
from statistics import median
from typing import Any, Protocol

import torch
from accelerate import Accelerator
from accelerate.utils import gather_object
from torch import Tensor, nn

MOST_SKIPPED_IN_A_ROW = 8
# A hard batch has a few times the loss of the others; gradients are clipped, so only what is far beyond that does harm.
EXPLOSION = 100.0  # times the median of the recent losses
RECENT_STEPS = 100
FEWEST_STEPS = 20  # before there is a median to go by
IDS = ("epoch", "index", "source", "shard", "key")


class Batch(Protocol):
    """What a step learns from."""

    @property
    def meta(self) -> list[dict[str, Any]]:
        """Of each sample, IDS as far as they are known."""
        ...


class TrainingDiverged(RuntimeError):
    """Too many steps in a row had to be skipped."""


class StepGuard:
    """Watches every batch, and says for every optimizer step whether it may be taken.

    A step is refused where the loss of any batch on any rank is not finite or exploded, or where the gradient is not finite (in half
    precision only once the gradient scaler has no scale left to lower). The statistics of batch norms, which the batch has changed
    by then, are set back.

    Args:
        path: the file that lists the samples of skipped steps.
        hint: how to look at them.
    """

    def __init__(
        self, accelerator: Accelerator, network: nn.Module, path: Path, hint: str = "stream.replay(epoch, index) shows them"
    ) -> None:
        self.loss = math.nan  # of the last step, mean over batches and ranks
        self.gradient_norm = math.nan
        self.skipped = 0
        self._in_a_row = 0
        self._recent: deque[float] = deque(maxlen=RECENT_STEPS)
        self._seen: list[tuple[Tensor, Batch]] = []
        self._accelerator = accelerator
        self._path = path
        self._hint = hint
        self._buffers = [buffer for module in network.modules() if module.training for buffer in module.buffers(recurse=False)]
        self._before = [buffer.clone() for buffer in self._buffers]

    def watch(self, loss: Tensor, batch: Batch) -> None:
        """One batch of the step."""
        self._seen.append((loss.detach(), batch))

    def refuses(self, step: int, gradient_norm: Tensor) -> bool:
        """Whether the step is to be skipped; the same answer on all ranks, which all must ask.

        Raises:
            TrainingDiverged: when too many in a row are.
        """
        own = torch.stack([*(loss for loss, _ in self._seen), gradient_norm.detach()]).float()
        ranks: list[list[float]] = self._accelerator.gather(own[None]).tolist()  # type: ignore[union-attr]
        losses = [loss for *of_rank, _ in ranks for loss in of_rank]
        self.loss, self.gradient_norm = sum(losses) / len(losses), sum(norm for *_, norm in ranks) / len(ranks)
        reason = self._reason(losses)
        if reason is None:
            self._in_a_row = 0
            self._recent.append(self.loss)
            self._before = [buffer.clone() for buffer in self._buffers]
        else:
            self.skipped += 1
            self._in_a_row += 1
            for buffer, before in zip(self._buffers, self._before, strict=True):
                buffer.copy_(before)
            suspects = self._write(step, reason)
        self._seen = []
        if reason is not None and self._in_a_row >= MOST_SKIPPED_IN_A_ROW:
            raise TrainingDiverged(
                f"{reason} at step {step}, as something was in each of the last {self._in_a_row} steps, which were skipped; "
                f"{self._path} lists their samples, {self._hint}, the last ones: {suspects}. "
                "Lower the learning rate, or resume from an earlier checkpoint"
            )
        return reason is not None

    def state_dict(self) -> dict[str, Any]:
        """Plain numbers, the same on all ranks."""
        return {"skipped": self.skipped, "in_a_row": self._in_a_row, "recent": list(self._recent)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.skipped, self._in_a_row = state["skipped"], state["in_a_row"]
        self._recent = deque(state["recent"], maxlen=RECENT_STEPS)

    def _limit(self) -> float:
        """Beyond this loss a batch has exploded."""
        return EXPLOSION * median(self._recent) if len(self._recent) >= FEWEST_STEPS else math.inf

    def _reason(self, losses: list[float]) -> str | None:
        bad = [loss for loss in losses if _is_bad(loss, self._limit())]
        if bad:
            usual = f", usual is {median(self._recent):.4g}" if self._recent else ""
            return f"the loss is {bad[0]:.4g}{usual}"
        if not math.isfinite(self.gradient_norm):
            scaler = self._accelerator.scaler
            if scaler is None or scaler.get_scale() <= 1:
                return f"the gradient's norm is {self.gradient_norm}"
        return None

    def _write(self, step: int, reason: str) -> str:
        """Writes down the batches of all ranks that may be to blame; returns their samples in short."""
        own = [
            {
                "rank": self._accelerator.process_index,
                "loss": loss.item(),
                "samples": [{name: meta.get(name) for name in IDS} for meta in batch.meta],
            }
            for loss, batch in self._seen
        ]
        batches = gather_object(own)
        blamed = [entry for entry in batches if _is_bad(entry["loss"], self._limit())] or batches
        if self._accelerator.is_main_process:
            with self._path.open("a") as file:
                for entry in blamed:
                    loss = entry["loss"] if math.isfinite(entry["loss"]) else str(entry["loss"])  # JSON has no NaN
                    file.write(json.dumps({"step": step, "reason": reason, **entry, "loss": loss}) + "\n")
        return ", ".join(f"({sample['epoch']}, {sample['index']}, {sample['key']})" for entry in blamed for sample in entry["samples"])


def _is_bad(loss: float, limit: float) -> bool:
    return not math.isfinite(loss) or loss > limit
