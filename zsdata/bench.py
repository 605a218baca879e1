"""How fast a stream feeds training on this machine: where a pair's time goes, how many arrive in a second, and what bounds it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice, repeat

import cv2
import numpy as np
import torch
from torch import Tensor

from zsdata.loader import PREFETCHED_BATCHES
from zsdata.progress import Progress
from zsdata.sample import StereoBatch
from zsdata.stream import ZeroStereoStream
from zsdata.worker import single_thread

WORKER_STAGES = ("read", "decode", "view", "depth", "disparity", "sharpen", "warp", "background")
DRAFT_STAGES = ("read", "decode", "view", "background")  # what is left of them where depth is the training device's work
FINISH_STAGES = ("transfer", "inpaint", "augment")
REST = "rest"  # of a process's time: bookkeeping, copies, collation
BOUND_BY_WORKERS = 0.25  # share of its time that the training process waits for them; below it more of them would gain little


@dataclass(frozen=True)
class Run:
    """What a loader delivered once all its workers were under way.

    Attributes:
        seconds: of `pairs`, by the clock.
        stages: seconds by stage, as `StereoLoader.stats` has them: those of the workers added up over all of them.
        ready_batches: prepared batches that lay ready when one was asked for, on average.
        depth_on_device: the training process estimates depth and warps, on its device.
    """

    workers: int
    pairs: int
    seconds: float
    stages: Mapping[str, float]
    ready_batches: float
    depth_on_device: bool = False

    @property
    def pairs_per_second(self) -> float:
        return self.pairs / self.seconds

    @property
    def waiting(self) -> float:
        """Share of its time that the training process waited for a prepared batch; without workers: prepared one itself."""
        return min(1.0, self.stages["wait"] / self.seconds)


@dataclass(frozen=True)
class BenchReport:
    """What `bench` measured.

    Attributes:
        decode_ms: milliseconds that OpenCV takes to decode one of the same photos, on one thread.
        worker_ms: milliseconds of a pair by stage, what a worker does; measured without workers, one stage after the other.
        finish_ms: likewise, what the training process does. On a GPU one stage: its steps run while the next ones are sent to it.
        runs: one for each number of workers, ascending; the first has none.
    """

    decode_ms: float
    worker_ms: Mapping[str, float]
    finish_ms: Mapping[str, float]
    runs: tuple[Run, ...]


def bench(
    stream: ZeroStereoStream, workers: Sequence[int], *, batch_size: int, pairs: int, device: str | torch.device = "cpu"
) -> BenchReport:
    """Measures a stream: its stages, and its pairs per second for some numbers of workers.

    Every run makes the same pairs, from the stream's first one on; `samples_needed` says how many there are. The time that workers need
    to start is not counted.

    Args:
        stream: its own place does not move.
        workers: numbers of worker processes; 0 is always measured.
        batch_size, device: as `ZeroStereoStream.loader` takes them.
        pairs: to measure, rounded up to whole batches, and to two batches per worker.
    """
    device = torch.device(device)
    counts = sorted({0, *workers})
    decoding: list[float] = []
    runs = []
    total = sum(batch_size * (_warm_up(count) + _measured(count, pairs, batch_size)) for count in counts)
    with Progress(total=total, unit="pair", disable=None) as bar:

        def count_and_decode(batch: StereoBatch) -> None:
            bar.update(batch_size)
            decoding.extend(_decode_seconds(stream, batch))

        def count_only(batch: StereoBatch) -> None:
            bar.update(batch_size)

        for count in counts:
            bar.set_description(f"{count} worker{'s' * (count != 1)}")
            after_batch = count_only if count else count_and_decode
            runs.append(
                feed(
                    stream,
                    count,
                    batch_size=batch_size,
                    batches=_measured(count, pairs, batch_size),
                    device=device,
                    after_batch=after_batch,
                )
            )
    worker_ms, finish_ms = split_stages(runs[0], device)
    return BenchReport(1e3 * float(np.mean(decoding)), worker_ms, finish_ms, tuple(runs))


def samples_needed(workers: Sequence[int], *, batch_size: int, pairs: int) -> int:
    """Samples that `bench` looks at, with what is prefetched; an epoch of so many holds them all."""
    return max(batch_size * (_warm_up(count) + _measured(count, pairs, batch_size) + PREFETCHED_BATCHES * count) for count in {0, *workers})


def _warm_up(workers: int) -> int:
    """Batches until every worker has delivered one."""
    return max(1, workers)


def _measured(workers: int, pairs: int, batch_size: int) -> int:
    return max(math.ceil(pairs / batch_size), 2 * workers)


def feed(
    stream: ZeroStereoStream,
    workers: int,
    *,
    batch_size: int,
    batches: int,
    device: str | torch.device = "cpu",
    after_batch: Callable[[StereoBatch], object] = lambda batch: None,
) -> Run:
    """Takes batches from a new loader as fast as they come, and counts them once every worker has delivered its first.

    Args:
        batches: to count.
        after_batch: called with each batch, the first ones too; its own time is not counted. Workers go on meanwhile, so with workers it
            must be short.
    """
    device = torch.device(device)
    with stream.loader(batch_size, num_workers=workers, device=device, rank=0, world_size=1) as loader:
        arriving = chain.from_iterable(repeat(loader))  # epoch after epoch
        for batch in islice(arriving, _warm_up(workers)):
            after_batch(batch)
        _wait_for(device)
        before, seconds = loader.stats(), 0.0
        for number in range(1, batches + 1):
            start = time.perf_counter()
            batch = next(arriving)
            if not workers or number == batches:
                _wait_for(device)
            seconds += time.perf_counter() - start
            after_batch(batch)
        after = loader.stats()
        depth_on_device = loader._finisher.synthesis is not None
    ready = after["ready_batches"] * after["batches"] - before["ready_batches"] * before["batches"]
    stages = {name: value - before["seconds"].get(name, 0.0) for name, value in after["seconds"].items()}
    return Run(workers, batches * batch_size, seconds, stages, ready / batches, depth_on_device)


def split_stages(run: Run, device: torch.device) -> tuple[dict[str, float], dict[str, float]]:
    """Milliseconds of a pair by stage of a run without workers: what a worker would do, and what is left; together all of its time."""

    def of(names: Sequence[str], seconds: float) -> dict[str, float]:
        stages = {name: 1e3 * run.stages[name] / run.pairs for name in names if name in run.stages}
        return {**stages, REST: max(0.0, 1e3 * seconds / run.pairs - sum(stages.values()))}

    finishing = run.seconds - run.stages["wait"]
    of_worker = DRAFT_STAGES if run.depth_on_device else WORKER_STAGES
    of_finish = tuple(name for name in WORKER_STAGES if name not in of_worker) + FINISH_STAGES
    worker_ms = of(of_worker, run.stages["wait"])
    return worker_ms, of(of_finish, finishing) if device.type == "cpu" else {f"finish on {device.type}": 1e3 * finishing / run.pairs}


def fill_depth_cache(stream: ZeroStereoStream, workers: int, samples: int) -> None:
    """Makes the stream's first samples, so that its depth cache knows their photos; `leave_holes` spares it the inpainting."""
    with stream.loader(1, num_workers=workers, rank=0, world_size=1) as loader:
        for _ in Progress(islice(loader, samples), desc="filling the depth cache", total=samples, unit="pair", disable=None):
            pass


def leave_holes(right: Tensor, inpaint_mask: Tensor, generators: Sequence[np.random.Generator]) -> Tensor:
    """An inpainter that costs nothing: to look at the workers alone."""
    return right


def advice(report: BenchReport, *, device: str | torch.device, cores: int, depth_cached: bool, depth_stored: bool = False) -> str:
    """In words: what bounds the run with the most workers, and what to change."""
    run = report.runs[-1]
    name, share = _largest(report.worker_ms)
    cure = _cure(name, depth_cached, depth_stored)
    if run.workers and run.waiting < BOUND_BY_WORKERS:
        name, share = _largest(report.finish_ms)
        where = torch.device(device).type
        return (
            f"The training process bounds it: with {_workers(run.workers)} it waits for them only {run.waiting:.0%} of the time, and "
            f"{name} takes {share:.0%} of what it does for a pair. "
            + (
                "Finish the batches on a GPU (--device cuda), and leave the CPU to the workers."
                if where == "cpu"
                else "That is the GPU's work: take a faster inpainter"
                + (", or keep depth on disk (--depth-cache DIR)." if run.depth_on_device and not depth_cached else ".")
            )
        )
    if not run.workers:
        return (
            f"One process does everything: try one worker per core ({cores} here, --workers {cores}). "
            f"Of a worker's time {name} takes {share:.0%}: {cure}."
        )
    more = f"use more of them (there are {cores} cores), or " if run.workers < cores else ""
    return (
        f"The workers bound it: with {_workers(run.workers)} the training process waits for them {run.waiting:.0%} of the time. "
        f"Of a worker's time {name} takes {share:.0%}: {more}{cure}."
    )


def _cure(stage: str, depth_cached: bool, depth_stored: bool) -> str:
    if stage == "depth" and depth_stored:
        return "draw several views from a photo (--views-per-image 2), or store its map as .npy, or a smaller one"
    if stage == "depth" and not depth_cached:
        return "keep it on disk (--depth-cache DIR), draw several views from a photo (--views-per-image 2), or take a smaller estimator"
    return {
        "depth": "it is read from the cache already; put that on a local disk",
        "read": "put the shards on a local disk",
        "decode": "pack smaller photos, as JPEG, or draw several views from a photo (--views-per-image 2)",
    }.get(stage, "ask for smaller pairs (--size)")


def _largest(stages: Mapping[str, float]) -> tuple[str, float]:
    name = max(stages, key=lambda name: stages[name])
    return name, stages[name] / max(sum(stages.values()), 1e-9)


def _workers(count: int) -> str:
    return f"{count} worker{'s' * (count != 1)}"


def _decode_seconds(stream: ZeroStereoStream, batch: StereoBatch) -> list[float]:
    """Seconds that OpenCV's decoder alone takes for each photo of a batch."""
    seconds = []
    with single_thread():
        for meta in batch.meta:
            if meta["replaced"]:
                continue  # the planned photo cannot be decoded
            sources = stream._schedule.at(meta["epoch"])
            choice = sources.plan.choose(meta["epoch"], meta["index"])
            data = np.frombuffer(sources.manifests[choice.source].read(choice.member), np.uint8)
            start = time.perf_counter()
            cv2.imdecode(data, cv2.IMREAD_COLOR)
            seconds.append(time.perf_counter() - start)
    return seconds


def _wait_for(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
