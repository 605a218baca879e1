"""Several ranks: all that were asked for, and what they have in common.

On the CPU `accelerate launch --num_processes N` starts a single process, unless told to use MPI.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

import psutil
import torch
import torch.distributed as distributed
from accelerate.commands.config.config_args import default_config_file, load_config_from_file
from accelerate.commands.launch import launch_command_parser
from torch import Tensor

RANKED_BY = ("WORLD_SIZE", "PMI_SIZE", "OMPI_COMM_WORLD_SIZE", "MV2_COMM_WORLD_SIZE")  # torchrun, Intel MPI, Open MPI, MVAPICH
_SET_PARENT_DEATH_SIGNAL = 1  # prctl


def end_with_launcher() -> None:
    """Has this process get SIGTERM when the accelerate launch that started it alone ends.

    That one ends by SIGTERM without handing it on, and this one would be left behind, with the GPU. Launchers of several hand it on.
    """
    if any(name in os.environ for name in RANKED_BY):
        return
    launcher = os.getppid()
    if _launched_with() is None:
        return
    ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGTERM)
    if os.getppid() != launcher:  # it has just ended
        signal.raise_signal(signal.SIGTERM)


def start_missing_ranks() -> None:
    """Starts this program once per rank under torchrun where `accelerate launch --cpu` was asked for several processes and started one.

    Then it does not return. Accelerate leaves two traces of such a call: the address of a rendezvous that nobody else will come to, and
    its own command line in the parent process.

    Raises:
        ValueError: several processes were asked for, but how many cannot be found out.
    """
    on_cpu = os.environ.get("ACCELERATE_USE_CPU", "").lower() in ("1", "true", "yes")
    if not on_cpu or "MASTER_ADDR" not in os.environ or any(name in os.environ for name in RANKED_BY):
        return
    count = _processes_asked_for()
    if count is None:
        raise ValueError(
            "several processes were asked for, but accelerate launch starts one on the CPU; "
            f"use torchrun --standalone --nproc_per_node N {sys.argv[0]} ..."
        )
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", str(count), *sys.argv]
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, command)


def _processes_asked_for() -> int | None:
    """`--num_processes` of the accelerate launch that started this process, from its command line or its configuration file."""
    words = _launched_with()
    if words is None:
        return None
    launched, _ = launch_command_parser().parse_known_args(words)
    if launched.num_processes is not None:
        return launched.num_processes
    if launched.config_file is not None or os.path.isfile(default_config_file):
        return getattr(load_config_from_file(launched.config_file), "num_processes", None)
    return None


def _launched_with() -> list[str] | None:
    """The arguments of the accelerate launch that started this process; None if something else did, or what it was is hidden."""
    try:
        parent = psutil.Process().parent()
        words = parent.cmdline() if parent is not None else []
    except psutil.Error:
        return None
    for i, word in enumerate(words):
        before = words[i - 1] if i else ""
        if os.path.basename(word) in ("accelerate-launch", "accelerate.commands.launch") or (word == "launch" and "accelerate" in before):
            return words[i + 1 :]
    return None


def mean_over_ranks(values: Tensor) -> Tensor:
    """The mean of `values` over all ranks, the same on each; `values` themselves where there is only one."""
    if not (distributed.is_available() and distributed.is_initialized()):
        return values
    total = values.clone()
    distributed.all_reduce(total)
    return total / distributed.get_world_size()


def on_any_rank(value: bool, device: torch.device) -> bool:
    """Whether `value` is true on one rank at least; every rank must ask. `device` is one that the ranks can exchange tensors of."""
    if not (distributed.is_available() and distributed.is_initialized()):
        return value
    values = torch.tensor(float(value), device=device)
    distributed.all_reduce(values, distributed.ReduceOp.MAX)
    return bool(values.item())
