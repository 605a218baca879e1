"""The list of refused photos: one line of JSON each, appended by any number of processes."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from typing import Any

from zsdata.source.writing import writing


class RejectedFile:
    """Writes source, shard, key, reason, epoch and index of every photo that was refused.

    Each line is one appending write, so that the ranks of a machine may share a file (network file systems may mix lines up). Samples that
    are made again after a resume are listed again.

    Raises:
        OSError: at once, for a file that cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = os.fspath(path)
        self._append(b"")

    def add(self, samples: Sequence[Mapping[str, Any]]) -> None:
        """Lists the photos that samples stand in for; `samples` are the `meta` of a batch."""
        for meta in samples:
            for source, shard, key, reason in meta["replaced"]:
                line = {"source": source, "shard": shard, "key": key, "reason": reason, "epoch": meta["epoch"], "index": meta["index"]}
                self._append((json.dumps(line) + "\n").encode())

    def _append(self, line: bytes) -> None:
        file = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o666)
        try:
            with writing(self._path):
                os.write(file, line)
        finally:
            os.close(file)
