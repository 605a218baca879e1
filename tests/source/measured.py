"""A process of its own that opens odd files, and says of each what came of it, how long it took and how much memory.

    python -m tests.source.measured photos|tars

It runs in an empty folder, where nothing may appear but the shard that it writes itself.
"""

from __future__ import annotations

import json
import os
import sys
import time
import zlib
from pathlib import Path

from zsdata.faults import BadPhoto
from zsdata.source.archive import read_shard
from zsdata.source.manifest import build_manifest
from zsdata.source.photo import decode_photo, decode_rgb

from .hostile_photos import hostile_photos
from .hostile_tars import PHOTO, hostile_tars

SHARD = "shard.tar"


def photo_outcome(data: bytes) -> object:
    try:
        _, height, width = decode_photo(data).shape
        return width, height
    except BadPhoto as fault:
        return fault.reason


def tar_outcome() -> object:
    keys, problems = [], []
    for key, data in read_shard(SHARD, lambda fault: problems.append(fault.reason)):
        try:
            decode_rgb(data)
            assert data.startswith(PHOTO)
            keys.append(key)
        except BadPhoto as fault:
            problems.append(fault.reason)
    try:
        manifest = build_manifest(SHARD)
        listed = [manifest.member(index).key for index in range(len(manifest))]
    except ValueError:
        listed = []
    assert [key for key in listed if key in keys] == keys
    return keys, problems


def peak_bytes() -> int:
    return memory()["VmHWM"]


def memory() -> dict[str, int]:
    lines = Path("/proc/self/status").read_text().splitlines()
    return {line.split(":")[0]: 1024 * int(line.split()[1]) for line in lines if line.startswith(("VmHWM", "VmRSS"))}


def main(what: str) -> None:
    if what == "photos":
        files = {name: (odd.data, 0) for name, odd in hostile_photos().items()}
    else:
        files = {name: (odd.data, odd.length) for name, odd in hostile_tars().items()}
    for name, (data, length) in files.items():
        if what == "tars":
            Path(SHARD).write_bytes(data)
            os.truncate(SHARD, max(length, len(data)))
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
        before, start = memory()["VmRSS"], time.perf_counter()
        outcome = photo_outcome(data) if what == "photos" else tar_outcome()
        seconds, peak = time.perf_counter() - start, peak_bytes() - before
        sys.stdout.write(json.dumps([name, zlib.crc32(data), outcome, seconds, peak]) + "\n")
        sys.stdout.flush()
    Path(SHARD).unlink(missing_ok=True)


if __name__ == "__main__":
    main(sys.argv[1])
