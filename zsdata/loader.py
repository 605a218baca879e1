"""The loader: worker processes, the training device, and the place in the stream."""

from __future__ import annotations

import logging
import multiprocessing
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import cv2
import torch
from accelerate.state import GradientState
from torch import Tensor
from tqdm import tqdm

from zsdata.faults import FailureBudget, FaultLog
from zsdata.finish import Finisher
from zsdata.meter import Meter
from zsdata.pool import Job, WorkerPool
from zsdata.position import Position
from zsdata.prepared import Prepared, stack
from zsdata.progress import use_own_lock
from zsdata.rejected import RejectedFile
from zsdata.sample import StereoBatch
from zsdata.synthesis.depth.builtin import BuiltinDepthWarning
from zsdata.worker import Worker

logger = logging.getLogger("zsdata")

PREFETCHED_BATCHES = 2  # per worker, ready or in the making
SAMPLE_TIMEOUT_SECONDS = 300.0  # the largest depth networks take a minute and more for a large photo on one thread


class StereoLoader:
    """Finished batches on the device, for one rank; made by `ZeroStereoStream.loader`.

    `iter(loader)` gives what is left of the current epoch and moves on to the next one at its end; a broken-off loop is continued where it
    stopped. Global batch g of an epoch holds its samples [g R B, (g + 1) R B) for R ranks of batch B, so every rank sees the same number of
    batches and no sample is given twice. It is no torch DataLoader: `Accelerator.prepare` leaves it alone, and it tells Accelerate itself
    when an epoch ends, as gradient accumulation needs to know.

    Not made for two loops at once: one loader has one place.
    """

    def __init__(
        self,
        *,
        worker: Worker,
        finisher: Finisher,
        place: Callable[[], Position],
        revision: Callable[[], int],
        epoch_size: Callable[[int], int],
        budget: FailureBudget,
        problems: Callable[[], Mapping[str, int]],
        batch_size: int,
        num_workers: int,
        rank: int,
        world_size: int,
        multiprocessing_context: str | None,
        timeout_seconds: float,
        rejected: str | os.PathLike[str] | None,
    ) -> None:
        for name, value, least in (
            ("batch_size", batch_size, 1),
            ("num_workers", num_workers, 0),
            ("rank", rank, 0),
            ("world_size", world_size, 1),
        ):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ValueError(f"{name} is an integer, {least} or more; got {value!r}")
        if rank >= world_size:
            raise ValueError(f"rank is in 0..world_size - 1; got rank {rank} of {world_size}")
        if not isinstance(timeout_seconds, (int, float)) or not timeout_seconds > 0:
            raise ValueError(f"timeout_seconds is above 0; got {timeout_seconds!r}")
        if multiprocessing_context not in (None, *multiprocessing.get_all_start_methods()):
            methods = ", ".join(multiprocessing.get_all_start_methods())
            raise ValueError(f"multiprocessing_context is one of {methods}, or None; got {multiprocessing_context!r}")
        self.batch_size = batch_size
        self.rank = rank
        self.world_size = world_size
        self.device = finisher.device
        self._worker = worker
        self._finisher = finisher
        self._place = place
        self._revision = revision
        self._epoch_size = epoch_size
        self._num_workers = num_workers
        self._context = multiprocessing_context
        self._timeout_seconds = timeout_seconds
        self._epoch = 0
        self._samples = 0
        self._pipeline: _Pipeline | None = None
        self._faults = FaultLog(budget, ranks=world_size)
        self._rejected = None if rejected is None else RejectedFile(rejected)
        self._problems = problems
        self._meter = Meter()
        self._batches = 0
        self._ready = 0
        # What Accelerate's gradient state reads of the loader that is being iterated.
        self.end_of_dataloader = False
        self.remainder = -1
        self._check_epoch(0)

    def __len__(self) -> int:
        """Batches that a rank is given in a whole epoch (the current one)."""
        return self._epoch_size(self._epoch) // self._global_batch

    @property
    def epoch(self) -> int:
        """The epoch that the next batch belongs to."""
        return self._epoch

    def __iter__(self) -> Iterator[StereoBatch]:
        epoch = self._epoch
        self._check_epoch(epoch)
        gradient_state = GradientState()
        gradient_state._add_dataloader(self)
        self.end_of_dataloader = False
        try:
            while self._left(epoch, self._samples) > 0:
                with self._meter.stage("wait"):
                    prepared = self._next_prepared()
                batch = self._finisher(prepared, self._meter)
                self._count(batch.meta)
                self._batches += 1
                self._samples += self._global_batch
                last = self._left(epoch, self._samples) == 0
                if last:
                    self._epoch, self._samples = epoch + 1, 0
                self.end_of_dataloader = last
                yield batch
                if last or self._epoch != epoch:
                    return
            self._epoch, self._samples = epoch + 1, 0  # a swap of its sources has left nothing of the epoch
        except GeneratorExit:
            raise
        except BaseException as error:  # KeyboardInterrupt too: what was prefetched no longer follows the place
            self.close()
            if self.world_size > 1 and isinstance(error, Exception):
                logger.error("rank %d of %d stops: %s: %s", self.rank, self.world_size, type(error).__name__, error)
            raise
        finally:
            gradient_state._remove_dataloader(self)

    def state_dict(self) -> dict[str, Any]:
        """The place after the last batch given out: small, plain JSON, the same on every rank; prefetched batches do not count."""
        return replace(self._place(), epoch=self._epoch, samples=self._samples).to_state()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes to the place that `state_dict` named, with any number of ranks and workers and any batch size.

        Raises:
            ValueError: for a state of another stream; it names the field that differs.
        """
        place = Position.from_state(state, self._place(), self._epoch_size)
        self.close()
        self._epoch, self._samples = place.epoch, place.samples
        if not self._left(self._epoch, self._samples):  # a larger batch no longer fits into the rest of the epoch
            self._epoch, self._samples = self._epoch + 1, 0

    def stats(self) -> dict[str, Any]:
        """What this rank has seen so far.

        `batches`, `pairs`; `ready_batches`: how many prepared batches lay ready when one was asked for, on average; `rejected`: photos
        that this rank refused, by reason; `examples`: (source, shard, key, reason) of the first ones; `shard_problems`: faults of the
        shards themselves, by reason; `micro_batch_lowered`: how often a network had to take fewer at once because memory ran out;
        `seconds`: time by stage, those of the workers added up over all of them, "wait" being how long the training process stood still for
        lack of a prepared batch. On a GPU they go by the clock of this process: the first stage that waits for the GPU, most often
        "inpaint", has in it what the training had left it to do.
        """
        return {
            "batches": self._batches,
            "pairs": self._batches * self.batch_size,
            "ready_batches": self._ready / max(1, self._batches),
            "rejected": dict(self._faults.by_reason),
            "examples": list(self._faults.examples),
            "shard_problems": dict(self._problems()),
            "micro_batch_lowered": self._finisher.micro_batch_lowered,
            "seconds": dict(self._meter.seconds),
        }

    def close(self) -> None:
        """Ends the worker processes; the next iteration starts new ones."""
        if self._pipeline is not None:
            self._pipeline.close()
            self._pipeline = None

    def __enter__(self) -> StereoLoader:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def _global_batch(self) -> int:
        return self.batch_size * self.world_size

    def _left(self, epoch: int, samples: int) -> int:
        """Global batches left of an epoch; what does not fill one is left out."""
        return max(0, self._epoch_size(epoch) - samples) // self._global_batch

    def _check_epoch(self, epoch: int) -> None:
        size = self._epoch_size(epoch)
        if size < self._global_batch:
            raise ValueError(
                f"epoch {epoch} has {size} samples, less than one batch of {self.batch_size} on each of {self.world_size} ranks; "
                "lower batch_size, or set epoch_size to let photos repeat"
            )

    def _next_prepared(self) -> Prepared:
        if self._pipeline is not None and self._pipeline.revision != self._revision():
            self.close()  # the sources were swapped: what was prefetched may no longer be what the plan says
        if self._pipeline is None:
            self._pipeline = _Pipeline(
                self._worker,
                self._requests(self._epoch, self._samples),
                self._num_workers,
                self.device,
                self._context,
                self._timeout_seconds,
                self._revision(),
            )
        self._ready += self._pipeline.ready
        prepared = next(self._pipeline)
        expected = self._indices(self._samples)
        if [(meta["epoch"], meta["index"]) for meta in prepared.meta] != [(self._epoch, index) for index in expected]:
            raise RuntimeError(f"expected samples {expected} of epoch {self._epoch}, got {prepared.meta}")
        self._meter.add(prepared.seconds)
        return prepared

    def _count(self, samples: Sequence[Mapping[str, Any]]) -> None:
        """Counts the photos that the samples (the `meta` of a batch) stand in for; a pair's on its first sample alone."""
        firsts = [meta for meta in samples if meta["index"] == meta["pair"]]
        if self._rejected is not None:
            self._rejected.add(firsts)
        self._faults.add(len(samples), [tuple(reject) for meta in firsts for reject in meta["replaced"]])

    def _indices(self, samples: int) -> list[int]:
        first = samples + self.rank * self.batch_size
        return list(range(first, first + self.batch_size))

    def _requests(self, epoch: int, samples: int) -> Iterator[list[tuple[int, int]]]:
        """All batches of this rank from a place on, as far as every epoch has one."""
        while self._left(epoch, samples):
            while self._left(epoch, samples):
                yield [(epoch, index) for index in self._indices(samples)]
                samples += self._global_batch
            epoch, samples = epoch + 1, 0


class _Pipeline:
    """Prepared batches in the order of the requests, made by worker processes or, without any, in this one."""

    def __init__(
        self,
        worker: Worker,
        requests: Iterator[list[tuple[int, int]]],
        num_workers: int,
        device: torch.device,
        context: str | None,
        timeout_seconds: float,
        revision: int,
    ) -> None:
        self.revision = revision
        self._pool: WorkerPool | None = None
        if num_workers:
            self._pool = WorkerPool(
                Job(start_worker, worker.prepare, stack),
                requests,
                processes=num_workers,
                ahead=PREFETCHED_BATCHES,
                context=context,
                timeout_seconds=timeout_seconds,
                take=Tensor.pin_memory if device.type == "cuda" else Tensor.clone,
            )
            self._batches: Iterator[Any] = self._pool
        else:
            self._batches = (stack([worker.prepare(*sample) for sample in request]) for request in requests)

    def __next__(self) -> Any:
        return next(self._batches)

    @property
    def ready(self) -> int:
        """Prepared batches that wait to be taken."""
        return 0 if self._pool is None else self._pool.ready

    def close(self) -> None:
        if self._pool is not None:
            self._pool.close()


def start_worker() -> None:
    """What a worker process begins with."""
    warnings.simplefilter("ignore", BuiltinDepthWarning)  # the process that opened the stream has said it
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    use_own_lock(tqdm)  # a network may draw bars while it is loaded; a worker that is killed meanwhile must stop no other process
