"""The number format that a network computes in: named by the user, or chosen by the device."""

from __future__ import annotations

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
