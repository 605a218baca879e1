"""Where the time goes: seconds per stage, added up."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import ClassVar


class Meter:
    """Adds up how long each stage took; `seconds` maps stage to seconds."""

    entered: ClassVar[Callable[[str], None] | None] = None  # in a worker process: is told of every stage that begins, of all meters

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Counts the time inside the `with` block."""
        if Meter.entered is not None:
            Meter.entered(name)
        start = time.perf_counter()
        try:
            yield
        finally:
            self.add({name: time.perf_counter() - start})

    def add(self, seconds: Mapping[str, float]) -> None:
        """Adds another meter's seconds."""
        for name, value in seconds.items():
            self.seconds[name] = self.seconds.get(name, 0.0) + value
