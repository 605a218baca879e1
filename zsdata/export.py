"""Export: pairs of a stream written to disk, so that a run which is killed goes on where it stopped."""

from __future__ import annotations

import errno
import fcntl
import json
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain, islice, repeat
from pathlib import Path
from typing import Any

import zsdata
from zsdata.exported import (
    FILE_LIST,
    FOLDERS,
    ExportedPair,
    encode_pair,
    file_list_line,
    meta_file,
    pair_name,
    pair_of_line,
    place_name,
    read_exported,
)
from zsdata.loader import StereoLoader
from zsdata.progress import Progress
from zsdata.sample import StereoBatch
from zsdata.source.writing import writing
from zsdata.stream import ZeroStereoStream

RECORD = "export.json"  # what the export was made with


@dataclass(frozen=True)
class ExportReport:
    """What lies in the folder after an export."""

    pairs: int
    already_there: int  # of these, made by an earlier run
    bytes: int  # of all their files
    replaced: Counter[str]  # photos that could not be used, by reason; a spare photo stands in for each


def export_pairs(
    stream: ZeroStereoStream,
    folder: str | os.PathLike[str],
    *,
    pairs: int | None = None,
    epoch: int = 0,
    workers: int = 0,
    settings: Mapping[str, Any] | None = None,
) -> ExportReport:
    """Writes pairs of a stream, clean, in the layout of the published data set (see `zsdata.exported`).

    A run that was stopped at any moment and is started again with the same arguments goes on where it stopped; the outcome is that of an
    unbroken run, byte for byte. The file list names whole pairs only, each once, at any time. Files that are not of the export stay as they
    are.

    Args:
        stream: where the pairs come from; its own place does not move. Its augmentation is not exported, so give it none.
        folder: made if missing.
        pairs: how many, over the end of the epoch if need be; None is one epoch.
        epoch: of the first pair.
        workers: processes that prepare pairs; changes speed, never a byte.
        settings: plain JSON that tells a later run in words how the stream was made; recorded and compared in addition to its digests.

    Raises:
        ValueError: the folder holds an export made with other arguments, or one that was changed by hand.
        FileExistsError: the folder holds something else where the export would write.
        BlockingIOError: another process is exporting there.
    """
    folder = Path(folder)
    count = stream.epoch_size(epoch) if pairs is None else pairs
    state = stream.state_dict()
    record = {
        "zsdata": zsdata.__version__,
        **(settings or {}),
        **{name: state[name] for name in ("seed", "manifest", "configuration", "models") if state[name] != {}},
        "epoch": epoch,
        "pairs": count,
    }
    _take_folder(folder, record)
    places = list(islice(_places(stream, epoch), count))
    with _FileList(folder) as file_list:
        there = file_list.take_up(places)
        with (
            stream.loader(batch_size=1, num_workers=workers, rank=0, world_size=1) as loader,
            Progress(total=count, initial=there, desc="exporting", unit="pair", disable=None) as bar,
        ):
            for pair in _pairs(loader, places[there:]):
                for path, content in encode_pair(pair).items():
                    write_whole(folder / path, content)
                file_list.add(file_list_line(pair_name(pair.meta)))
                bar.update()
    return _report(folder, there)


def write_whole(path: Path, content: bytes) -> None:
    """A file under its name has all of its content, or is not there."""
    partial = path.with_name(path.name + ".partial")
    try:
        with writing(path):
            partial.write_bytes(content)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _take_folder(folder: Path, record: dict[str, Any]) -> None:
    """Makes the folder ready for the export that `record` describes; refuses any other content."""
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(f"{folder} is not a folder; an export is written into one")
    if (folder / RECORD).exists():
        _compare(folder, json.loads(json.dumps(record)))
    else:
        for name in (FILE_LIST, *FOLDERS):
            if (folder / name).exists():
                raise FileExistsError(f"{folder} holds {name}, which no export made; choose another folder")
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / RECORD, (json.dumps(record, indent=1) + "\n").encode())
    for name in FOLDERS:
        (folder / name).mkdir(exist_ok=True)


def _compare(folder: Path, now: dict[str, Any]) -> None:
    try:
        there = json.loads((folder / RECORD).read_text())
    except ValueError as error:
        raise ValueError(f"{folder / RECORD} is no record of an export ({error}); choose another folder") from error
    if not isinstance(there, dict):
        raise ValueError(f"{folder / RECORD} is no record of an export; choose another folder")
    differing = [name for name in {**there, **now} if there.get(name) != now.get(name)]
    in_words = {name: f"{name} was {json.dumps(there.get(name))} and is {json.dumps(now.get(name))}" for name in differing}
    if "manifest" in in_words:
        in_words["manifest"] = "the photos, or their order, are others"
    if "configuration" in in_words:
        in_words["configuration"] = "an option of the stream is another (size, depth, inpaint, disparity, view, augmentation, ...)"
        if in_words.keys() - {"configuration", "manifest", "models", "seed", "epoch", "pairs", "zsdata"}:
            del in_words["configuration"]  # named already
    if "models" in in_words:
        in_words["models"] += ' (a model that has moved on at the Hub can be named as it was, "owner/name@commit")'
    if in_words:
        raise ValueError(f"{folder} holds an export made with other arguments: {'; '.join(in_words.values())}. Choose another folder.")


def _places(stream: ZeroStereoStream, epoch: int) -> Iterator[tuple[int, int]]:
    """(epoch, index) of all samples from an epoch on."""
    while True:
        yield from ((epoch, index) for index in range(stream.epoch_size(epoch)))
        epoch += 1


def _pairs(loader: StereoLoader, places: list[tuple[int, int]]) -> Iterator[StereoBatch]:
    """The single pairs of these places, which follow each other."""
    if places:
        epoch, index = places[0]
        loader.load_state_dict({**loader.state_dict(), "epoch": epoch, "samples": index})
        batches = chain.from_iterable(repeat(loader))  # epoch after epoch
        yield from (batch[0] for batch in islice(batches, len(places)))


class _FileList:
    """The file list while it grows; it belongs to one process at a time."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file = open(folder / FILE_LIST, "a+b", buffering=0)
        try:
            fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # ends with the process; workers do not inherit it
        except OSError as error:
            if error.errno not in (errno.EACCES, errno.EAGAIN):  # a file system without locks
                return
            self._file.close()
            raise BlockingIOError(f"another process is exporting to {folder}; wait for it, or choose another folder") from error

    def take_up(self, places: list[tuple[int, int]]) -> int:
        """How many pairs are there, whole and in order; lines after them are cut off.

        The kernel writes a line whole or not at all and a pair's files before it, but after a power cut or a full disk that may not hold.
        """
        self._file.seek(0)
        lines = self._file.read().splitlines(keepends=True)
        there = length = 0
        for line, (epoch, index) in zip(lines, places, strict=False):
            if not line.endswith(b"\n"):
                break
            text = line[:-1].decode(errors="replace")
            pair = pair_of_line(self._folder, text, there + 1)
            if not pair.left.stem.startswith(place_name(epoch, index)) or text != file_list_line(pair.left.stem):
                raise ValueError(
                    f"{self._folder / FILE_LIST}, line {there + 1}: expected sample {index} of epoch {epoch}, got {text!r}; "
                    "the list was changed by hand. Restore it, or choose another folder."
                )
            if not _is_whole(pair):
                break
            there, length = there + 1, length + len(line)
        self._file.truncate(length)
        return there

    def add(self, line: str) -> None:
        content = line.encode() + b"\n"
        length = self._file.seek(0, os.SEEK_END)
        if self._file.write(content) != len(content):
            self._file.truncate(length)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._folder / FILE_LIST))

    def __enter__(self) -> _FileList:
        return self

    def __exit__(self, *raised: object) -> None:
        self._file.close()


def _is_whole(pair: ExportedPair) -> bool:
    try:
        return all(os.path.getsize(path) for path in (*pair, meta_file(pair)))
    except FileNotFoundError:
        return False


def _report(folder: Path, there: int) -> ExportReport:
    pairs = read_exported(folder)
    replaced: Counter[str] = Counter()
    size = 0
    for pair in pairs:
        size += sum(os.path.getsize(path) for path in (*pair, meta_file(pair)))
        replaced.update(reason.split(":")[0] for *_, reason in json.loads(meta_file(pair).read_text())["replaced"])
    return ExportReport(len(pairs), there, size, replaced)
