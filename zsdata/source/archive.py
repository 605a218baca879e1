"""The photos of one shard, in order."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator
from typing import NamedTuple

from zsdata.faults import BadShard
from zsdata.source.ranges import ShardFile, ends_inside
from zsdata.source.tar import TarMember, find_header, walk_tar

PHOTO_EXTENSIONS = frozenset({"jpg", "jpeg", "png", "webp"})
OTHER_IMAGE_EXTENSIONS = frozenset(  # of files that a user may take for photos of the source; they are counted, not passed over
    {
        "gif",
        "bmp",
        "tif",
        "tiff",
        "heic",
        "heif",
        "avif",
        "jfif",
        "jpe",
        "jp2",
        "jxl",
        "ppm",
        "pgm",
        "tga",
        "psd",
        "dng",
        "cr2",
        "cr3",
        "nef",
        "arw",
        "raf",
        "orf",
        "rw2",
        "pef",
        "srw",
        "raw",
        "mpo",
    }
)
DEPTH_EXTENSIONS = ("depth.npy", "depth.png")  # of a photo's depth map; where both are there, the first one counts
_DIGIT_OR_SPACE = re.compile(r"[\d\s]")
MAX_PHOTO_BYTES = 1 << 27  # 128 MiB; a 60-megapixel photo has 10 to 120 MB


class PhotoMember(NamedTuple):
    """A photo's bytes in its shard; `key` is its name up to the first dot of the base name."""

    key: str
    offset: int
    size: int


class DepthMember(NamedTuple):
    """A depth map's bytes in its shard; `key` is that of its photo."""

    key: str
    extension: str  # one of DEPTH_EXTENSIONS
    offset: int
    size: int

    def counts_before(self, other: DepthMember | None) -> bool:
        """Whether this one is used, of two of one photo."""
        return other is None or DEPTH_EXTENSIONS.index(self.extension) < DEPTH_EXTENSIONS.index(other.extension)


class Problem(NamedTuple):
    """What is not there to be used: a damage of the shard (`key` is None) or a member that cannot be taken as a photo."""

    shard: str
    key: str | None
    offset: int
    reason: str

    def __str__(self) -> str:
        where = f"at byte {self.offset:,}" if self.key is None else f'"{self.key}"'
        return f"{self.shard} {where}: {self.reason}"


def split_name(name: str) -> tuple[str, str] | None:
    """A member's key and lower-case extension by the rule of webdataset: they part at the first dot of the base name.

    "a.b/KEY.depth.PNG" has the key "a.b/KEY" and the extension "depth.png". None without a dot, and for members that belong to no
    sample: hidden files (also the "._NAME" of macOS) and what lies in "__MACOSX".
    """
    folder, slash, base = name.rpartition("/")
    stem, dot, extension = base.partition(".")
    if not stem or not dot or "__MACOSX" in folder.split("/"):
        return None
    return folder + slash + stem, extension.lower()


def photo_members(
    file: ShardFile,
    on_problem: Callable[[Problem], None],
    *,
    on_depth: Callable[[DepthMember], None] | None = None,
    strict: bool = False,
) -> Iterator[PhotoMember]:
    """The photos of an open shard: regular members with the extension jpg, jpeg, png or webp.

    Args:
        on_problem: gets the damages, each member that is meant as a photo but is none (the second of a key, a link, another format, a
            name with a dot that makes it a part of another sample), and each sample without a photo. Where `on_depth` is given, likewise
            of depth maps.
        on_depth: gets each depth map (KEY.depth.npy, KEY.depth.png) as it comes, before or after its photo or without one.
        strict: damage raises instead.

    Raises:
        BadShard: damage, when `strict`.
    """

    def on_damage(fault: BadShard) -> None:
        on_problem(Problem(fault.shard, None, fault.offset, fault.reason))

    keys: set[str] = set()
    refused: set[str] = set()
    beside: dict[str, dict[str, int]] = {}  # what a sample has but its photo: by extension, where the first of it lies
    last: PhotoMember | None = None
    for member in walk_tar(file, None if strict else on_damage):
        last = None
        named = split_name(member.name)
        if named is None or member.kind == "folder":
            continue
        key, extension = named
        if extension in PHOTO_EXTENSIONS:
            if member.kind != "file":
                reason = f"not a regular file: {member.kind}"
            elif key in keys:
                reason = "duplicate key"
            elif member.size > MAX_PHOTO_BYTES:
                reason = f"too large: {member.size:,} bytes, at most {MAX_PHOTO_BYTES:,}"
            else:
                keys.add(key)
                last = PhotoMember(key, member.offset, member.size)
                yield last
                continue
        elif extension in OTHER_IMAGE_EXTENSIONS:
            reason = f"not a JPEG, PNG or WebP: .{extension}"
        else:
            extensions = beside.setdefault(key, {})
            if on_depth is not None and extension in DEPTH_EXTENSIONS:
                fault = _depth_fault(member, seen=extension in extensions)
                if fault is None:
                    on_depth(DepthMember(key, extension, member.offset, member.size))
                else:
                    on_problem(Problem(file.url, key, member.offset, fault))
            extensions.setdefault(extension, member.offset)
            continue
        refused.add(key)
        on_problem(Problem(file.url, key, member.offset, reason))
    if last is not None and _ends_in_zeros(file, last):
        end = last.offset + last.size
        damage = BadShard(f'zeros from inside "{last.key}" to the end: more may be missing; download it again', file.url, end)
        if strict:
            raise damage
        on_damage(damage)
    for problem in _without_photo(file.url, keys, refused, beside):
        on_problem(problem)


def _depth_fault(member: TarMember, seen: bool) -> str | None:
    """Why a member with a depth map's name is not taken; `seen`: the photo has one of that name already."""
    if member.kind != "file":
        return f"depth map not a regular file: {member.kind}"
    if seen:
        return "duplicate depth map"
    if member.size > MAX_PHOTO_BYTES:
        return f"depth map too large: {member.size:,} bytes, at most {MAX_PHOTO_BYTES:,}"
    return None


def _ends_in_zeros(file: ShardFile, photo: PhotoMember) -> bool:
    """No JPEG, PNG or WebP does."""
    return photo.size >= 64 and not file.read_at(photo.offset + photo.size - 64, 64).strip(b"\0")


def _without_photo(url: str, keys: set[str], refused: set[str], beside: dict[str, dict[str, int]]) -> Iterator[Problem]:
    """The samples whose photo is missing: they have a depth map, or an annotation as the photos of this shard have it; and each photo that
    belongs to a sample of other photos only because its name has a dot ("2023-05-01 12.30.11.jpg")."""
    samples = Counter(extension for extensions in beside.values() for extension in extensions)
    usual = {extension for key in keys & beside.keys() for extension in beside[key]} | set(DEPTH_EXTENSIONS)
    for key, extensions in beside.items():
        dotted = [extension for extension in extensions if extension.rpartition(".")[2] in PHOTO_EXTENSIONS]
        if key in keys:
            for extension in dotted:
                if samples[extension] == 1 and _DIGIT_OR_SPACE.search(extension):  # else an annotation, such as .mask.png
                    reason = f"no photo of its own: the extension begins at the first dot of the name, .{extension}; rename it if it is one"
                    yield Problem(url, key, extensions[extension], reason)
        elif key not in refused:
            dotted = [extension for extension in dotted if extension not in usual]
            for extension in dotted:
                reason = f"no photo: the extension begins at the first dot of the name, .{extension}; rename it"
                yield Problem(url, key, extensions[extension], reason)
            if not dotted and not usual.isdisjoint(extensions):
                offset = next(iter(extensions.values()))
                yield Problem(url, key, offset, f"no photo: only {', '.join('.' + extension for extension in extensions)}")


def read_shard(url: str, on_damage: Callable[[BadShard], None] | None = None) -> Iterator[tuple[str, bytes]]:
    """The photos of one uncompressed tar, in order, as they are stored.

    Args:
        url: a path or a url that fsspec opens.
        on_damage: gets what is damaged or cannot be taken (a duplicate key, another image format), and the reading goes on where that is
            safe. No part of a photo is ever yielded. Without it, damage raises, and of two photos with one key the first is yielded.

    Yields:
        key, bytes of a JPEG, PNG or WebP file (not yet looked at: `decode_photo` says whether they are one).

    Raises:
        BadShard: the tar is damaged, and there is no `on_damage`.
    """

    def report(problem: Problem) -> None:
        if on_damage is not None:
            of_key = "" if problem.key is None else f' ("{problem.key}")'
            on_damage(BadShard(problem.reason + of_key, problem.shard, problem.offset))

    with ShardFile(url) as file:
        for key, offset, size in photo_members(file, report, strict=on_damage is None):
            data = file.read_at(offset, size)
            if len(data) < size:
                raise ends_inside(url, f'"{key}"', offset, size, len(data))
            fault = header_inside(url, key, offset, data)
            if fault is None:
                yield key, data
            elif on_damage is None:
                raise fault
            else:
                on_damage(fault)


def header_inside(url: str, key: str, offset: int, data: bytes) -> BadShard | None:
    """The fault of a photo that holds a tar header: bytes went missing from the shard, and other members moved into it."""
    found = find_header(data)
    return None if found < 0 else BadShard(f'"{key}" holds the header of another member; download it again', url, offset + found)
