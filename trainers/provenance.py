"""What a checkpoint was made from and with: the stream's models, and the versions of the code."""

from __future__ import annotations

import platform
from importlib.metadata import version
from typing import Any

import torch

from zsdata import ZeroStereoStream

PACKAGES = ("zsdata", "accelerate", "numpy")


def provenance(stream: ZeroStereoStream, arguments: dict[str, Any]) -> dict[str, Any]:
    """Plain JSON for a checkpoint.

    Args:
        stream: asked itself, where it can tell.
        arguments: the run's options by name; those that name models stand for the stream where it cannot.
    """
    tell = getattr(stream, "provenance", None)
    made_by = tell() if tell is not None else {name: arguments.get(name) for name in ("depth", "inpaint")}
    return {
        "stream": made_by,
        "versions": {
            "python": platform.python_version(),
            "torch": torch.__version__,  # its metadata does not say for which CUDA it was built
            **{name: version(name) for name in PACKAGES},
        },
        "device": torch.cuda.get_device_name() if torch.cuda.is_available() else platform.processor() or platform.machine(),
    }
