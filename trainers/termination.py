"""SIGTERM, which a cluster sends some seconds before it takes a machine back: the run saves a checkpoint, and ends."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import torch
from accelerate import Accelerator

from trainers.ranks import on_any_rank


class Terminated(SystemExit):
    """The run was asked to end, and has saved its place. Ends the program with the status of one that the signal killed."""

    def __init__(self) -> None:
        super().__init__(128 + signal.SIGTERM)


def end(accelerator: Accelerator, saved: Path | None, output: Path) -> NoReturn:
    """Ends a training that was asked to, on all ranks; `saved` is its last checkpoint, if it has one yet."""
    if saved is not None:
        accelerator.print(f"asked to end by SIGTERM: {saved} is saved, and --resume {output} goes on from it")
    accelerator.end_training()
    raise Terminated


class Termination:
    """While it is entered, SIGTERM only leaves a note: a step is finished first. What `at_once` surrounds it ends there and then.

    Whoever sends it may send it twice, once to all processes and once through the launcher. Outside of the main thread, where Python
    lets nobody handle signals, the signal does what it did before.
    """

    def __init__(self) -> None:
        self._noted = False
        self._at_once = False
        self._before: Any = None

    def asked(self, device: torch.device) -> bool:
        """Whether any rank has got the signal; the same answer on all ranks, which all must ask."""
        return on_any_rank(self._noted, device)

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Around what takes long and has its checkpoint saved: each rank that gets the signal, or has it already, raises Terminated."""
        self._at_once = True
        try:
            if self._noted:
                raise Terminated
            yield
        finally:
            self._at_once = False

    def __enter__(self) -> Termination:
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGTERM, self._note)
        return self

    def __exit__(self, *raised: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGTERM, self._before)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._noted = True
        if self._at_once:
            self._at_once = False  # it may come twice
            raise Terminated
