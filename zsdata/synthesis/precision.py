"""The number format that a network computes in: named by the user, or chosen by the device; and float32 that is kept whole."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch

DTYPES = {"float32": torch.float32, "bf16": torch.bfloat16, "bfloat16": torch.bfloat16, "fp16": torch.float16, "float16": torch.float16}


def check_dtype(name: str | None) -> None:
    """Raises ValueError unless `name` is None or one of the names in DTYPES."""
    if name is not None and name not in DTYPES:
        raise ValueError(f"dtype is one of {', '.join(DTYPES)}; got {name}")


def choose_dtype(name: str | None, device: torch.device) -> torch.dtype:
    """The named format; without a name float32, and on CUDA bfloat16 where the GPU has it, else float16."""
    check_dtype(name)
    if name is not None:
        return DTYPES[name]
    if device.type != "cuda":
        return torch.float32
    with torch.cuda.device(device):
        return torch.bfloat16 if torch.cuda.is_bf16_supported(including_emulation=False) else torch.float16


@contextmanager
def without_tf32(device: torch.device) -> Iterator[None]:
    """Float32 keeps all of its digits in the matrix products and convolutions of a CUDA device, which torch may round to TF32 otherwise.

    The settings are torch's own, for the whole process, and are afterwards what they were. On other devices nothing is set.
    """
    changed: list[tuple[Callable[[Any], None], Any, Any]] = []
    for read, write, whole in _tf32_settings() if device.type == "cuda" else ():
        try:
            value = read()
        except RuntimeError:  # the user has set the newer ones, and the older disagree: torch goes by the newer
            continue
        if value != whole:
            changed.append((write, value, whole))
    try:
        for write, _, whole in changed:
            write(whole)
        yield
    finally:
        for write, value, _ in changed:
            write(value)


def _tf32_settings() -> list[tuple[Callable[[], Any], Callable[[Any], None], Any]]:
    """How each setting is read and written, and its value for whole float32; the newer ones, which torch 2.6 has not, after the older,
    which write to them: the first one to oneDNN's on the CPU too."""
    matmul, cudnn = torch.backends.cuda.matmul, torch.backends.cudnn
    onednn: Any = torch.backends.mkldnn
    newer = [matmul, cudnn.conv, cudnn.rnn, onednn.matmul] if hasattr(matmul, "fp32_precision") else []
    return [
        (torch.get_float32_matmul_precision, torch.set_float32_matmul_precision, "highest"),
        (partial(getattr, cudnn, "allow_tf32"), partial(setattr, cudnn, "allow_tf32"), False),
        *((partial(getattr, holder, "fp32_precision"), partial(setattr, holder, "fp32_precision"), "ieee") for holder in newer),
    ]
