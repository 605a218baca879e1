"""A folder of photographs to shards, bytes unchanged."""

from __future__ import annotations

import os
import re
import tarfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from zsdata.faults import BadPhoto
from zsdata.progress import Progress
from zsdata.source.archive import DEPTH_EXTENSIONS, MAX_PHOTO_BYTES, OTHER_IMAGE_EXTENSIONS, PHOTO_EXTENSIONS
from zsdata.source.depth_map import DepthMap, decode_depth
from zsdata.source.index import INDEX_ENDING
from zsdata.source.photo import probe_photo, usable_photo
from zsdata.source.writing import writing

EXTENSIONS_SHOWN = 5

_BLOCK = 512
_DEPTH_FILE = re.compile(rf"(.+)\.({'|'.join(map(re.escape, DEPTH_EXTENSIONS))})", re.IGNORECASE | re.DOTALL)
_END_OF_ARCHIVE = bytes(2 * _BLOCK)


@dataclass
class PackReport:
    """What was packed and what was not."""

    photos: int = 0
    depth_maps: int = 0  # packed with their photos
    bytes: int = 0  # of the shards
    shards: list[str] = field(default_factory=list)  # their paths, in order
    skipped: list[tuple[str, str]] = field(default_factory=list)  # path in the folder, reason
    passed_over: Counter[str] = field(default_factory=Counter)  # files that are no images by their names: how many, by extension

    @property
    def passed_over_in_words(self) -> str:
        """The most frequent of them first, as in "passed over by their names: 12 with .txt, 1 with no extension"; empty without any."""
        shown = self.passed_over.most_common(EXTENSIONS_SHOWN)
        kinds = [f"{count:,} with {extension}" for extension, count in shown]
        if len(shown) < len(self.passed_over):
            kinds.append(f"{self.passed_over.total() - sum(count for _, count in shown):,} more")
        return f"passed over by their names: {', '.join(kinds)}" if kinds else ""


def pack(
    folder: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    photos_per_shard: int = 1000,
    shortest_side_px: int = 1,
    overwrite: bool = False,
    progress: bool | None = None,
) -> PackReport:
    """Packs the photos in `folder` and its subfolders, sorted by path, into OUTPUT/NAME-000000.tar and so on; NAME is the folder's.

    Every photo is decoded once: what zsdata cannot use is left out and reported. Bytes are copied as they are, originals stay untouched.
    A photo's key is its path without the extension, dots in its base name written as "_"; a key that is taken gets "_2", "_3" appended.
    Its extension is that of its content. A depth map NAME.depth.npy or NAME.depth.png goes with the photo NAME.*, as KEY.depth.npy or .png,
    if a stream can use it (see `zsdata.source.depth_map`); of both the first one. The same folder gives the same bytes. Hidden files are
    passed over, and so are files that have no image's extension, which are counted; symbolic links are read through.

    Args:
        shortest_side_px: a photo with a shorter side is left out.
        overwrite: replace shards that `pack` made before under the same name.
        progress: show a progress bar; by default where stderr is a terminal.

    Raises:
        NotADirectoryError: `folder` is no folder.
        FileExistsError: `output` already holds tars.
        ValueError: there is no photo to pack, `output` is `folder`, or `photos_per_shard` is not positive.
    """
    source, target = Path(folder), Path(output)
    if not source.is_dir():
        raise NotADirectoryError(f"{source} is not a folder; pack takes a folder of photographs")
    if photos_per_shard < 1:
        raise ValueError(f"photos_per_shard is at least 1, got {photos_per_shard}")
    name = re.sub(r"[^A-Za-z0-9_-]", "_", source.resolve().name) or "photos"
    _check_output(source, target, name, overwrite)
    report, keys = PackReport(), set()
    files = sorted(_files(source, target, report.passed_over), key=os.fsencode)
    photos = [path for path in files if not _DEPTH_FILE.fullmatch(path)]
    depths = _DepthFiles(source, [path for path in files if _DEPTH_FILE.fullmatch(path)])
    target.mkdir(parents=True, exist_ok=True)
    with _Shards(target, name, photos_per_shard) as shards:
        for path in Progress(photos, desc="packing", unit="photo", disable=None if progress is None else not progress):
            try:
                data, extension = _read_photo(source / path, shortest_side_px)
            except BadPhoto as fault:
                report.skipped.append((path, fault.reason))
                continue
            key = _free_key(path, keys)
            members = {f"{key}.{extension}": data}
            try:
                depth = depths.of(path, data)
                if depth is not None:
                    members[f"{key}.depth.{depth[1]}"] = depth[0]
                    report.depth_maps += 1
            except BadPhoto as fault:
                report.skipped.append((fault.key or path, fault.reason))
            shards.add(members)
            report.photos += 1
        report.skipped += depths.left()
        if not report.photos:
            reasons = [f"{path}: {reason}" for path, reason in report.skipped[:3]]
            if report.passed_over:
                reasons.append(report.passed_over_in_words)
            raise ValueError("; ".join([f"no photo to pack in {source}: a photo is a JPEG, PNG or WebP file", *reasons]))
        report.shards = [os.fspath(path) for path in shards.publish()]
    report.bytes = sum(os.path.getsize(path) for path in report.shards)
    return report


class _DepthFiles:
    """The depth maps in a folder, by the photo that each is of: NAME.depth.npy or NAME.depth.png of NAME.jpg, the case aside."""

    def __init__(self, folder: Path, paths: Sequence[str]) -> None:
        self._folder = folder
        self._of: dict[str, dict[str, str]] = {}  # NAME: extension: path
        for path in paths:
            name, extension = _DEPTH_FILE.fullmatch(path).groups()  # type: ignore[union-attr]
            self._of.setdefault(name, {}).setdefault(extension.lower(), path)
        self._left = dict.fromkeys(paths, "a depth map whose photo is not packed")

    def of(self, photo_path: str, photo: bytes) -> tuple[bytes, str] | None:
        """Bytes and extension of a photo's depth map; BadPhoto, with the map's path, if a stream cannot use it."""
        found = self._of.get(photo_path.rpartition(".")[0], {})
        path = next((found[extension] for extension in DEPTH_EXTENSIONS if extension in found), None)
        if path is None:
            return None
        self._left |= dict.fromkeys(found.values(), f"a second depth map: {path} is the one that counts")
        self._left.pop(path, None)
        try:
            data = _read_file(self._folder / path)
            decode_depth(data, probe_photo(photo))
            return data, DepthMap.parse(data).extension
        except BadPhoto as fault:
            raise BadPhoto(fault.reason, path) from fault

    def left(self) -> Iterable[tuple[str, str]]:
        """Path and reason of those that no photo has taken."""
        return self._left.items()


class _Shards:
    """The shards as they are written: under other names until all are there, removed if that never happens."""

    def __init__(self, target: Path, name: str, photos_per_shard: int) -> None:
        self._target = target
        self._name = name
        self._photos_per_shard = photos_per_shard
        self._photos = 0
        self._partial: list[Path] = []
        self._file: BinaryIO | None = None

    def add(self, members: Mapping[str, bytes]) -> None:
        """The members of one photo, by their names."""
        if self._file is None:
            path = self._target / f"{self._name}-{len(self._partial):06d}.tar.partial"
            path.unlink(missing_ok=True)  # left by a run that was killed
            self._file = open(path, "xb")
            self._partial.append(path)
        with writing(self._partial[-1]):
            for name, data in members.items():
                self._file.write(_header(name, len(data)))
                self._file.write(data)
                self._file.write(bytes(-len(data) % _BLOCK))
        self._photos += 1
        if self._photos % self._photos_per_shard == 0:
            self._finish()

    def publish(self) -> list[Path]:
        """Gives all shards their names, and removes what an earlier, longer pack left behind them."""
        self._finish()
        shards = [path.with_suffix("") for path in self._partial]
        for path, shard in zip(self._partial, shards, strict=True):
            os.replace(path, shard)
        for old in _shards_of(self._target, self._name):  # what was indexed is gone
            old.with_name(old.name + INDEX_ENDING).unlink(missing_ok=True)
        for old in set(_shards_of(self._target, self._name)) - set(shards):
            old.unlink()
        return shards

    def _finish(self) -> None:
        if self._file is not None:
            with writing(self._partial[-1]):
                self._file.write(_END_OF_ARCHIVE)
                self._file.close()
            self._file = None

    def __enter__(self) -> _Shards:
        return self

    def __exit__(self, *raised: object) -> None:
        if self._file is not None:
            with suppress(OSError):  # what is still to be written, to a full disk
                self._file.close()
        for path in self._partial:
            path.unlink(missing_ok=True)


def _check_output(source: Path, target: Path, name: str, overwrite: bool) -> None:
    if target.exists() and not target.is_dir():
        raise NotADirectoryError(f"{target} is not a folder; pack writes its shards into a folder")
    if os.path.realpath(source) == os.path.realpath(target):
        raise ValueError(f"{target} is the folder of photos itself; choose another one for the shards, such as {target / 'shards'}")
    present = sorted(target.glob("*.tar")) if target.exists() else []
    if present and not overwrite:
        raise FileExistsError(f"{target} already holds {present[0].name}; choose another folder, or allow to overwrite")
    others = sorted(set(present) - set(_shards_of(target, name)))
    if others:
        raise FileExistsError(f"{target} holds {others[0].name}, which is no shard of {name!r}; choose another folder")


def _shards_of(target: Path, name: str) -> list[Path]:
    return [path for path in target.glob("*.tar") if re.fullmatch(re.escape(name) + r"-[0-9]{6}\.tar", path.name)]


def _files(source: Path, output: Path, passed_over: Counter[str], ancestors: tuple[str, ...] = (), below: str = "") -> Iterator[str]:
    """Paths of the images and depth maps below `source`, relative to it; through links, but not round in circles, and not into `output`.

    Counts the other files in `passed_over`, by extension.
    """
    real = os.path.realpath(source / below)
    if real in ancestors or real == os.path.realpath(output):
        return
    with os.scandir(source / below) as entries:
        for entry in entries:
            if entry.name.startswith(".") or entry.name == "__MACOSX":
                continue
            if entry.is_dir():
                yield from _files(source, output, passed_over, (*ancestors, real), below + entry.name + "/")
                continue
            _, dot, extension = entry.name.lower().rpartition(".")
            if extension in PHOTO_EXTENSIONS | OTHER_IMAGE_EXTENSIONS or _DEPTH_FILE.fullmatch(entry.name):
                yield below + entry.name
            else:
                passed_over[dot + extension if dot else "no extension"] += 1


def _read_photo(path: Path, shortest_side_px: int) -> tuple[bytes, str]:
    """A photo's bytes and the extension that fits them; BadPhoto if zsdata cannot use it."""
    data = _read_file(path)
    return data, usable_photo(data, shortest_side_px).extension


def _read_file(path: Path) -> bytes:
    try:
        if not path.is_file():
            raise BadPhoto("not a file, or a link to nothing")
        size = path.stat().st_size
        if size > MAX_PHOTO_BYTES:
            raise BadPhoto(f"too large: {size:,} bytes, at most {MAX_PHOTO_BYTES:,}")
        return path.read_bytes()
    except OSError as error:
        raise BadPhoto(f"cannot be read: {error.strerror}") from error


def _free_key(path: str, keys: set[str]) -> str:
    folder, slash, base = path.rpartition("/")
    stem = base.rpartition(".")[0].replace(".", "_")
    key, number = folder + slash + stem, 1
    while key in keys:
        number += 1
        key = f"{folder}{slash}{stem}_{number}"
    keys.add(key)
    return key


def _header(name: str, size: int) -> bytes:
    """Nothing in it but the name and the size, so that the same photos give the same shards."""
    member = tarfile.TarInfo(name)
    member.size = size
    member.mode = 0o644
    return member.tobuf(tarfile.GNU_FORMAT, "utf-8", "surrogateescape")
