"""Compressed tars to plain ones: photos are read by range, which a compressed file does not allow."""

from __future__ import annotations

import io
import os
import re
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO, cast

from fsspec.compression import compr

from zsdata.faults import BadShard
from zsdata.progress import Progress
from zsdata.source.ranges import ShardFile
from zsdata.source.retry import UnreachableShard
from zsdata.source.urls import base_name, expand_urls
from zsdata.source.writing import writing

MAX_RATIO = 100  # of the plain to the compressed size; photos hardly compress, a bomb of gzip has 1,000, one of zstd 30,000
SMALL_BYTES = 1 << 26  # 64 MiB that any file may become
CHUNK_BYTES = 1 << 20

_COMPRESSIONS = ((b"\x1f\x8b", "gzip", "gzip"), (b"\x28\xb5\x2f\xfd", "zstd", "zstandard"))  # signature, name, package
_ENDINGS = re.compile(r"(\.tar)?(\.gz|\.zstd?)?$|\.tgz$|\.tzst$", re.IGNORECASE)


def decompress(
    urls: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    progress: bool | None = None,
) -> list[str]:
    """Writes NAME.tar into the folder `output` for each NAME.tar.gz, .tgz or .tar.zst; the originals stay.

    A shard appears under its name once it is whole. What is in it is not looked at: `verify` does that.

    Args:
        urls: as `expand_urls` takes them (a folder stands for its *.tar, so name compressed files or a glob).
        output: made if missing.
        overwrite: replace a shard of that name.
        progress: show a progress bar; by default where stderr is a terminal.

    Returns:
        The paths of the plain shards.

    Raises:
        BadShard: a file is damaged, cut off, grows beyond MAX_RATIO times its size, or changes while it is read.
        OSError: a file cannot be read, or a shard not written; UnreachableShard for a remote file.
        ValueError: a file is not compressed with gzip or zstd, or two would get one name.
        FileExistsError: a shard is there already, without `overwrite`.
        ImportError: zstd, and neither Python 3.14 nor the package zstandard.
    """
    sources = expand_urls(urls)
    folder = Path(output)
    targets = [folder / (_ENDINGS.sub("", base_name(url)) + ".tar") for url in sources]
    twice = next((target for number, target in enumerate(targets) if target in targets[:number]), None)
    if twice is not None:
        raise ValueError(f"two of the files would become {twice.name}; decompress them into different folders")
    there = next((target for target in targets if target.exists()), None)
    if there is not None and not overwrite:
        raise FileExistsError(f"{there} is there already; choose another folder, or allow to overwrite")
    folder.mkdir(parents=True, exist_ok=True)
    for url, target in zip(
        Progress(sources, desc="decompressing", unit="shard", disable=None if progress is None else not progress), targets, strict=True
    ):
        partial = target.with_name(f"{target.name}.{os.urandom(8).hex()}.partial")  # process numbers come again in containers
        try:
            _decompress_one(url, partial)
            os.replace(partial, target)
        finally:
            partial.unlink(missing_ok=True)
    return [os.fspath(target) for target in targets]


def _decompress_one(url: str, target: Path) -> None:
    with ShardFile(url) as file, open(target, "xb") as plain:
        start = file.read_at(0, 4)
        kind, package = next(((kind, package) for signature, kind, package in _COMPRESSIONS if start.startswith(signature)), (None, ""))
        if kind is None:
            raise ValueError(f"{file.url} is not compressed with gzip or zstd; a plain tar is used as it is")
        if kind not in compr:
            raise ImportError(f"{file.url} is compressed with zstd: pip install {package}, or unpack it with unzstd")
        limit = SMALL_BYTES + MAX_RATIO * file.size
        stream = cast(BinaryIO, compr[kind](io.BufferedReader(_FromStart(file), CHUNK_BYTES), mode="rb"))
        try:
            with stream:
                while chunk := stream.read(CHUNK_BYTES):
                    if plain.tell() + len(chunk) > limit:
                        raise BadShard(f"a bomb: grows to more than {MAX_RATIO} times its size", file.url, 0)
                    with writing(target):
                        plain.write(chunk)
                        plain.flush()
        except EOFError as error:
            raise BadShard("ends inside the compressed data; download it again", file.url, file.size) from error
        except (zlib.error, OSError) as error:
            if isinstance(error, UnreachableShard) or getattr(error, "errno", None) is not None:  # of the network or disk, not of the data
                raise
            raise BadShard(f"damaged {kind} data ({error}); download it again", file.url, 0) from error


class _FromStart(io.RawIOBase):
    """An open file as what decompressors read: from its start, a piece at a time."""

    def __init__(self, file: ShardFile) -> None:
        self._file = file
        self._position = 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        data = self._file.read_at(self._position, len(buffer))
        buffer[: len(data)] = data
        self._position += len(data)
        return len(data)
