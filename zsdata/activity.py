"""What a worker process is doing right now, in memory that the process waiting for it can read."""

from __future__ import annotations

import mmap
import os
import struct
from multiprocessing.reduction import DupFd
from typing import Any, NamedTuple

from zsdata.parcel import memory_file

_DOING = struct.Struct("<qqq24s")  # samples begun, epoch, index, stage
_STAGE_AT = struct.calcsize("<qqq")
_STAGE_BYTES = 24


class Doing(NamedTuple):
    """`begun` counts the samples that the worker has begun; before the first one, `epoch` and `index` mean nothing."""

    begun: int
    epoch: int
    index: int
    stage: str


class Activity:
    """One worker writes, the training process reads. A value read while it is written may be torn; it only serves to say and to compare."""

    def __init__(self) -> None:
        self._open(memory_file())
        os.ftruncate(self._file, _DOING.size)
        self._memory = mmap.mmap(self._file, _DOING.size)

    def _open(self, file: int) -> None:
        self._file = file
        self._begun = 0

    def begin(self, epoch: int, index: int) -> None:
        """The next sample is begun."""
        self._begun += 1
        _DOING.pack_into(self._memory, 0, self._begun, epoch, index, b"")

    def enter(self, stage: str) -> None:
        """The sample has come to a stage."""
        self._memory[_STAGE_AT : _STAGE_AT + _STAGE_BYTES] = stage.encode()[:_STAGE_BYTES].ljust(_STAGE_BYTES, b"\0")

    def read(self) -> Doing:
        """What was written last."""
        begun, epoch, index, stage = _DOING.unpack_from(self._memory)
        return Doing(begun, epoch, index, stage.rstrip(b"\0").decode(errors="replace"))

    def close(self) -> None:
        """Frees the memory in this process."""
        self._memory.close()
        os.close(self._file)

    def __getstate__(self) -> Any:
        return DupFd(self._file)

    def __setstate__(self, file: Any) -> None:
        self._open(file.detach())
        self._memory = mmap.mmap(self._file, _DOING.size)
