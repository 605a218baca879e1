"""Which GPU does diffusion inpainting fit on? The memory of a micro-batch, counted tensor by tensor; no GPU needed.

    python benchmarks/inpainting_memory.py                  # full-size networks on the CPU, three minutes
    python benchmarks/inpainting_memory.py --smoke          # small networks: does it run at all

Stable Diffusion 2 Inpainting's U-Net and autoencoder with random weights, as in tiers.py, make two steps with real tensors in bf16. Counted
are the bytes of all tensors that are alive at once, which no GPU can do without; a run on one also takes the workspaces of its kernels,
what its allocator loses to fragments, and the context of CUDA. Where there is a GPU, tiers.py measures what they take together.

"process" is measured, on Linux: the most memory that a process which did only this ever held, from loading the networks to the last pair,
Python and the libraries included (some 0.7 GiB).
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tiers import MEMORY_TARGET_GIB, STAGES, around_stages, gib, print_row, quiet, save_pipeline
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from zsdata import load_inpainter
from zsdata.synthesis.inpaint.diffusion import DiffusionInpainter
from zsdata.synthesis.micro_batch import weight_bytes
from zsdata.synthesis.synthesizer import INPAINT_CONTEXT_PX


class LiveBytes(TorchDispatchMode):
    """Counts the memory of the tensors that operations make while it is entered, from when they are made until nothing refers to them.

    `now` is what they take, in bytes, `peak` the most that they took since it was last set.
    """

    def __init__(self) -> None:
        super().__init__()
        self.peak = self.now = 0
        self._made: set[int] = set()

    def __torch_dispatch__(
        self, function: Callable[..., Any], types: Sequence[type], args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        there_before = {tensor.untyped_storage()._cdata for tensor in tree_leaves((args, kwargs)) if isinstance(tensor, Tensor)}
        result = function(*args, **(kwargs or {}))
        for tensor in tree_leaves(result):
            if isinstance(tensor, Tensor):
                storage = tensor.untyped_storage()
                if storage._cdata not in there_before and storage._cdata not in self._made:
                    self._made.add(storage._cdata)
                    self.now += storage.nbytes()
                    weakref.finalize(storage, self._forget, storage._cdata, storage.nbytes())
        self.peak = max(self.peak, self.now)
        return result

    def _forget(self, storage: int, size: int) -> None:
        self._made.discard(storage)
        self.now -= size


def stage_bytes(inpainter: DiffusionInpainter, pairs: int, size: tuple[int, int]) -> dict[str, int]:
    """The most memory that all tensors beside the weights take at once, while each stage runs."""
    peaks = {}
    with LiveBytes() as live:

        @contextmanager
        def count(stage: str) -> Iterator[None]:
            live.peak = live.now
            yield
            peaks[stage] = live.peak

        with around_stages(inpainter, count):
            inpainter._try(pairs, size)
    return peaks


def measure(folder: str, tiny: str | None, dtype: str, pairs: int, size: tuple[int, int]) -> tuple[int, dict[str, int], int | None]:
    """Bytes of the weights, those of each stage beside them, and the most that this process ever held."""
    quiet()
    inpainter = load_inpainter(folder, steps=1, autoencoder=tiny, dtype=dtype)
    assert isinstance(inpainter, DiffusionInpainter)
    peaks = stage_bytes(inpainter, pairs, size)
    return weight_bytes(inpainter._unet, inpainter._autoencoder), peaks, most_resident_bytes()


def most_resident_bytes() -> int | None:
    """The most memory that this process ever held; None where the system does not tell."""
    status = Path("/proc/self/status")  # getrusage tells the parent's, where that was more
    if not status.is_file():
        return None
    return next(1024 * int(line.split()[1]) for line in status.read_text().splitlines() if line.startswith("VmHWM:"))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="small networks in float32")
    parser.add_argument(
        "--size", type=int, nargs=2, default=(384, 512), metavar=("HEIGHT", "WIDTH"), help="of the pairs (default: 384 512)"
    )
    parser.add_argument("--micro-batch", type=int, default=8, help="pairs at once (default: 8)")
    options = parser.parse_args(arguments)
    height, width = options.size
    dtype = "float32" if options.smoke else "bf16"
    quiet()
    print(f"torch {torch.__version__}, {height}x{width}, micro-batch {options.micro_batch}, {dtype}; GiB")
    print_row(("autoencoder", "weights", *STAGES, "all", "process", "target"))
    with tempfile.TemporaryDirectory() as folder:
        save_pipeline(Path(folder), torch.device("cpu"), options.smoke)
        for autoencoder in ("full", "tiny"):
            tiny = str(Path(folder) / "tiny") if autoencoder == "tiny" else None
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as alone:
                asked = alone.submit(measure, folder, tiny, dtype, options.micro_batch, (height, width + INPAINT_CONTEXT_PX))
                weights, peaks, process = asked.result()
            together = weights + max(peaks.values())
            print_row((autoencoder, gib(weights), *map(gib, peaks.values()), gib(together), gib(process), f"{MEMORY_TARGET_GIB:g}"))


if __name__ == "__main__":
    main()
