"""Judges a matcher on stereo pairs with ground truth.

    python trainers/evaluate.py --model raft --checkpoint raftstereo-sceneflow.pth --dataset middlebury --root MiddEval3/trainingH
    python trainers/evaluate.py --model raft --checkpoint runs/first/checkpoints/step-00200000 --dataset motorcycle --json scores.json
    python trainers/evaluate.py --model sgbm --dataset folder --root pairs --pictures pictures

Per pair and as a mean over the pairs: EPE, the mean absolute error in pixels; bad-N, the share of pixels that are off by more than N px;
D1, the share that is off by more than 3 px and 5 %. "all" counts every pixel with ground truth, "noc" those that both cameras
see, where the pair comes with a mask of them. A pair without such a pixel is left out of the mean.

--dataset folder: ROOT is a pair or holds one folder per pair, with left.*, right.* and disp.* (png, jpg, tif; disp also pfm); optional
mask_left.png (255: visible in both views), and pair.json {"divisor": N} for what stored disparities are divided by.
kitti2015, middlebury, eth3d, drivingstereo: the folder that the benchmark was unpacked into. motorcycle: ships with scikit-image.
"""

from __future__ import annotations

import argparse
import inspect
import json
import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from trainers.benchmarks_on_disk import BENCHMARKS
from trainers.models import MATCHERS, load_trained
from trainers.pairs_on_disk import StereoPair, find_pairs, motorcycle, read_pair
from trainers.sgbm import sgbm
from zsdata.metrics import bad_pixel_rate, d1, end_point_error

Predict = Callable[[Tensor, Tensor], Tensor]

METRICS: dict[str, Callable[[Tensor, Tensor, Tensor], float]] = {
    "epe": end_point_error,
    "bad_1": lambda *maps: bad_pixel_rate(*maps, threshold_px=1),
    "bad_2": lambda *maps: bad_pixel_rate(*maps, threshold_px=2),
    "bad_3": lambda *maps: bad_pixel_rate(*maps, threshold_px=3),
    "d1": d1,
}
REGIONS = ("all", "noc")
MODELS = {name.removesuffix("_stereo"): name for name in MATCHERS}
WORST_ERROR_PX = 10.0  # brightest in the error pictures


def evaluate(
    predict: Predict,
    pairs: Iterable[StereoPair],
    *,
    device: torch.device | str = "cpu",
    pictures: Path | None = None,
    total: int | None = None,
) -> list[dict[str, Any]]:
    """Scores of `predict` on each pair, with a progress bar.

    Args:
        predict: (left, right), RGB float32 [1, 3, H, W], 0..255, on `device` -> disparity [1, 1, H, W], pixels, positive; such as
            `matcher.predict`.
        pairs: read one by one.
        pictures: a folder for NAME_disparity.png and NAME_error.png.
        total: how many pairs, for the progress bar, where `pairs` does not know.
    Returns:
        For each pair {"name", "seconds", "all": scores, "noc": scores or None}, where scores are "pixels" (how many counted), "epe"
        in pixels and "bad_1", "bad_2", "bad_3", "d1" as shares in 0..1, None without a pixel to count. `mean_scores` sums them up.
    Raises:
        ValueError: a prediction of another size or not finite; names the pair.
    """
    results = []
    for pair in tqdm(pairs, total=total, desc="evaluate", unit="pair"):
        left, right = (torch.from_numpy(image).to(device).permute(2, 0, 1)[None].float() for image in (pair.left, pair.right))
        begin = time.perf_counter()
        prediction = predict(left, right).cpu()  # the copy waits for the device
        seconds = time.perf_counter() - begin
        if prediction.shape != (1, 1, *pair.disparity.shape):
            raise ValueError(f"{pair.name}: predicted {list(prediction.shape)} for images of {list(pair.disparity.shape)}")
        prediction = prediction[0, 0].float()
        visible = {"all": pair.valid, "noc": None if pair.nonoccluded is None else pair.valid & pair.nonoccluded}
        try:
            scores = {region: None if mask is None else _scores(prediction, pair.disparity, mask) for region, mask in visible.items()}
        except ValueError as error:
            raise ValueError(f"{pair.name}: {error}") from error
        results.append({"name": pair.name, "seconds": round(seconds, 4), **scores})
        if pictures is not None:
            _paint(pictures, pair, prediction.numpy())
    return results


def mean_scores(results: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """The mean over the pairs, each counting alike, for "all" and "noc"; "pairs" says how many had a pixel to count."""
    means = {}
    for region in REGIONS:
        scored = [result[region] for result in results if result[region] is not None and result[region]["pixels"]]
        means[region] = {"pairs": len(scored)} | {
            name: math.fsum(scores[name] for scores in scored) / len(scored) if scored else None for name in METRICS
        }
    return means


def table(results: list[dict[str, Any]]) -> str:
    """The results and their means as text; shares in percent."""
    rows = [(result["name"], region, result[region]) for result in results for region in REGIONS if result[region] is not None]
    rows += [(f"mean of {mean['pairs']}", region, mean) for region, mean in mean_scores(results).items() if mean["pairs"]]
    width = max(len(name) for name, _, _ in [("pair", "", {}), *rows])
    lines = [f"{'pair':{width}}  region  EPE px  bad-1 %  bad-2 %  bad-3 %    D1 %"]
    for name, region, scores in rows:
        numbers = [f"{'-' if scores[key] is None else format(scores[key] * (1 if key == 'epe' else 100), '.2f'):>7}" for key in METRICS]
        lines.append(f"{name:{width}}  {region:6}{numbers[0]}  " + "  ".join(numbers[1:]))
    return "\n".join(lines)


def _scores(prediction: Tensor, disparity: np.ndarray, mask: np.ndarray) -> dict[str, Any]:
    maps = prediction, torch.from_numpy(disparity), torch.from_numpy(mask)
    values = {name: metric(*maps) for name, metric in METRICS.items()}
    return {"pixels": int(mask.sum())} | {name: None if math.isnan(value) else value for name, value in values.items()}


def _paint(folder: Path, pair: StereoPair, prediction: np.ndarray) -> None:
    """Writes the prediction (blue far, red near, on the scale of the ground truth) and its error (black where unknown)."""
    folder.mkdir(parents=True, exist_ok=True)
    nearest = pair.disparity.max() if pair.valid.any() else max(prediction.max(), 1.0)
    error = np.abs(prediction - pair.disparity)
    for kind, shares in (("disparity", prediction / nearest), ("error", error / WORST_ERROR_PX)):
        picture = cv2.applyColorMap(np.rint(np.clip(shares, 0, 1) * 255).astype(np.uint8), cv2.COLORMAP_TURBO)
        if kind == "error":
            picture[~pair.valid] = 0
        _, content = cv2.imencode(".png", picture)
        (folder / f"{pair.name}_{kind}.png").write_bytes(content.tobytes())


def _pairs(dataset: str, root: Path | None) -> tuple[Iterator[StereoPair], int]:
    """The pairs of a data set, read when their turn comes, and how many there are."""
    if dataset == "motorcycle":
        return iter([motorcycle()]), 1
    if root is None:
        raise ValueError(f"--dataset {dataset} needs --root DIR")
    if dataset == "folder":
        folders = find_pairs(root)
        return (read_pair(folder) for folder in folders), len(folders)
    files = BENCHMARKS[dataset](root)
    return (pair.read() for pair in files), len(files)


def _predictor(arguments: argparse.Namespace, options: dict[str, Any]) -> Predict:
    if arguments.model == "sgbm":
        if arguments.checkpoint is not None or options:
            raise ValueError("--model sgbm has no weights: leave out --checkpoint and the matcher's options")
        return sgbm
    if arguments.checkpoint is None:
        raise ValueError(f"--model {arguments.model} needs --checkpoint FILE or DIR")
    matcher = load_trained(arguments.checkpoint, MODELS[arguments.model], **options).to(arguments.device)
    return lambda left, right: matcher.predict(left, right, iterations=arguments.iterations)


def _matcher_options() -> dict[str, dict[str, Any]]:
    """Every option of every matcher: {option: {model: default}}."""
    options: dict[str, dict[str, Any]] = {}
    for model, name in MODELS.items():
        for parameter in inspect.signature(MATCHERS[name]).parameters.values():
            options.setdefault(parameter.name, {})[model] = parameter.default
    return options


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", required=True, choices=[*MODELS, "sgbm"], help="sgbm: OpenCV's classical matcher, for comparison")
    parser.add_argument(
        "--checkpoint", type=Path, metavar="PATH", help="published .pth or .safetensors file, or a trainer's folder with config.json"
    )
    parser.add_argument("--dataset", required=True, choices=["folder", "motorcycle", *BENCHMARKS], help="see above")
    parser.add_argument("--root", type=Path, metavar="DIR", help="where the data set lies")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write all scores to this file")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="write NAME_disparity.png and NAME_error.png into this folder")
    parser.add_argument("--iterations", type=int, default=32, help="updates of the matcher (default: 32)")
    parser.add_argument(
        "--device", default="cuda" if torch.cuda.is_available() else "cpu", help='"cpu", "cuda", "cuda:1" (default: cuda if there is one)'
    )
    group = parser.add_argument_group("the matcher's options, as it was trained (default: as published, or as config.json says)")
    for name, defaults in _matcher_options().items():
        flag, default = f"--{name.replace('_', '-')}", next(iter(defaults.values()))
        shown = ", ".join(f"{model}: {published}" for model, published in defaults.items())
        if isinstance(default, bool):
            group.add_argument(flag, dest=name, action=argparse.BooleanOptionalAction, help=shown)
        elif isinstance(default, tuple):
            group.add_argument(flag, dest=name, type=int, nargs=len(default), metavar="N", help=shown)
        else:
            group.add_argument(flag, dest=name, type=type(default), metavar="N" if isinstance(default, int) else "NAME", help=shown)
    return parser


def main() -> None:
    arguments = _parser().parse_args()
    given = {name: getattr(arguments, name) for name in _matcher_options()}
    options = {name: value for name, value in given.items() if value is not None}
    predict = _predictor(arguments, options)
    pairs, total = _pairs(arguments.dataset, arguments.root)
    results = evaluate(predict, pairs, device=arguments.device, pictures=arguments.pictures, total=total)
    print(table(results))
    if arguments.json is not None:
        report = {
            "model": arguments.model,
            "checkpoint": None if arguments.checkpoint is None else str(arguments.checkpoint),
            "options": options,
            "iterations": None if arguments.model == "sgbm" else arguments.iterations,
            "dataset": arguments.dataset,
            "units": {"epe": "px", "bad_1, bad_2, bad_3, d1": "share in 0..1"},
            "mean": mean_scores(results),
            "pairs": results,
        }
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n")


if __name__ == "__main__":
    try:
        main()
    except (ImportError, OSError, TypeError, ValueError) as error:
        sys.exit(f"evaluate.py: {error}")
