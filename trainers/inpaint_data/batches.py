"""Batches of examples: made by worker processes, or in this one, in the order of their steps."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from trainers.inpaint_data.sources import ExampleBatch, Examples
from zsdata.loader import SAMPLE_TIMEOUT_SECONDS, start_worker
from zsdata.pool import Job, WorkerPool

PREFETCHED_BATCHES = 2  # per worker

Request = list[tuple[int, int]]  # (step, index) of each example of a batch


def requests(first_step: int, last_step: int, batch_size: int, micro_batch: int, rank: int, world_size: int) -> Iterator[Request]:
    """The batches of one rank: all ranks together get every example of a step once, `micro_batch` at a time."""
    for step in range(first_step, last_step):
        for start in range(rank * micro_batch, batch_size, world_size * micro_batch):
            yield [(step, index) for index in range(start, start + micro_batch)]


@contextmanager
def making(examples: Examples, asked: Iterator[Request], workers: int, device: torch.device) -> Iterator[Iterator[ExampleBatch]]:
    """The batches that are asked for; what makes them ends with the block.

    Raises:
        WorkerLost: while they are read: a process was killed, ended or hangs.
        NoUsablePhoto, RuntimeError: as `Examples` raises them, whoever made the example.
    """
    if not workers:
        yield (ExampleBatch.stack([examples[request] for request in batch]) for batch in asked)
        return
    pool = WorkerPool(
        Job(start_worker, examples.sample, ExampleBatch.stack),
        ([examples.place(*request) for request in batch] for batch in asked),
        processes=workers,
        ahead=PREFETCHED_BATCHES,
        context="fork",  # a fork server, Python's choice from 3.14 on, ends by a SIGTERM to all processes, and they with it
        timeout_seconds=SAMPLE_TIMEOUT_SECONDS,
        take=Tensor.pin_memory if device.type == "cuda" else Tensor.clone,
    )
    try:
        yield pool
    finally:
        pool.close()
