"""Does a worker make a fresh pair in less time than it takes to read a finished one? Where does the time go, and how many pairs come out?

python benchmarks/pairs.py                            the photos that scikit-image ships; about 5 minutes
python benchmarks/pairs.py --quick                    under one minute, rougher
python benchmarks/pairs.py --photos DIR --json FILE   the largest photos of a folder; the figures as JSON too
python benchmarks/pairs.py --device cuda              batches finished on the GPU, and the geometry there held against the CPU

Real photos, cut to 4:3, resized to each size and stored as JPEG; the finished pairs are those photos whole, in the published layout, as
`zsdata export` writes them. "Reading" takes their six files from the system's memory; see published_set.py for the augmentation. A pair is
a crop of 384x512, its depth comes from the cache, and everything runs on one thread but for the tables with workers.

What is compared is measured in turn, over all photos each, round after round, and by the time that the thread itself was on a processor,
so that a busy machine disturbs both alike, and little. Milliseconds are medians over rounds of the mean over the photos, ratios are medians
over rounds of the ratio in one round. "Decodes": how often OpenCV decodes the same photo's JPEG meanwhile. Pairs per second go by the clock
on the wall: on a busy machine they are fewer.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import PIL
import torch
from published_set import CROP, decode, decode_and_augment
from torch import Tensor

import zsdata.meter
from zsdata import AugmentConfig, ZeroStereoStream, decode_photo, dilate_disparity, forward_warp, load_depth, normalize_inverse_depth
from zsdata.bench import WORKER_STAGES, feed, fill_depth_cache, leave_holes, split_stages
from zsdata.example_photos import example_photos
from zsdata.export import export_pairs
from zsdata.exported import read_exported
from zsdata.progress import Progress
from zsdata.source.pack import pack
from zsdata.source.photo import BadPhoto, probe_size
from zsdata.synthesis.depth.builtin import BuiltinDepthWarning
from zsdata.synthesis.depth.maps import NEAREST
from zsdata.synthesis.disparity import SMALLEST_DISPARITY_PX, sharpen_disparity
from zsdata.synthesis.view import View, view_map
from zsdata.worker import single_thread

SIZES = ((480, 640), (768, 1024), (1536, 2048))
CROPS = ((256, 320), CROP, (512, 768))
JPEG_QUALITY = 92
BATCH_SIZE = 8
MOST_SECONDS = 40  # for the rounds of one table; what a busy machine does not finish is left out
SCALE = 0.1  # largest disparity as a share of the width, the paper's centre
TARGETS = {SIZES[0]: (1.0, 0.2), SIZES[1]: (0.6, 0.1), SIZES[2]: (0.3, 0.03)}  # over reading: decode only, with augmentation
WARP_DECODES, WARP_GROWTH, CUDA_MS = 7.0, 4.6, 2.0  # targets of the geometry
PUBLISHED_DECODES = {
    SIZES[0]: (15 / 1.4, 80 / 1.4),
    SIZES[1]: (33 / 3.6, 179 / 3.6),
    SIZES[2]: (111 / 13, 830 / 13),
}  # the code as published

Times = dict[str, np.ndarray]  # milliseconds by what was measured: [rounds], means over the photos


class PhotoSet:
    """The photos at one size: JPEGs, a shard of them, streams with their depth cached, and the finished pairs."""

    def __init__(self, folder: Path, size: tuple[int, int], pictures: Sequence[np.ndarray]) -> None:
        self.size = size
        self.name = f"{size[0]}x{size[1]}"
        folder = folder / self.name
        (folder / "photos").mkdir(parents=True)
        self.jpegs = [to_jpeg(picture, size) for picture in pictures]
        for number, data in enumerate(self.jpegs):
            (folder / "photos" / f"{number:03d}.jpg").write_bytes(data)
        pack(folder / "photos", folder / "shards")
        self._shards, self._cache = str(folder / "shards"), folder / "depth"
        fill_depth_cache(self.stream(finished=False), 0, len(pictures))
        export_pairs(self.stream(crop=None, finished=False, inpaint="builtin"), folder / "pairs")
        self.exported = read_exported(folder / "pairs")
        self.bytes_per_pair = np.mean([sum(os.path.getsize(path) for path in pair) for pair in self.exported])

    def stream(
        self, crop: tuple[int, int] | None = CROP, *, cached: bool = True, finished: bool = True, **options: Any
    ) -> ZeroStereoStream:
        """Of these photos; unless `finished`, its holes stay and nothing is augmented, so that all the work is the workers'."""
        unfinished = {} if finished else {"inpaint": leave_holes, "augmentation": AugmentConfig.none()}
        return ZeroStereoStream(self._shards, size=crop, depth_cache=self._cache if cached else None, **{**unfinished, **options})


def to_jpeg(picture: np.ndarray, size: tuple[int, int]) -> bytes:
    """The middle of a BGR picture in the proportions of `size`, resized to it."""
    height, width = size
    scale = max(height / picture.shape[0], width / picture.shape[1])
    part_height, part_width = min(picture.shape[0], round(height / scale)), min(picture.shape[1], round(width / scale))
    top, left = (picture.shape[0] - part_height) // 2, (picture.shape[1] - part_width) // 2
    part = picture[top : top + part_height, left : left + part_width]
    part = cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    return cv2.imencode(".jpg", part, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


def in_turn(work: Mapping[str, Callable[[int, int], object]], photos: int, rounds: int, title: str) -> Times:
    """Takes the time of each kind of work on all photos, one kind after the other, round after round; `work` takes round and photo.

    One kind goes over all photos in a row, as a worker does, so that the processor's caches are its own. What it returns as a dictionary
    counts as the seconds of its parts, "NAME: PART".
    """
    times: dict[str, np.ndarray] = {}
    with Progress(total=rounds * len(work), desc=title, disable=None, leave=False) as bar, stages_by_thread_time():
        for number in rounds_in_time(rounds):
            for name, do in work.items():
                for photo in range(photos):
                    start = time.thread_time()
                    parts = do(number, photo)
                    seconds = {name: time.thread_time() - start}
                    if isinstance(parts, dict):
                        seconds |= {f"{name}: {part}": value for part, value in parts.items()}
                    for key, value in seconds.items():
                        times.setdefault(key, np.zeros(rounds))[number] += 1e3 * value / photos
                bar.update()
    return {name: ms[: number + 1] for name, ms in times.items()}


def rounds_in_time(most: int) -> Iterator[int]:
    """0, 1, ...: `most` rounds, fewer where they take longer than MOST_SECONDS together, one at least."""
    start = time.perf_counter()
    for number in range(most):
        yield number
        if time.perf_counter() - start > MOST_SECONDS:
            return


def stages_by_thread_time() -> AbstractContextManager[object]:
    """Lets all meters go by the time that the thread was on a processor."""
    return patch.object(zsdata.meter, "time", SimpleNamespace(perf_counter=time.thread_time))


def ratio(times: Times, name: str, reference: str) -> float:
    return float(np.median(times[name] / times[reference]))


def spread(times: Times, name: str, reference: str) -> list[float]:
    """The least and the largest ratio of a round."""
    ratios = times[name] / times[reference]
    return [float(ratios.min()), float(ratios.max())]


def against_reading(photos: PhotoSet, rounds: int) -> Times:
    """A worker's time for a pair, that of reading one, and that of decoding the photo."""
    worker = photos.stream()._worker
    randoms = [np.random.RandomState(seed) for seed in range(len(photos.jpegs))]
    jpegs = [np.frombuffer(data, np.uint8) for data in photos.jpegs]
    work = {
        "decode": lambda _, photo: not_a_dictionary(cv2.imdecode(jpegs[photo], cv2.IMREAD_COLOR)),
        "worker": lambda number, photo: worker.prepare(number, photo).seconds,
        "read": lambda _, photo: not_a_dictionary(decode(photos.exported[photo])),
        "read and augment": lambda _, photo: not_a_dictionary(decode_and_augment(photos.exported[photo], randoms[photo])),
    }
    for do in work.values():  # the first call of anything is slower
        do(0, 0)
    return in_turn(work, len(jpegs), rounds, f"{photos.name}: pairs against reading")


def not_a_dictionary(result: object) -> None:
    """What came out is not wanted: only how long it took."""
    del result


def builtin_depth(photos: PhotoSet, rounds: int) -> Times:
    worker = photos.stream(cached=False)._worker
    work = {
        "decode": lambda _, photo: not_a_dictionary(decode_photo(photos.jpegs[photo])),
        "worker": lambda number, photo: worker.prepare(number, photo).seconds,
    }
    return in_turn(work, min(2, len(photos.jpegs)), rounds, f"{photos.name}: built-in depth")


def print_stages(sets: Sequence[PhotoSet], cached: Mapping[str, Times], estimated: Mapping[str, Times]) -> dict[str, Any]:
    """A pair by stage, in milliseconds and decodes."""
    print(f"\na pair of {CROP[0]}x{CROP[1]} on one thread, ms (decodes)")
    print(f"{'stage':28}" + "".join(f"{photos.name:>22}" for photos in sets))
    figures: dict[str, Any] = {}

    def row(title: str, of: Callable[[PhotoSet], tuple[np.ndarray, np.ndarray]]) -> None:
        cells = []
        for photos in sets:
            ms, decode_ms = of(photos)
            cells.append(f"{np.median(ms):12.2f} ({np.median(ms / decode_ms):7.2f})")
            figures.setdefault(photos.name, {})[title] = {"ms": float(np.median(ms)), "decodes": float(np.median(ms / decode_ms))}
        print(f"{title:28}" + "".join(cells))

    def of_worker(part: str) -> Callable[[PhotoSet], tuple[np.ndarray, np.ndarray]]:
        return lambda photos: (cached[photos.name][f"worker: {part}"], cached[photos.name]["decode"])

    def rest(photos: PhotoSet) -> tuple[np.ndarray, np.ndarray]:
        times = cached[photos.name]
        return times["worker"] - sum(times[f"worker: {stage}"] for stage in stages), times["decode"]

    stages = [stage for stage in WORKER_STAGES if f"worker: {stage}" in cached[sets[0].name]]
    row("OpenCV decode (reference)", lambda photos: (cached[photos.name]["decode"], cached[photos.name]["decode"]))
    for stage in stages:
        row("depth, cached" if stage == "depth" else stage, of_worker(stage))
    row("other", rest)
    row("total", lambda photos: (cached[photos.name]["worker"], cached[photos.name]["decode"]))
    row("depth, built-in", lambda photos: (estimated[photos.name]["worker: depth"], estimated[photos.name]["decode"]))
    return figures


def print_reading(sets: Sequence[PhotoSet], cached: Mapping[str, Times]) -> dict[str, Any]:
    print("\na worker's pair against reading a finished one, on one thread")
    print(
        f"{'photo':>10}{'MB a pair':>10} | {'worker ms':>9}{'read ms':>9}{'+ augment':>10} | {'over read, least..most':>26}{'target':>7}"
        f"{'over + augment':>25}{'target':>7} | reading, in decodes (the published code)"
    )
    figures = {}
    for photos in sets:
        times, targets = cached[photos.name], TARGETS[photos.size]
        ratios = [ratio(times, "worker", reference) for reference in ("read", "read and augment")]
        decodes = [ratio(times, name, "decode") for name in ("read", "read and augment")]
        ms = {name: float(np.median(times[name])) for name in ("worker", "read", "read and augment")}
        spreads = [spread(times, "worker", reference) for reference in ("read", "read and augment")]
        marks = ["" if value <= target else " !" for value, target in zip(ratios, targets, strict=True)]
        print(
            f"{photos.name:>10}{photos.bytes_per_pair / 1e6:10.1f} | {ms['worker']:9.1f}{ms['read']:9.1f}{ms['read and augment']:10.1f} | "
            f"{ratios[0]:10.2f}  ({spreads[0][0]:4.2f}..{spreads[0][1]:4.2f}){targets[0]:9}{marks[0]:2}"
            f"{ratios[1]:9.3f}  ({spreads[1][0]:5.3f}..{spreads[1][1]:5.3f}){targets[1]:7}{marks[1]:2}| "
            + ", ".join(f"{here:.0f} ({there:.0f})" for here, there in zip(decodes, PUBLISHED_DECODES[photos.size], strict=True))
        )
        figures[photos.name] = {
            "ms": ms,
            "over": ratios,
            "least_and_most": spreads,
            "targets": targets,
            "decodes": decodes,
            "bytes_per_pair": photos.bytes_per_pair,
        }
    return figures


def print_rates(sets: Sequence[PhotoSet], workers: Sequence[int], pairs: int, rounds: int) -> list[dict[str, Any]]:
    """What workers deliver: by photo size and crop, in turn; the training process only takes the batches."""
    middle = sets[len(sets) // 2]
    kinds = [(photos, CROP) for photos in sets] + [(middle, crop) for crop in CROPS if crop != CROP]
    streams = [photos.stream(crop, finished=False, epoch_size=10**6) for photos, crop in kinds]
    rates: dict[tuple[int, int], list[tuple[float, float]]] = {}  # (kind, workers) -> pairs per second, over reading, by round
    with Progress(total=rounds * len(kinds), desc="pairs per second", disable=None, leave=False) as bar:
        for _ in rounds_in_time(rounds):
            for kind, (photos, _) in enumerate(kinds):
                start = time.perf_counter()
                for pair in photos.exported:
                    decode(pair)
                reading = len(photos.exported) / (time.perf_counter() - start)
                for count in workers:
                    batches = max(2 * count, pairs // BATCH_SIZE)
                    rate = feed(streams[kind], count, batch_size=BATCH_SIZE, batches=batches).pairs_per_second
                    rates.setdefault((kind, count), []).append((rate, rate / reading))
                bar.update()
    print(f"\nwhat workers deliver, batches of {BATCH_SIZE} (over one process that reads finished pairs of such photos and does no more)")
    print(f"{'photo':>10}{'crop':>10}" + "".join(f"{f'workers: {count}':>24}" for count in workers))
    figures = []
    for kind, (photos, crop) in enumerate(kinds):
        cells = []
        for count in workers:
            rate, over = np.median(rates[kind, count], axis=0).tolist()
            cells.append(f"{rate:10.1f} pairs/s ({over:4.2f})")
            figures.append({"photo": photos.size, "crop": crop, "workers": count, "pairs_per_second": rate, "over_reading": over})
        print(f"{photos.name:>10}{f'{crop[0]}x{crop[1]}':>10}" + "".join(cells))
    return figures


def print_end_to_end(photos: PhotoSet, workers: Sequence[int], device: torch.device, pairs: int, rounds: int) -> list[dict[str, Any]]:
    """Finished batches, as training takes them: shares of the stages, pairs per second, and how many batches lie ready."""
    stream, counts = photos.stream(epoch_size=10**6), [0, *workers]
    runs = {count: [] for count in counts}
    with Progress(total=rounds * len(counts), desc=f"finished batches on {device}", unit="run", disable=None, leave=False) as bar:
        for _ in rounds_in_time(rounds):
            for count in counts:
                batches = max(2 * count, pairs // BATCH_SIZE)
                runs[count].append(feed(stream, count, batch_size=BATCH_SIZE, batches=batches, device=device))
                bar.update()
    alone = sorted(runs[0], key=lambda run: run.seconds)[len(runs[0]) // 2]
    worker_ms, finish_ms = split_stages(alone, device)
    total = sum(worker_ms.values()) + sum(finish_ms.values())
    print(f"\nfinished batches of {BATCH_SIZE} on {device}, photos of {photos.name}, crop {CROP[0]}x{CROP[1]}, depth cached")
    for process, stages in (("worker", worker_ms), ("training process", finish_ms)):
        print(f"{process:>17}, share of a pair: " + ", ".join(f"{name} {ms / total:.0%}" for name, ms in stages.items()))
    print(f"{'workers':>10}{'pairs/s':>10}{'over none':>11}{'training waits':>16}{'batches ready':>15}")
    figures = []
    for count in counts:
        rate, waiting, ready, over = (
            float(np.median(values))
            for values in (
                [run.pairs_per_second for run in runs[count]],
                [run.waiting for run in runs[count]],
                [run.ready_batches for run in runs[count]],
                [run.pairs_per_second / none.pairs_per_second for run, none in zip(runs[count], runs[0], strict=True)],
            )
        )
        print(f"{count:10}{rate:10.1f}{over:11.2f}" + (f"{waiting:16.0%}{ready:15.1f}" if count else f"{'-':>16}{'-':>15}"))
        figures.append({"workers": count, "pairs_per_second": rate, "over_no_workers": over, "waiting": waiting, "ready_batches": ready})
    return [{"worker_ms": worker_ms, "finish_ms": finish_ms}, *figures]


@torch.inference_mode()
def whole_photos(photos: PhotoSet, count: int) -> list[tuple[Tensor, Tensor]]:
    """Image uint8 [1, 3, H, W] and raw inverse depth, uint16 [1, 1, H, W] as the cache keeps it, of the first photos."""
    depth = load_depth("builtin")
    images = [decode_photo(data)[None] for data in photos.jpegs[:count]]
    return [(image, (normalize_inverse_depth(depth(image.float())) * NEAREST).round().int().to(torch.uint16)) for image in images]


def to_disparity(inverse_depth: Tensor, view: View) -> Tensor:
    """The stage "disparity": the view's part at the view's size, in pixels, dilated; [B, 1, height, width]."""
    return dilate_disparity(view_map(inverse_depth, view) * (SCALE * view.scale_x * inverse_depth.shape[-1] / NEAREST))


def to_sharp(disparity: Tensor) -> Tensor:
    return sharpen_disparity(disparity).clamp(min=SMALLEST_DISPARITY_PX)


@torch.inference_mode()
def print_geometry(sets: Sequence[PhotoSet], rounds: int) -> dict[str, Any]:
    """`forward_warp` and the disparity before it, on whole photos of the two larger sizes, in turn."""
    small, large = sets[-2:]
    count = min(3, len(small.jpegs))
    work: dict[str, Callable[[int, int], object]] = {}
    for photos in (small, large):
        jpegs = [np.frombuffer(data, np.uint8) for data in photos.jpegs]
        made = whole_photos(photos, count)
        view = View(False, (0, 0, *photos.size), *photos.size, 0)
        sharp = [to_sharp(to_disparity(inverse_depth, view)) for _, inverse_depth in made]
        work |= {
            f"decode {photos.name}": partial(lambda jpegs, _, i: not_a_dictionary(cv2.imdecode(jpegs[i], cv2.IMREAD_COLOR)), jpegs),
            f"warp {photos.name}": partial(lambda made, sharp, _, i: not_a_dictionary(forward_warp(made[i][0], sharp[i])), made, sharp),
            f"disparity and sharpen {photos.name}": partial(
                lambda made, view, _, i: not_a_dictionary(to_sharp(to_disparity(made[i][1], view))), made, view
            ),
        }
    for do in work.values():
        do(0, 0)
    times = in_turn(work, count, rounds, "geometry of whole photos")
    print("\ngeometry of whole photos on one thread, ms (decodes)")
    print(f"{'':24}{small.name:>22}{large.name:>22}{'growth':>9}   target")
    figures = {}
    targets = {"warp": f"<= {WARP_DECODES:.0f} decodes at {small.name}, growth <= {WARP_GROWTH}", "disparity and sharpen": ""}
    for name in ("warp", "disparity and sharpen"):
        cells = [
            (float(np.median(times[f"{name} {p.name}"])), ratio(times, f"{name} {p.name}", f"decode {p.name}")) for p in (small, large)
        ]
        growth = ratio(times, f"{name} {large.name}", f"{name} {small.name}")
        missed = name == "warp" and (cells[0][1] > WARP_DECODES or growth > WARP_GROWTH)
        print(f"{name:24}" + "".join(f"{ms:12.1f} ({n:7.2f})" for ms, n in cells) + f"{growth:9.2f}   {targets[name]}" + " !" * missed)
        figures[name] = {"ms": [ms for ms, _ in cells], "decodes": [n for _, n in cells], "growth": growth}
    return figures


@torch.inference_mode()
def print_cuda(photos: PhotoSet, device: torch.device, repeats: int) -> dict[str, Any]:
    """Disparity, sharpening and warp of a batch of crops, with the margin of a pair, on the GPU and on the CPU."""
    view = View(False, (0, 0, CROP[0], 600), CROP[0], 600, 88)
    made = whole_photos(photos, BATCH_SIZE)
    made = [made[i % len(made)] for i in range(BATCH_SIZE)]
    left = torch.cat([image[..., : view.height, : view.width] for image, _ in made])
    inverse_depth = torch.cat([depth for _, depth in made])

    def geometry(left: Tensor, inverse_depth: Tensor):
        return forward_warp(left, to_sharp(to_disparity(inverse_depth, view)))

    here = left.to(device), inverse_depth.to(device)
    on_cpu, on_gpu = (geometry(image.float(), depth) for image, depth in ((left, inverse_depth), here))  # before colours are rounded
    geometry(*here)
    ms = []
    for _ in range(repeats):
        torch.cuda.synchronize(device)
        start = time.perf_counter()
        geometry(*here)
        torch.cuda.synchronize(device)
        ms.append(1e3 * (time.perf_counter() - start))
    masks = all(torch.equal(getattr(on_gpu, name).cpu(), getattr(on_cpu, name)) for name in ("inpaint_mask", "nonocclusion_mask"))
    furthest = float((on_gpu.right.cpu() - on_cpu.right).abs().max()) / 255
    print(
        f"\non {torch.cuda.get_device_name(device)}: disparity, sharpening and warp of {BATCH_SIZE} crops of {view.height}x{view.width} "
        f"in {np.median(ms):.2f} ms (target {CUDA_MS}), {np.median(ms) / BATCH_SIZE:.2f} ms a pair\n"
        f"against the CPU: masks {'bit-equal' if masks else 'DIFFER'}, colours within {furthest:.1e} of the range (target 1e-3)"
    )
    return {"ms": float(np.median(ms)), "masks_equal": masks, "colours_within": furthest}


def pictures_of(folder: Path | None, count: int) -> list[np.ndarray]:
    """The largest photos, as far as a 4:3 part goes; BGR."""
    files = example_photos() if folder is None else sorted(file for file in folder.iterdir() if file.is_file())
    sizes = {}
    for file in files:
        try:
            width, height = probe_size(file.read_bytes())
        except BadPhoto:
            continue  # something else that lies in the folder
        sizes[file] = min(height / 3, width / 4)
    chosen = sorted(sizes, key=lambda file: (-sizes[file], file))[:count]
    if not chosen:
        raise SystemExit(f"{folder} holds no photo; give --photos a folder of JPEG, PNG or WebP files")
    return [np.ascontiguousarray(decode_photo(file.read_bytes()).permute(1, 2, 0).numpy()[..., ::-1]) for file in chosen]


def processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def machine(device: torch.device) -> dict[str, Any]:
    return {
        "processor": processor(),
        "cores": len(os.sched_getaffinity(0)),
        "gpu": torch.cuda.get_device_name(device) if device.type == "cuda" else None,
        "load": os.getloadavg()[0],
        "versions": {
            "torch": torch.__version__,
            "OpenCV": cv2.__version__,
            "numpy": np.__version__,
            "Pillow": PIL.__version__,
            "scikit-image": version("scikit-image"),
            "Python": platform.python_version(),
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, metavar="DIR", help="folder of photos (default: the example photos of scikit-image)")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2], metavar="N", help="numbers of workers to try (default: 1 2)")
    parser.add_argument("--device", default="cpu", help="where batches are finished (default: cpu)")
    parser.add_argument("--quick", action="store_true", help="fewer photos and rounds")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there")
    options = parser.parse_args()
    if min(options.workers) < 1:
        parser.error(f"--workers takes numbers from 1 on; got {options.workers}")
    device = torch.device(options.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        parser.error("torch finds no GPU")
    warnings.simplefilter("ignore", BuiltinDepthWarning)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder, single_thread():
        figures = measure(Path(folder), options, device)
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1) + "\n")


def measure(folder: Path, options: argparse.Namespace, device: torch.device) -> dict[str, Any]:
    count, rounds, pairs = (2, 3, 16) if options.quick else (5, 7, 64)
    start = time.perf_counter()
    here = machine(device)
    versions = ", ".join(f"{name} {version}" for name, version in here["versions"].items())
    print(f"{here['processor']}, {here['cores']} cores, load {here['load']:.1f}; {here['gpu'] or 'no GPU used'}; {versions}")

    pictures = pictures_of(options.photos, count)
    sets = [PhotoSet(folder, size, pictures) for size in Progress(SIZES, desc="photos, depth, finished pairs", disable=None, leave=False)]
    for photos in sets:
        enlarged = sum(min(p.shape[0] / photos.size[0], p.shape[1] / photos.size[1]) < 1 for p in pictures)
        kilobytes = sorted(len(data) // 1000 for data in photos.jpegs)
        print(
            f"{photos.name}: {len(pictures)} photos, JPEG quality {JPEG_QUALITY}, {kilobytes[0]} to {kilobytes[-1]} kB"
            + (f"; {enlarged} of them enlarged" if enlarged else "")
        )

    cached = {photos.name: against_reading(photos, rounds) for photos in sets}
    estimated = {photos.name: builtin_depth(photos, max(1, rounds // 3)) for photos in sets}
    figures: dict[str, Any] = {"machine": here, "photos": {photos.name: [len(data) for data in photos.jpegs] for photos in sets}}
    figures["stages"] = print_stages(sets, cached, estimated)
    figures["reading"] = print_reading(sets, cached)
    figures["geometry"] = print_geometry(sets, rounds)
    workers = sorted(set(options.workers))
    few = max(1, rounds // 2)
    figures["workers"] = print_rates(sets, workers, pairs, few)
    figures["end_to_end"] = print_end_to_end(sets[1], workers, device, pairs, few)
    if device.type == "cuda":
        figures["cuda"] = print_cuda(sets[1], device, 10 * rounds)
    figures["load_at_the_end"] = os.getloadavg()[0]
    print(f"\nload {figures['load_at_the_end']:.1f} at the end; {time.perf_counter() - start:.0f} s in all")
    sys.stdout.flush()
    return figures


if __name__ == "__main__":
    main()
