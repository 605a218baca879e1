"""What a matcher learns from: the paper's loss, or one of those that its ablations put in its place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from trainers.ranks import mean_over_ranks
from zsdata import StereoBatch, zero_stereo_loss

LOSSES = {
    "zero": "L_Zero: C L_d, and (1 - C) L_np where the label is not trusted",
    "l1": "C L_d alone",
    "l1+lp": "C L_d, and the ordinary photometric loss of every pixel",
}
MU = 0.1  # weight of the photometric term in the paper


@dataclass(frozen=True, kw_only=True)
class TrainingLoss:
    """(initial prediction, sequence, batch) -> (loss, metrics), as `trainers.loop.train` takes it.

    Its means are those of the pairs of all ranks together, once the ranks' gradients are averaged.

    Args:
        name: a key of LOSSES.
        max_disparity: labels of this many pixels or more do not supervise; 700 as published for RAFT-Stereo, 192 for IGEV-Stereo.
        trusted: every label has confidence 1, and nothing is left for the photometric term of "zero": it is not computed.
    """

    name: str = "zero"
    max_disparity: float = 700
    trusted: bool = False

    def __post_init__(self) -> None:
        if self.name not in LOSSES:
            raise ValueError(f"a loss is one of {', '.join(LOSSES)}; got {self.name!r}")
        if self.max_disparity <= 0:
            raise ValueError(f"max_disparity is above 0 px; got {self.max_disparity}")

    def __call__(self, initial: Tensor | None, sequence: list[Tensor], batch: StereoBatch) -> tuple[Tensor, dict[str, Any]]:
        without = self.name == "l1" or (self.name == "zero" and self.trusted)
        return zero_stereo_loss(
            sequence,
            batch.left_clean,
            batch.right_clean,
            batch.disparity,
            batch.confidence,
            batch.masks,
            initial_prediction=initial,
            mu=0 if without else MU,
            max_disparity=self.max_disparity,
            photometric="ordinary" if self.name == "l1+lp" else "nonocclusion",
            mean_over_ranks=mean_over_ranks,
        )
