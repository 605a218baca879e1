"""Out of memory on the training device: an error that says what to lower."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from zsdata.synthesis.micro_batch import out_of_memory


@contextmanager
def out_of_memory_is_cured_by(cure: str) -> Iterator[None]:
    """Around a training, or as its decorator.

    Raises:
        MemoryError: the device's memory ran out; names `cure`.
    """
    try:
        yield
    except RuntimeError as error:
        if not out_of_memory(error):
            raise
        said = str(error).splitlines() or ["out of memory"]
        raise MemoryError(f"the training does not fit into the device's memory: {cure}. {said[0]}") from error
