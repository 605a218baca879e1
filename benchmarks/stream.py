"""How fast the stream is: where a pair's time goes, and pairs per second against the number of workers.

    python benchmarks/stream.py                                   # the photos that scikit-image ships
    python benchmarks/stream.py --sources shards --pairs 64
    python benchmarks/stream.py --sources shards --device cuda

Every figure also stands as a multiple of decoding the same photos with OpenCV in the same run, so that machines can be compared.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import tempfile
import time
import warnings

import cv2
import numpy as np
import torch

from zsdata import ZeroStereoStream
from zsdata.example_photos import pack_example_photos
from zsdata.source.manifest import build_manifest
from zsdata.synthesis.depth.builtin import BuiltinDepthWarning


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sources", nargs="+", metavar="URL", help="tars of photos (default: the example photos)")
    parser.add_argument("--size", type=int, nargs=2, default=(384, 512), metavar=("HEIGHT", "WIDTH"), help="default: 384 512")
    parser.add_argument("--pairs", type=int, default=96, help="pairs per measurement (default: 96)")
    parser.add_argument("--repeats", type=int, default=3, help="the median of so many runs counts (default: 3)")
    parser.add_argument("--workers", type=int, nargs="+", default=[0, 1, 2], help="numbers of workers to try (default: 0 1 2)")
    parser.add_argument("--batch-size", type=int, default=8, help="default: 8")
    parser.add_argument("--device", default="cpu", help="where batches are finished (default: cpu)")
    options = parser.parse_args()
    warnings.simplefilter("ignore", BuiltinDepthWarning)
    with tempfile.TemporaryDirectory() as folder:
        if options.sources is None:
            pack_example_photos(folder)
        measure(options, options.sources or [folder])


def measure(options: argparse.Namespace, sources: list[str]) -> None:
    cuda = options.device.startswith("cuda")
    device = torch.cuda.get_device_name() if cuda else platform.processor() or platform.machine()
    print(f"{device}, torch {torch.__version__}, OpenCV {cv2.__version__}, numpy {np.__version__}, Python {platform.python_version()}")
    decode_ms = 1000 * statistics.median(decode_seconds(sources) for _ in range(options.repeats))
    print(f"JPEG or PNG decode of one photo (OpenCV, one thread, mean over the photos): {decode_ms:.2f} ms\n")

    stream = ZeroStereoStream(sources, size=tuple(options.size), epoch_size=options.pairs)
    pairs = options.pairs // options.batch_size * options.batch_size
    runs = {workers: [one_epoch(stream, options, workers) for _ in range(options.repeats)] for workers in options.workers}

    fewest = min(options.workers)
    print(f"stage ({fewest} workers)     ms a pair   decodes")
    stages = sorted({name for _, seconds in runs[fewest] for name in seconds} - {"wait"})
    for stage in stages:
        ms = 1000 * statistics.median(seconds.get(stage, 0) for _, seconds in runs[fewest]) / pairs
        print(f"{stage:22}  {ms:9.2f} {ms / decode_ms:9.1f}")
    height, width = options.size
    print(f"\nworkers    pairs/s    decodes a pair    share of time waiting for workers ({options.device}, {height}x{width})")
    for workers, results in runs.items():
        seconds = statistics.median(elapsed for elapsed, _ in results)
        wait = statistics.median(stages.get("wait", 0) / elapsed for elapsed, stages in results)
        print(f"{workers:7} {pairs / seconds:10.1f} {1000 * seconds / pairs / decode_ms:17.1f} {wait:35.0%}")


def decode_seconds(sources: list[str]) -> float:
    """Seconds per photo of OpenCV's decoder alone, on one thread."""
    manifest = build_manifest(sources)
    photos = [np.frombuffer(manifest.read(i), np.uint8) for i in range(min(len(manifest), 100))]
    cv2.setNumThreads(1)
    start = time.perf_counter()
    for photo in photos:
        cv2.imdecode(photo, cv2.IMREAD_COLOR)
    return (time.perf_counter() - start) / len(photos)


def one_epoch(stream: ZeroStereoStream, options: argparse.Namespace, workers: int) -> tuple[float, dict[str, float]]:
    """Seconds for an epoch of batches once the workers have started, and seconds by stage."""
    with stream.loader(options.batch_size, num_workers=workers, device=options.device) as loader:
        for _ in loader:  # starts the workers, loads what they need, and leaves the next epoch to be measured
            pass
        before = loader.stats()["seconds"]
        start = time.perf_counter()
        for batch in loader:
            del batch
        if options.device.startswith("cuda"):
            torch.cuda.synchronize()
        elapsed = time.perf_counter() - start
        after = loader.stats()["seconds"]
    return elapsed, {name: after[name] - before.get(name, 0) for name in after}


if __name__ == "__main__":
    main()
