"""Which of how many processes this is."""

from __future__ import annotations

import os

from torch import distributed


def launched_as() -> tuple[int, int]:
    """(rank, world_size) of torch.distributed where it runs, else what a launcher says in the environment, else (0, 1)."""
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    rank, world_size = os.environ.get("RANK", ""), os.environ.get("WORLD_SIZE", "")
    return (int(rank), int(world_size)) if rank.isdecimal() and world_size.isdecimal() else (0, 1)
