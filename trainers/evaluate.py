"""The zero-shot benchmark: judges a matcher on stereo pairs with ground truth.

    python trainers/evaluate.py --model raft --checkpoint raftstereo-sceneflow.pth --dataset middlebury --variant F --root MiddEval3
    python trainers/evaluate.py --model igev --checkpoint runs/first/checkpoints/step-00200000 --dataset kitti2015 --root kitti/2015
    python trainers/evaluate.py --model sgbm --dataset folder --root pairs --pictures pictures --json scores.json --csv scores.csv
    python trainers/evaluate.py --model my_package.my_module:predict --dataset motorcycle

Scores of each pair, and their means over the pairs (each counts alike, as in the paper's tables) and over all pixels (as RAFT-Stereo
averages the outliers of KITTI and Scene Flow): EPE, the mean absolute error in pixels; bad-N, the share of pixels that are off by more than
N px; D1, the share that is off by more than 3 px and by more than 5 %.

They are counted in regions. all: every pixel with ground truth. noc: those that both cameras see, where the pair comes with a mask of
them. all_edges, noc_edges: those near a depth edge, that is at most 5 px (in rows and in columns) from a discontinuity: two known
pixels of one row or column, at most 4 px apart with none known between them, whose true disparities differ by more than 2 px.
all_below_N, noc_below_N: those with a true disparity below N (--below). A pair without such a pixel is left out of the mean.

A model that is not ours: --model package.module:callable. It is called as callable(left, right), with unpadded RGB images, float32 [1, 3,
H, W] in 0..255 on --device (or uint8 [H, W, 3] with --takes numpy), and returns the left view's disparity [H, W], positive pixels.
"""

from __future__ import annotations

import argparse
import inspect
import json
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from trainers.benchmarks_on_disk import BENCHMARKS, find_benchmark
from trainers.models import MATCHERS
from trainers.pairs_on_disk import StereoPair, find_pairs, motorcycle, pair_files
from trainers.predictors import MODELS, PRECISIONS, TAKES, find_predictor
from trainers.scores import all_means, mean_scores, score, table, write_csv
from trainers.strips import LEAST_ROWS, Predict
from zsdata.progress import Progress

__all__ = ["evaluate", "mean_scores", "table"]

WORST_ERROR_PX = 10.0  # brightest in the error pictures
OUT_OF_MEMORY = "--tile-rows 512 matches it in strips; --corr-implementation alt (RAFT-Stereo) and --mixed-precision bf16 take less"


def evaluate(
    predict: Predict,
    pairs: Iterable[StereoPair],
    *,
    device: torch.device | str = "cpu",
    pictures: Path | None = None,
    total: int | None = None,
    below_px: Sequence[float] = (),
    progress: bool = True,
    out_of_memory: str = OUT_OF_MEMORY,
) -> list[dict[str, Any]]:
    """Scores of `predict` on each pair.

    Args:
        predict: (left, right), RGB float32 [1, 3, H, W], 0..255, on `device` -> disparity [1, 1, H, W], pixels, positive; such as
            `matcher.predict`.
        pairs: read one by one.
        pictures: a folder for NAME_disparity.png and NAME_error.png.
        total: how many pairs, for the progress bar, where `pairs` does not know.
        below_px: see `trainers.scores.score`.
        progress: shows a bar.
        out_of_memory: what helps, for the error.
    Returns:
        For each pair {"name", "group", "seconds"} and the scores by region of `trainers.scores.score`. `mean_scores` sums them up.
    Raises:
        ValueError: a prediction of another size or not finite; names the pair.
        MemoryError: a pair does not fit; names it and what helps.
    """
    results = []
    for pair in Progress(pairs, total=total, desc="evaluate", unit="pair", disable=not progress):
        left, right = (torch.from_numpy(image).to(device).permute(2, 0, 1)[None].float() for image in (pair.left, pair.right))
        begin = time.perf_counter()
        prediction = _predict_or_say_what_helps(predict, left, right, pair.name, out_of_memory)
        seconds = time.perf_counter() - begin
        if prediction.shape != (1, 1, *pair.disparity.shape):
            raise ValueError(f"{pair.name}: predicted {list(prediction.shape)} for images of {list(pair.disparity.shape)}")
        prediction = prediction[0, 0].float()
        try:
            scores = score(prediction, pair, below_px)
        except ValueError as error:
            raise ValueError(f"{pair.name}: {error}") from error
        results.append({"name": pair.name, "group": pair.group, "seconds": round(seconds, 4), **scores})
        if pictures is not None:
            _paint(pictures, pair, prediction.numpy())
    return results


def _predict_or_say_what_helps(predict: Predict, left: Tensor, right: Tensor, name: str, out_of_memory: str) -> Tensor:
    try:
        return predict(left, right).cpu()  # the copy waits for the device
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, (MemoryError, torch.OutOfMemoryError)) and "allocate memory" not in str(error):
            raise
        size = f"{left.shape[-1]} x {left.shape[-2]} px"
        raise MemoryError(f"{name}, {size}, does not fit into the memory of {left.device}: {out_of_memory}") from error


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


def open_dataset(
    dataset: str, root: Path | None = None, variant: str | None = None, *, rank: int = 0, world_size: int = 1
) -> tuple[Iterator[StereoPair], int]:
    """One rank's pairs of a data set, read when their turn comes, and how many there are for all ranks.

    Args:
        dataset: "motorcycle", "folder" or a key of BENCHMARKS.
        root: where it lies; not for the motorcycle.
        variant: see `trainers.benchmarks_on_disk.find_benchmark`.
        rank, world_size: pairs rank, rank + world_size, ... are read, and no others.
    Raises:
        FileNotFoundError, ValueError: it is not there, at once and not when its turn comes; says what was expected where.
    """
    if variant is not None and dataset not in BENCHMARKS:
        raise ValueError(f"--dataset {dataset} has no variants; leave out --variant")
    if dataset == "motorcycle":
        return iter([motorcycle()][rank::world_size]), 1
    if root is None:
        raise ValueError(f"--dataset {dataset} needs --root DIR")
    files = [pair_files(folder) for folder in find_pairs(root)] if dataset == "folder" else find_benchmark(dataset, root, variant)
    return (pair.read() for pair in files[rank::world_size]), len(files)


def _report(arguments: argparse.Namespace, options: dict[str, Any], results: list[dict[str, Any]]) -> dict[str, Any]:
    network = arguments.model in MODELS
    benchmark = BENCHMARKS.get(arguments.dataset)
    return {
        "model": arguments.model,
        "checkpoint": None if arguments.checkpoint is None else str(arguments.checkpoint),
        "options": options,
        "iterations": arguments.iterations if network else None,
        "mixed_precision": arguments.mixed_precision,
        "tile_rows": arguments.tile_rows,
        "dataset": arguments.dataset,
        "variant": arguments.variant or (benchmark.variants[0] if benchmark and benchmark.variants else None),
        "complete": benchmark is None or len(results) >= benchmark.pairs,
        "units": {"epe": "px", "bad_N, d1": "share in 0..1"},
        "mean": mean_scores(results),
        "means": all_means(results),
        "pairs": results,
    }


def _matcher_options() -> dict[str, dict[str, Any]]:
    """Every option of every matcher: {option: {model: default}}."""
    options: dict[str, dict[str, Any]] = {}
    for model, name in MODELS.items():
        for parameter in inspect.signature(MATCHERS[name]).parameters.values():
            options.setdefault(parameter.name, {})[model] = parameter.default
    return options


def _data_sets() -> str:
    """What --root is to hold, for the help."""
    lines = ["data sets (with their variants, the first one unless --variant says otherwise), and what --root is to hold:"]
    for name, benchmark in BENCHMARKS.items():
        variants = f" ({', '.join(benchmark.variants)})" if benchmark.variants else ""
        lines.append(f"  {name}{variants}: {benchmark.layout}")
    lines += [
        "  folder: a pair, or one folder per pair, with left.*, right.* (png, jpg, tif) and disp.* (pfm, png, tif, npy, npz); optional",
        '      mask_left.png (255: visible in both views), and pair.json {"divisor": N} for what stored disparities are divided by;',
        "      0, negative, infinite and NaN are no value",
        "  motorcycle: comes with scikit-image, no --root",
    ]
    return "\n".join(lines)


def _above_zero(text: str) -> float:
    value = float(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"a disparity above 0 px was expected, got {text}")
    return value


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"1 or more was expected, got {text}")
    return value


def _device(text: str) -> torch.device:
    """A device that is there."""
    try:
        device = torch.device(text)
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise argparse.ArgumentTypeError(f"{text} cannot be used here: {str(error).splitlines()[0]}") from error
    return device


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, epilog=_data_sets(), formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--model",
        required=True,
        metavar="MODEL",
        help=f"{', '.join(MODELS)}, sgbm (OpenCV's classical matcher), or package.module:callable",
    )
    parser.add_argument(
        "--checkpoint", type=Path, metavar="PATH", help="published .pth or .safetensors file, or a trainer's folder with config.json"
    )
    parser.add_argument("--dataset", required=True, choices=["folder", "motorcycle", *BENCHMARKS], help="see below")
    parser.add_argument("--root", type=Path, metavar="DIR", help="where the data set lies")
    parser.add_argument("--variant", metavar="NAME", help="a resolution (F, H, Q) or render pass (finalpass, cleanpass), see below")
    parser.add_argument(
        "--below",
        type=_above_zero,
        nargs="+",
        metavar="PX",
        help="also the scores of the points whose true disparity is smaller, such as 192 (default: 192 on sceneflow, as published)",
    )
    parser.add_argument("--json", type=Path, metavar="OUT", help="write all scores to this file")
    parser.add_argument("--csv", type=Path, metavar="OUT", help="write all scores to this file, a line for each pair and region")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="write NAME_disparity.png and NAME_error.png into this folder")
    parser.add_argument("--iterations", type=_count, default=32, metavar="N", help="updates of the matcher (default: 32)")
    parser.add_argument(
        "--device",
        type=_device,
        default="cuda" if torch.cuda.is_available() else "cpu",
        metavar="NAME",
        help='"cpu", "cuda", "cuda:1" (default: cuda if there is one)',
    )
    parser.add_argument("--mixed-precision", choices=list(PRECISIONS), default="no", help="runs the network under autocast (default: no)")
    parser.add_argument(
        "--tile-rows", type=int, metavar="N", help=f"match in overlapping strips of N rows, at least {LEAST_ROWS}, where memory is short"
    )
    parser.add_argument("--takes", choices=TAKES, default="torch", help="what a callable of yours takes (default: torch)")
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
    predict = find_predictor(
        arguments.model,
        checkpoint=arguments.checkpoint,
        options=options,
        iterations=arguments.iterations,
        device=arguments.device,
        mixed_precision=arguments.mixed_precision,
        takes=arguments.takes,
        tile_rows=arguments.tile_rows,
    )
    pairs, total = open_dataset(arguments.dataset, arguments.root, arguments.variant)
    benchmark = BENCHMARKS.get(arguments.dataset)
    if benchmark is not None and total < benchmark.pairs:
        print(f"only {total} of the {benchmark.pairs} pairs of {arguments.dataset} are there: not the benchmark's score", file=sys.stderr)
    below = arguments.below or (benchmark.below_px if benchmark else ())
    for path in (arguments.json, arguments.csv):
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
    results = evaluate(predict, pairs, device=arguments.device, pictures=arguments.pictures, total=total, below_px=below)
    print(table(results))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(_report(arguments, options, results), indent=2, allow_nan=False) + "\n")
    if arguments.csv is not None:
        write_csv(arguments.csv, results)


if __name__ == "__main__":
    try:
        main()
    except (ImportError, MemoryError, OSError, TypeError, ValueError) as error:
        sys.exit(f"evaluate.py: {error}")
