"""The scores of one prediction, region by region, and their means as the papers' tables have them."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from trainers.pairs_on_disk import StereoPair
from zsdata.metrics import D1_PIXELS, D1_SHARE, disparity_edges

# (absolute errors, true disparities) -> what the score is the mean of: those of `zsdata.metrics`, but of errors that are computed once.
METRICS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "epe": lambda errors, truth: errors,
    "bad_0.5": lambda errors, truth: errors > 0.5,
    "bad_1": lambda errors, truth: errors > 1,
    "bad_2": lambda errors, truth: errors > 2,
    "bad_3": lambda errors, truth: errors > 3,
    "d1": lambda errors, truth: (errors > D1_PIXELS) & (errors > D1_SHARE * truth.abs()),
}
HEADINGS = {"epe": "EPE px", "bad_0.5": "bad-0.5 %", "bad_1": "bad-1 %", "bad_2": "bad-2 %", "bad_3": "bad-3 %", "d1": "D1 %"}
EDGES = "_edges"
MEANS = ("mean over pairs", "mean over pixels")
# More pairs than this would bury the means: then --json and --csv hold what each of them got.
MOST_PAIRS_IN_TABLE = 40


def score(prediction: Tensor, pair: StereoPair, below_px: Sequence[float] = ()) -> dict[str, dict[str, Any] | None]:
    """The scores of one prediction in every region.

    Args:
        prediction: disparity [H, W], pixels, positive, on the CPU.
        below_px: further regions: only the points whose true disparity is smaller than this.
    Returns:
        For the regions "all" (every point with ground truth) and "noc" (those that both cameras see; None where the pair does not
        tell), and of either "..._edges" (near depth edges, `zsdata.metrics.disparity_edges`) and "..._below_N": "pixels" (how many
        counted), and the METRICS: "epe" in pixels, all others as shares in 0..1; None without a pixel to count.
    Raises:
        ValueError: a prediction that is not finite where it counts.
    """
    disparity, valid = torch.from_numpy(pair.disparity), torch.from_numpy(pair.valid)
    edges = disparity_edges(disparity, valid)[valid]
    truth = disparity[valid]
    seen = None if pair.nonoccluded is None else torch.from_numpy(pair.nonoccluded[pair.valid])
    values = _values(prediction[valid], truth)
    parts = {"": torch.ones_like(edges), EDGES: edges} | {f"_below_{limit:g}": truth < limit for limit in below_px}
    scores: dict[str, dict[str, Any] | None] = {}
    for suffix, counted in parts.items():
        scores[f"all{suffix}"] = _means(values, counted)
        scores[f"noc{suffix}"] = None if seen is None else _means(values, counted & seen)
    return scores


def mean_scores(results: Sequence[dict[str, Any]], *, over_pixels: bool = False) -> dict[str, dict[str, Any]]:
    """The means in each region; "pairs" says how many had a pixel to count.

    Args:
        results: as `trainers.evaluate.evaluate` returns them.
        over_pixels: False: each pair counts alike, as in the paper's tables and on Middlebury and ETH3D. True: each pixel counts alike,
            as RAFT-Stereo's code averages the outliers of KITTI and Scene Flow.
    """
    means = {}
    for region in regions(results):
        scored = [result[region] for result in results if result[region] is not None and result[region]["pixels"]]
        weights = [scores["pixels"] if over_pixels else 1 for scores in scored]
        means[region] = {"pairs": len(scored)} | {name: _mean([scores[name] for scores in scored], weights) for name in METRICS}
    return means


def regions(results: Sequence[dict[str, Any]]) -> list[str]:
    """The regions of the results, "all" and "noc" first."""
    first = results[0] if results else {"all": None, "noc": None}
    return [name for name in first if name.startswith(("all", "noc"))]


def all_means(results: Sequence[dict[str, Any]]) -> dict[str, dict[str, dict[str, Any]]]:
    """{"mean over pairs", "mean over pixels", and for each group "GROUP, mean over pairs": {region: means}}."""
    means = {MEANS[0]: mean_scores(results), MEANS[1]: mean_scores(results, over_pixels=True)}
    groups = sorted({result.get("group", "") for result in results})
    if len(groups) > 1:
        for group in groups:
            means[f"{group}, {MEANS[0]}"] = mean_scores([result for result in results if result.get("group", "") == group])
    return means


def table(results: Sequence[dict[str, Any]]) -> str:
    """The results and their means as text, shares in percent. Errors on edges stand with the means only."""
    rows = []
    if len(results) <= MOST_PAIRS_IN_TABLE:
        shown = [region for region in regions(results) if not region.endswith(EDGES)]
        rows = [(result["name"], region, result[region]) for result in results for region in shown if result[region] is not None]
    for name, means in all_means(results).items():
        rows += [(f"{name} ({mean['pairs']})", region, mean) for region, mean in means.items() if mean["pairs"]]
    widths = [max(len(row[i]) for row in [("pair", "region"), *[row[:2] for row in rows]]) for i in (0, 1)]
    lines = [f"{'pair':{widths[0]}}  {'region':{widths[1]}}  " + "  ".join(HEADINGS.values())]
    for name, region, scores in rows:
        cells = [f"{_number(scores[key], 1 if key == 'epe' else 100):>{len(heading)}}" for key, heading in HEADINGS.items()]
        lines.append(f"{name:{widths[0]}}  {region:{widths[1]}}  " + "  ".join(cells))
    return "\n".join(lines)


def write_csv(path: Path, results: Sequence[dict[str, Any]]) -> None:
    """One line for each pair and region, then for each mean and region; shares in 0..1, empty where there is nothing to count."""
    lines: list[tuple[str, str, dict[str, Any]]] = [(result["name"], result.get("group", ""), result) for result in results] + [
        (name, "", means) for name, means in all_means(results).items()
    ]
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["name", "group", "region", "pixels", *METRICS])
        for name, group, scored in lines:
            for region in regions(results):
                scores = scored[region]
                if scores is not None:
                    writer.writerow([name, group, region, scores.get("pixels"), *[scores[key] for key in METRICS]])


def _values(estimate: Tensor, truth: Tensor) -> dict[str, Tensor]:
    """What each of the METRICS is the mean of, for every pixel with ground truth."""
    for name, disparity in (("prediction", estimate), ("disparity", truth)):
        broken = int((~disparity.isfinite()).sum())
        if broken:
            raise ValueError(f"{name} is not finite at {broken} of {disparity.numel()} valid pixels")
    truth = truth.double()
    errors = (estimate.double() - truth).abs()
    return {name: metric(errors, truth) for name, metric in METRICS.items()}


def _means(values: dict[str, Tensor], counted: Tensor) -> dict[str, Any]:
    pixels = int(counted.sum())
    if not pixels:
        return {"pixels": 0, **dict.fromkeys(METRICS)}
    return {"pixels": pixels} | {
        name: int((value & counted).sum()) / pixels if value.dtype == torch.bool else value[counted].mean().item()
        for name, value in values.items()
    }


def _mean(values: list[float], weights: list[int]) -> float | None:
    return math.fsum(value * weight for value, weight in zip(values, weights, strict=True)) / sum(weights) if values else None


def _number(value: float | None, factor: int) -> str:
    return "-" if value is None else f"{value * factor:.2f}"
