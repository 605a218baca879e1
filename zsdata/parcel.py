"""A parcel: what one process made, handed to another in a single piece of memory that has no name.

Nothing stands in /dev/shm: its size does not matter, and nothing is left behind however a process ends.
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
from typing import Any

import torch
from torch import Tensor

ALIGNMENT_BYTES = 64  # a cache line; every dtype may begin there
_MESSAGE = struct.Struct("<QQ")  # bytes of the whole parcel, and of the pickle at its end
_CLOSE_ON_EXEC = 1


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
    def __init__(self, file: io.BytesIO, memory: Tensor) -> None:
        super().__init__(file)
        self._memory = memory

    def persistent_load(self, pid: Any) -> Tensor:
        start, end, dtype, shape = pid
        return self._memory[start:end].view(dtype).view(shape)


def send(channel: socket.socket, made: Any) -> None:
    """Sends anything that can be pickled, its tensors (on the CPU) without pickling them, over a SOCK_SEQPACKET socket.

    The message arrives whole or not at all, whatever happens to the sender.
    """
    file = io.BytesIO()
    packer = _Packer(file)
    packer.dump(made)
    memory = memory_file()
    try:
        for start, tensor in packer.tensors:
            _write(memory, tensor.view(-1).view(torch.uint8).numpy(), start)
        _write(memory, file.getbuffer(), packer.size)
        pickled = file.getbuffer().nbytes
        socket.send_fds(channel, [_MESSAGE.pack(packer.size + pickled, pickled)], [memory])
    finally:
        os.close(memory)


def receive(channel: socket.socket) -> Any:
    """What `send` was given. Only for channels between processes of one program: it unpickles.

    The tensors lie in the parcel's memory, which is freed with the last of them.

    Raises:
        EOFError: the other end is closed.
        OSError: this process has too many open files.
    """
    message, files, flags, _ = socket.recv_fds(channel, _MESSAGE.size, 1)
    if not message:
        raise EOFError
    if not files or flags & socket.MSG_CTRUNC:
        raise OSError("too many open files: a worker's batch could not be received; raise the limit with `ulimit -n`")
    size, pickled = _MESSAGE.unpack(message)
    try:
        # Unlike mmap.mmap, this keeps no file open for as long as the memory is used.
        memory = torch.from_file(f"/proc/self/fd/{files[0]}", shared=True, size=size, dtype=torch.uint8)
    finally:
        os.close(files[0])
    return _Unpacker(io.BytesIO(memory[size - pickled :].numpy().tobytes()), memory).load()


def waiting(channel: socket.socket) -> int:
    """How many parcels have arrived and not been received yet."""
    waiting_bytes = array("i", [0])
    fcntl.ioctl(channel, termios.FIONREAD, waiting_bytes)
    return waiting_bytes[0] // _MESSAGE.size


def memory_file() -> int:
    """A file in memory without a name; its descriptor. Python itself lacks the call where it was built for an old C library."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("zsdata")
    descriptor = ctypes.CDLL(None, use_errno=True).memfd_create(b"zsdata", _CLOSE_ON_EXEC)
    if descriptor < 0:
        raise OSError(ctypes.get_errno(), "no memory for a batch")
    return descriptor


def _write(file: int, data: Any, start: int) -> None:
    left = memoryview(data).cast("B") if len(data) else memoryview(b"")
    while left.nbytes:  # one call writes 2 GB at most
        written = os.pwrite(file, left, start)
        left, start = left[written:], start + written
