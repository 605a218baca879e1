"""Builds the backend, and says how a process starts with it."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import torch

SOURCE = Path(__file__).with_name("backend.cpp")


def environment(folder: Path) -> dict[str, str]:
    """Of a process that can pretend to have a GPU; the backend is built into `folder`.

    Raises:
        RuntimeError: it cannot be built here, with the reason.
    """
    compiler = shutil.which("g++")
    if torch.version.cuda is not None or torch.version.hip is not None:
        raise RuntimeError("torch has a real backend for GPUs")
    if compiler is None:
        raise RuntimeError("there is no g++")
    library, here = folder / "pretended_gpu.so", Path(torch.__file__).parent
    command = [compiler, "-std=c++20", "-shared", "-fPIC", f"-D_GLIBCXX_USE_CXX11_ABI={int(torch._C._GLIBCXX_USE_CXX11_ABI)}"]
    command += [f"-I{here}/include", f"-L{here}/lib", str(SOURCE), "-lc10", "-ltorch_cpu", f"-Wl,-rpath,{here}/lib", "-o", str(library)]
    built = subprocess.run(command, capture_output=True, text=True)
    if built.returncode != 0:
        raise RuntimeError(f"the backend cannot be compiled: {built.stderr}")
    return {**os.environ, "LD_PRELOAD": str(library), "OMP_NUM_THREADS": "1"}  # tensors are too small to share
