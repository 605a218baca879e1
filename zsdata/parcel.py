"""Parcels: what one process made, handed to another through memory that has no name.

Nothing stands in /dev/shm: its size does not matter, and nothing is left behind however a process ends. The memory is used again and again,
since getting it from the system and giving it back takes longer than filling it.
"""

from __future__ import annotations

import ctypes
import fcntl
import io
import os
import pickle
import socket
import struct
import termios
from array import array
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

ALIGNMENT_BYTES = 64  # a cache line; every dtype may begin there
GROWTH_BYTES = 2**20  # memory grows by whole steps, so that it soon grows no more
_MESSAGE = struct.Struct("<QQQ")  # which memory, bytes of the parcel in it, bytes of the pickle at the parcel's end
_CLOSE_ON_EXEC = 1


class Outbox:
    """Sends parcels over a SOCK_SEQPACKET socket. A message arrives whole or not at all, whatever happens to the sender.

    Args:
        ahead: how many parcels may be on their way or waiting: so many memories are used in turn.
    """

    def __init__(self, channel: socket.socket, ahead: int) -> None:
        self._channel = channel
        self._files = [memory_file() for _ in range(ahead)]
        self._sizes = [0] * ahead
        self._sent = 0

    def send(self, made: Any) -> None:
        """Sends anything that can be pickled, its tensors (on the CPU) without pickling them."""
        head = io.BytesIO()
        packer = _Packer(head)
        packer.dump(made)
        size = packer.size + head.getbuffer().nbytes
        turn = self._sent % len(self._files)
        file, grown = self._files[turn], size > self._sizes[turn]
        if grown:
            self._sizes[turn] = -(-size // GROWTH_BYTES) * GROWTH_BYTES
            os.ftruncate(file, self._sizes[turn])
        for start, tensor in packer.tensors:
            _write(file, tensor.view(-1).view(torch.uint8).numpy().data, start)
        _write(file, head.getbuffer(), packer.size)
        message = _MESSAGE.pack(turn, size, size - packer.size)
        if grown:
            socket.send_fds(self._channel, [message], [file])
        else:
            self._channel.send(message)
        self._sent += 1


class Inbox:
    """Receives the parcels of one `Outbox`. Only for channels between processes of one program: it unpickles."""

    def __init__(self, channel: socket.socket) -> None:
        self._channel = channel
        self._memories: dict[int, Tensor] = {}

    def receive(self, take: Callable[[Tensor], Tensor]) -> Any:
        """What `send` was given.

        Args:
            take: copies a tensor out of the shared memory, which the sender may use again afterwards.

        Raises:
            EOFError: the other end is closed.
            OSError: this process has too many open files.
        """
        message, files, flags, _ = socket.recv_fds(self._channel, _MESSAGE.size, 1)
        if not message:
            raise EOFError
        turn, size, pickled = _MESSAGE.unpack(message)
        if flags & socket.MSG_CTRUNC:
            raise OSError("too many open files: a worker's batch could not be received; raise the limit with `ulimit -n`")
        for file in files:  # one, when the memory is new or has grown
            try:
                # Unlike mmap.mmap, this keeps no file open for as long as the memory is used.
                self._memories[turn] = torch.from_file(f"/proc/self/fd/{file}", shared=True, size=os.fstat(file).st_size, dtype=torch.uint8)
            finally:
                os.close(file)
        memory = self._memories[turn]
        return _Unpacker(io.BytesIO(memory[size - pickled : size].numpy().tobytes()), memory, take).load()

    def waiting(self) -> int:
        """How many parcels have arrived and not been received yet."""
        waiting_bytes = array("i", [0])
        fcntl.ioctl(self._channel, termios.FIONREAD, waiting_bytes)
        return waiting_bytes[0] // _MESSAGE.size


class _Packer(pickle.Pickler):
    """Pickles everything but the tensors, which only leave their place, dtype and shape."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, protocol=5)
        self.tensors: list[tuple[int, Tensor]] = []
        self.size = 0

    def persistent_id(self, value: Any) -> Any:
        if not isinstance(value, Tensor):
            return None
        start = -(-self.size // ALIGNMENT_BYTES) * ALIGNMENT_BYTES
        self.tensors.append((start, value.detach().contiguous()))
        self.size = start + value.numel() * value.element_size()
        return start, self.size, value.dtype, tuple(value.shape)


class _Unpacker(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, memory: Tensor, take: Callable[[Tensor], Tensor]) -> None:
        super().__init__(file)
        self._memory = memory
        self._take = take

    def persistent_load(self, pid: Any) -> Tensor:
        start, end, dtype, shape = pid
        return self._take(self._memory[start:end].view(dtype).view(shape))


def memory_file() -> int:
    """A file in memory without a name; its descriptor. Python itself lacks the call where it was built for an old C library."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("zsdata")
    descriptor = ctypes.CDLL(None, use_errno=True).memfd_create(b"zsdata", _CLOSE_ON_EXEC)
    if descriptor < 0:
        raise OSError(ctypes.get_errno(), "no memory for a batch")
    return descriptor


def _write(file: int, data: memoryview, start: int) -> None:
    left = data.cast("B") if data.nbytes else data
    while left.nbytes:  # one call writes 2 GB at most
        written = os.pwrite(file, left, start)
        left, start = left[written:], start + written
