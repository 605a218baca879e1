"""What a matcher is judged by while it trains, and which of its checkpoints was best."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from accelerate.utils import gather_object

from trainers.benchmarks_on_disk import BENCHMARKS
from trainers.evaluate import OUT_OF_MEMORY, evaluate, open_dataset
from trainers.pairs_on_disk import StereoPair
from trainers.scores import METRICS, mean_scores
from trainers.strips import Predict

BEST_BY = "bad_2"  # Middlebury's measure; does not hang on the few pixels that are far off, as EPE does


@dataclass(frozen=True)
class EvaluationSet:
    """One data set to judge by, as `trainers.evaluate.open_dataset` opens it."""

    name: str
    dataset: str
    root: Path | None = None
    variant: str | None = None

    @staticmethod
    def parse(spec: str) -> EvaluationSet:
        """ "motorcycle", "kitti2015=ROOT", "middlebury:F=ROOT", "folder=ROOT", or a folder of pairs by its path alone.

        Raises:
            ValueError, FileNotFoundError: it cannot be opened; says what was expected where.
        """
        name, _, root = spec.partition("=")
        dataset, _, variant = name.partition(":")
        if dataset in ("motorcycle", *BENCHMARKS):
            if (dataset == "motorcycle") == bool(root):
                raise ValueError(
                    f"{spec}: the motorcycle comes with scikit-image and has no folder" if root else f"say where it lies: {name}=DIR"
                )
            parsed = EvaluationSet(name, dataset, Path(root) if root else None, variant or None)
        elif root and name != "folder" and not Path(spec).is_dir():
            raise ValueError(f'{spec}: no data set is called "{dataset}"; there is motorcycle, {", ".join(BENCHMARKS)}, folder')
        else:
            folder = Path(root if name == "folder" else spec)
            parsed = EvaluationSet(folder.resolve().name, "folder", folder)
        parsed.pairs()
        return parsed

    def pairs(self, *, rank: int = 0, world_size: int = 1) -> tuple[Iterator[StereoPair], int]:
        """The pairs of one rank, read one by one, and how many there are for all of them."""
        return open_dataset(self.dataset, self.root, self.variant, rank=rank, world_size=world_size)


class Validation:
    """Judges on several sets, shared out over the ranks, and remembers the best."""

    def __init__(self, sets: Sequence[EvaluationSet], best_by: str = BEST_BY, iterations: int | None = None) -> None:
        """`iterations` of the matcher that is judged: values of other ones, or of other sets, are not compared."""
        if best_by not in METRICS:
            raise ValueError(f"best_by is one of {', '.join(METRICS)}; got {best_by!r}")
        names = [one.name for one in sets]
        if len(set(names)) < len(names):
            raise ValueError(f"two evaluation sets have one name: {', '.join(names)}; put the pairs of both below one folder")
        self.sets = list(sets)
        self.best_by = best_by
        self.best: dict[str, Any] | None = None  # {"step", "value", "by", "sets", "iterations"}
        self.judged_step: int | None = None  # the last one
        self._told_by = {"by": best_by, "sets": sorted(names), "iterations": iterations}

    def judge(
        self, predict: Predict, *, device: torch.device, rank: int, world_size: int, out_of_memory: str = OUT_OF_MEMORY
    ) -> dict[str, list[dict[str, Any]]]:
        """The scores of every pair of every set, as `trainers.evaluate.evaluate` returns them, the same on all ranks.

        Each rank reads only the pairs that it judges. Rank 0 shows how far it has come.
        """
        results = {}
        for one in self.sets:
            mine, total = one.pairs(rank=rank, world_size=world_size)
            below = BENCHMARKS[one.dataset].below_px if one.dataset in BENCHMARKS else ()
            places = range(rank, total, world_size)
            scores = evaluate(
                predict, mine, device=device, total=len(places), below_px=below, progress=rank == 0, out_of_memory=out_of_memory
            )
            together = gather_object(list(zip(places, scores, strict=True)))
            results[one.name] = [score for _, score in sorted(together, key=lambda entry: entry[0])]
        return results

    def is_best(self, results: dict[str, list[dict[str, Any]]], step: int) -> bool:
        """Whether these results are the best so far, which is then remembered. Without sets nothing is.

        What counts is `best_by` over all pixels with ground truth, averaged over the pairs of a set and then over the sets; less is better.
        """
        self.judged_step = step
        value = self.value(results)
        if value is None or (self.best is not None and value >= self.best["value"]):
            return False
        self.best = {"step": step, "value": value, **self._told_by}
        return True

    def value(self, results: dict[str, list[dict[str, Any]]]) -> float | None:
        """What the best is told by; None without a pixel to judge."""
        means = [mean_scores(scores)["all"][self.best_by] for scores in results.values()]
        known = [mean for mean in means if mean is not None]
        return math.fsum(known) / len(known) if known else None

    def state_dict(self) -> dict[str, Any]:
        return {"best": self.best, "judged_step": self.judged_step}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on with the best of an earlier run, unless that was told by another measure, other sets or other iterations."""
        self.judged_step = state["judged_step"]
        best = state["best"]
        same = best is not None and all(best.get(name) == value for name, value in self._told_by.items() if self.sets or name == "by")
        self.best = best if same else None
