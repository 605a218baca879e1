"""Micro-batches: how many samples go through a network at once, chosen by memory and lowered where memory runs out.

On the CPU it is always one: in a batch the order of sums, and with it the last bits of a sample, would depend on the samples beside it.
"""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import torch

logger = logging.getLogger("zsdata")

LARGEST_AUTO = 16  # a GPU is busy long before; more only takes memory
AUTO_SHARE = 0.5  # of the memory that is free at warm-up; the rest is the matcher's, which has not taken its own yet
GIB = 2**30

Made = TypeVar("Made")


class WarmUp(NamedTuple):
    """What was found before the first real batch.

    Attributes:
        what: the network and the size that it was tried at.
        micro_batch: samples that go through it at once.
        peak_bytes: the most device memory that weights and activations take together; None where the device does not count it (the CPU).
        weights: bytes of the weights alone.
        seconds: how long the warm-up took.
    """

    what: str
    micro_batch: int
    peak_bytes: int | None
    weights: int
    seconds: float

    def __str__(self) -> str:
        peak = "" if self.peak_bytes is None else f", peak memory {self.peak_bytes / GIB:.2f} GiB"
        return f"{self.what}: micro-batch {self.micro_batch}{peak}, warm after {self.seconds:.1f} s"


def say_warm_up(ready: Sequence[WarmUp], device: torch.device, photos: int = 0) -> str:
    """What the networks of a stream said of their warm-up, a line each; and how much memory of the device they take in all, where they
    work on whole photos for those that are as large as the first so many."""
    lines = [f"zsdata on {device}: {said}" for said in ready]
    activations = [said.peak_bytes - said.weights for said in ready if said.peak_bytes is not None]
    if activations:
        peak = sum(said.weights for said in ready) + max(activations)  # weights stay, activations come one after another
        like = f" while no photo is larger than the first {photos}" if photos else ""
        lines.append(f"zsdata on {device}: the stream takes at most {peak / GIB:.2f} GiB beside training{like}")
    return "\n".join(lines)


class MicroBatch:
    """Runs work over many samples in parts of equal size; a part that does not fit into memory makes all later parts smaller.

    Args:
        what: for messages, such as "depth network".
        size: the most samples at once, 1 or more; on the CPU 1 is used instead.
        device: where the work is done.
        cure: ends the sentence "...: " in the error that is raised when one sample alone does not fit.

    `size` is what is used now; `lowered` counts how often memory ran out.
    """

    def __init__(self, what: str, size: int, device: torch.device, cure: str) -> None:
        self.what, self.cure, self.device = what, cure, device
        self._most = 1 if device.type == "cpu" else sys.maxsize
        self.lowered = 0
        self.choose(size)

    def choose(self, size: int) -> None:
        """At most so many samples at once from now on; fewer where memory has run out before."""
        self.size = min(size, self._most)

    def evenly(self, total: int) -> int:
        """How many samples the largest part of `total` has: there are no more parts than needed, and they differ by one at most."""
        parts = -(-total // self.size)
        return -(-total // parts)

    def run(self, work: Callable[[slice], Made], total: int, rows: Callable[[int], int] = int) -> list[Made]:
        """`work(part)` for parts that cover range(total), in order.

        Args:
            rows: how many samples the work makes of a part of so many: more, where it is filled up.

        Raises:
            MemoryError: a single sample does not fit.
        """
        made: list[Made] = []
        start = 0
        while start < total:
            stop = start + self.evenly(total - start)
            failed = None
            try:
                made.append(work(slice(start, stop)))
            except RuntimeError as error:
                if not out_of_memory(error):
                    raise
                failed = error.with_traceback(None)  # its frames hold what there was no memory for
            if failed is None:
                start = stop
            else:
                self._lower(rows(stop - start), failed)
        return made

    def measure(self, work: Callable[[], object]) -> tuple[int | None, float]:
        """As the function of that name; once more where memory ran out on the way, as the peak would be that of what did not fit."""
        lowered = self.lowered
        peak, seconds = measure(work, self.device)
        if self.lowered > lowered:
            peak, again = measure(work, self.device)
            seconds += again
        return peak, seconds

    def _lower(self, tried: int, error: RuntimeError) -> None:
        self.lowered += 1
        if tried == 1:
            raise MemoryError(f"{self.device} has not enough memory for one sample ({self.what}): {self.cure}") from error
        self.size = self._most = tried // 2
        logger.warning(
            "%s ran out of memory (%s) with %d samples at once; from now on it takes %d, and nothing else changes. "
            "To avoid it, set micro_batch=%d",
            self.device,
            self.what,
            tried,
            self.size,
            self.size,
        )
        if self.device.type == "cuda":
            torch.cuda.empty_cache()


def out_of_memory(error: RuntimeError) -> bool:
    """Whether it is torch's own error of that kind, or one of the libraries below it."""
    return isinstance(error, torch.OutOfMemoryError) or "ALLOC_FAILED" in str(error) or "out of memory" in str(error)


def to_device(networks: Sequence[torch.nn.Module], device: torch.device, what: str, cure: str) -> None:
    """Puts networks on the device.

    Raises:
        MemoryError: they do not fit; `what` they are and the `cure` are said.
    """
    try:
        for network in networks:
            network.to(device)
    except RuntimeError as error:
        if not out_of_memory(error):
            raise
        takes = weight_bytes(*networks) / GIB
        raise MemoryError(f"{device} has not enough memory for {what}, whose weights take {takes:.2f} GiB: {cure}") from error


def largest_micro_batch(peak_bytes: Callable[[int], int], budget_bytes: int, most: int = LARGEST_AUTO) -> int:
    """The largest power of two, at most `most`, whose work takes at most `budget_bytes`; 1 where not even 1 does.

    Sizes are doubled, and one is tried only where the two before it foretell that it fits, so that nothing fails on the way. The second
    size has no two before it: it is tried where twice the first fits.

    Args:
        peak_bytes: runs the work for so many samples and says how much memory it took.
        budget_bytes: how much it may take.
        most: the largest size that is wanted.
    """
    size, slope = 1, None
    peak = peak_bytes(size)
    while 2 * size <= most:
        foretold = peak + size * (peak if slope is None else slope)
        if foretold > budget_bytes:
            break
        doubled = peak_bytes(2 * size)
        if doubled > budget_bytes:
            break
        size, slope, peak = 2 * size, (doubled - peak) / size, doubled
    return size


def measure(work: Callable[[], object], device: torch.device) -> tuple[int | None, float]:
    """Bytes of device memory that `work` takes at its peak beyond what is taken already (None on the CPU), and its seconds."""
    start = time.perf_counter()
    if device.type != "cuda":
        work()
        return None, time.perf_counter() - start
    torch.cuda.synchronize(device)
    before = torch.cuda.memory_allocated(device)
    torch.cuda.reset_peak_memory_stats(device)
    work()
    torch.cuda.synchronize(device)
    return torch.cuda.max_memory_allocated(device) - before, time.perf_counter() - start


def free_bytes(device: torch.device) -> int:
    """Memory of a CUDA device that can still be taken: what no process has, and what torch holds without using it."""
    free, _ = torch.cuda.mem_get_info(device)
    return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)


def weight_bytes(*networks: torch.nn.Module) -> int:
    """Memory of all parameters and buffers."""
    return sum(tensor.numel() * tensor.element_size() for network in networks for tensor in (*network.parameters(), *network.buffers()))
