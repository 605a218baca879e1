"""The members of a tar by reading its headers only, and what is damaged in it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from zsdata.faults import BadShard
from zsdata.source.ranges import ShardFile, ends_inside

BLOCK = 512
MAX_EXTENSION_BYTES = 1 << 20  # the longest long-name or pax record that is read; real ones have a few hundred bytes
SCAN_BYTES = 1 << 20  # read at a time when looking for the next header; a multiple of BLOCK

Kind = Literal["file", "folder", "link", "device", "sparse", "other"]
_KINDS: dict[bytes, Kind] = {
    **dict.fromkeys((b"0", b"\0", b"7"), "file"),
    **dict.fromkeys((b"1", b"2"), "link"),
    **dict.fromkeys((b"3", b"4", b"6"), "device"),
    b"5": "folder",
    b"S": "sparse",
}
_WITHOUT_DATA = ("folder", "link", "device")  # a size in their header says nothing about the archive
_PAX_SIZE = re.compile(r"[0-9]{1,19}")
_PAX_RECORD = re.compile(rb"(\d{1,9}) ([^=]+)=")

_FOREIGN = (  # what else is found under the name .tar, and the way out
    (b"\x1f\x8b", "compressed with gzip: photos are read by range, which needs an uncompressed tar; unpack it with gunzip"),
    (b"\x28\xb5\x2f\xfd", "compressed with zstd: photos are read by range, which needs an uncompressed tar; unpack it with unzstd"),
    (b"\xfd7zXZ\0", "compressed with xz: photos are read by range, which needs an uncompressed tar; unpack it with unxz"),
    (b"BZh", "compressed with bzip2: photos are read by range, which needs an uncompressed tar; unpack it with bunzip2"),
    (b"PK\x03\x04", "not a tar: a zip; unpack it and make shards with `zsdata pack`"),
    (b"version https://git-lfs", "not a tar: a Git LFS pointer; fetch the file itself with `git lfs pull`"),
    (b"<", "not a tar: an HTML or XML page; download the shard again and check its address"),
)


class TarMember(NamedTuple):
    """One member: `size` bytes of data at `offset`."""

    name: str
    offset: int
    size: int
    kind: Kind


@dataclass
class _Header:
    member: TarMember
    end: int  # where the next header is
    own_name: bool  # named by its own header, not by an extension header before it


class _Damage(Exception):
    """What is wrong, where the search for the next header starts (None: nowhere), and whether that header may have lost its long name."""

    def __init__(self, fault: BadShard, resume: int | None, renames_next: bool = False) -> None:
        super().__init__(fault)
        self.fault = fault
        self.resume = resume
        self.renames_next = renames_next


def walk_tar(file: ShardFile, on_damage: Callable[[BadShard], None] | None = None) -> Iterator[TarMember]:
    """The members of an uncompressed tar in order: ustar, GNU (long names, large sizes), pax (path, size) and old V7.

    Only headers are read; links are not followed and nothing is unpacked. The archive's end is a block of zeros with only zeros after it
    (two or more by the standard, one where a writer was frugal). A file that ends without it is damaged: it was cut off.

    Args:
        on_damage: gets each damage; the walk then goes on with the next header that is whole (valid checksum and magic, at a multiple
            of 512). A member that the file's end cuts off is never yielded, nor one whose long name was lost. Without it, damage raises.

    Raises:
        BadShard: damage, when there is no `on_damage`.
    """
    global_records: dict[str, str] = {}
    offset: int | None = 0
    renamed = False
    while offset is not None:
        try:
            header = _next_header(file, offset, global_records)
            if header is None:
                return
            if renamed and header.own_name:
                lost = BadShard(f'the long name of "{header.member.name}" is damaged; download the shard again', file.url, offset)
                raise _Damage(lost, header.end)
        except _Damage as damage:
            if on_damage is None:
                raise damage.fault from None
            on_damage(damage.fault)
            offset, renamed = _resynchronise(file, damage)
            continue
        renamed = False
        yield header.member
        offset = header.end


def _next_header(file: ShardFile, offset: int, global_records: dict[str, str]) -> _Header | None:
    """The member whose headers start at `offset`; None at a proper end of the archive."""
    extension = _Extension(dict(global_records))
    while True:
        block = file.read_at(offset, BLOCK)
        zeros = not block.strip(b"\0")
        if offset == 0:
            _refuse_foreign(file.url, block)
        if len(block) < BLOCK and (extension.seen or not zeros):
            raise _Damage(ends_inside(file.url, "a header", min(offset, file.size), BLOCK, len(block)), None)
        if zeros:
            if extension.seen:
                raise _Damage(BadShard("a long name without its member; download it again", file.url, offset), offset)
            _check_end(file, offset, block)
            return None
        if not _checksum_fits(block):
            what = "damaged header" if offset else "not a tar, or its first header is damaged"
            raise _Damage(BadShard(f"{what}; download it again", file.url, offset), offset + BLOCK, _looks_like_extension(block))
        size = _number(block[124:136])
        if size is None or size < 0:
            raise _Damage(BadShard("damaged header: no size; download it again", file.url, offset), offset + BLOCK)
        kind, data = block[156:157], offset + BLOCK
        if kind not in b"LKxXg":
            return _member(file, block, kind, data, size, extension)
        end = data + _padded(size)
        if size > MAX_EXTENSION_BYTES:
            resume = end if end <= file.size else None
            raise _Damage(BadShard(f"damaged header: a long name of {size:,} bytes", file.url, offset), resume, renames_next=True)
        body = file.read_at(data, size)
        if len(body) < size:
            raise _Damage(ends_inside(file.url, "a long name", data, size, len(body)), None)
        extension.seen |= kind != b"g"
        if kind == b"L":
            extension.name = _text(body.rstrip(b"\0"))
        elif kind != b"K":  # K is the target of a link
            records = _pax_records(body)
            if records is None:
                raise _Damage(BadShard("damaged pax header; download it again", file.url, offset), data, renames_next=True)
            extension.records.update(records)
            if kind == b"g":
                global_records.update(records)
        offset = end


@dataclass
class _Extension:
    records: dict[str, str] = field(default_factory=dict)
    name: str | None = None
    seen: bool = False


def _member(file: ShardFile, block: bytes, kind: bytes, data: int, size: int, extension: _Extension) -> _Header:
    what = _KINDS.get(kind, "other")
    records = extension.records
    given_name = records.get("path", extension.name)
    name = given_name if given_name is not None else _header_name(block)
    if what == "file" and name.endswith("/"):
        what = "folder"  # as V7 wrote folders
    if "size" in records:
        if not _PAX_SIZE.fullmatch(records["size"]):
            raise _Damage(BadShard(f'damaged pax header: the size of "{name}"; download it again', file.url, data - BLOCK), data)
        size = int(records["size"])
    if "GNU.sparse.name" in records or "GNU.sparse" in records:
        what = "sparse"
        name = records.get("GNU.sparse.name", name)
    if what in _WITHOUT_DATA:
        size = 0
    if data + size > file.size:
        # no search for more: what looks like a header behind this point may be the inside of a cut-off nested archive
        raise _Damage(ends_inside(file.url, f'"{name}"', data, size, max(0, file.size - data)), None)
    end = data + _padded(size)
    if kind == b"S" and block[482:483] != b"\0":
        raise _Damage(BadShard(f'"{name}" is a sparse file; pack it without tar --sparse', file.url, data - BLOCK), data)
    return _Header(TarMember(name, data, size, what), end, own_name=given_name is None)


def _check_end(file: ShardFile, offset: int, block: bytes) -> None:
    """Accepts a block of zeros and nothing but zeros behind it."""
    if len(block) < BLOCK:
        what = "ends without the end-of-archive blocks" if file.size else "empty file"
        raise _Damage(BadShard(f"{what}; download it again", file.url, file.size), None)
    position = offset + BLOCK
    while chunk := file.read_at(position, SCAN_BYTES):
        rest = chunk.lstrip(b"\0")
        if rest:
            start = position + (len(chunk) - len(rest)) // BLOCK * BLOCK
            raise _Damage(
                BadShard("data behind the end of the archive: zeroed in the middle, or several tars in one", file.url, offset), start
            )
        position += len(chunk)


def _resynchronise(file: ShardFile, damage: _Damage) -> tuple[int | None, bool]:
    """Where the next whole header is, and whether it may have lost its long name."""
    if damage.resume is None:
        return None, False
    position = damage.resume
    while chunk := file.read_at(position, SCAN_BYTES):
        magic = chunk.find(b"ustar")
        while magic >= 0:
            start = magic - 257
            block = chunk[start : start + BLOCK] if start >= 0 and start % BLOCK == 0 else b""
            if len(block) == BLOCK and _checksum_fits(block):
                skipped = file.read_at(damage.resume, min(BLOCK, position + start - damage.resume))
                return position + start, damage.renames_next or _is_extension_body(skipped, block)
            magic = chunk.find(b"ustar", magic + 1)
        position += len(chunk)
    return None, False


def _is_extension_body(skipped: bytes, header: bytes) -> bool:
    """Whether what was skipped before `header` reads like its long name, so that the damaged header announced one."""
    name = header[:100].partition(b"\0")[0]
    return _PAX_RECORD.match(skipped) is not None or (len(name) >= 99 and skipped.startswith(name))


def _checksum_fits(block: bytes) -> bool:
    stated = _number(block[148:156])
    if stated is None:
        return False
    total = sum(block) - sum(block[148:156]) + 8 * 32  # the checksum itself counts as spaces
    return stated == total or stated == total - 256 * sum(
        byte > 127 for byte in block[:148] + block[156:]
    )  # some old tars sum signed bytes


def _number(field: bytes) -> int | None:
    """An octal or base-256 header number (blank is 0); None where it is damaged."""
    if field[0] in (0x80, 0xFF):
        return int.from_bytes(field, "big", signed=True) if field[0] == 0xFF else int.from_bytes(field[1:], "big")
    digits = field.partition(b"\0")[0].strip(b" ")
    if digits.strip(b"01234567"):
        return None
    return int(digits or b"0", 8)


def _header_name(block: bytes) -> str:
    name = block[:100].partition(b"\0")[0]
    prefix = block[345:500].partition(b"\0")[0]
    if prefix and block[257:263] == b"ustar\0":  # GNU keeps times there
        name = prefix + b"/" + name
    return _text(name)


def _pax_records(body: bytes) -> dict[str, str] | None:
    """The records that matter here; None where they are damaged."""
    records, position = {}, 0
    while position < len(body) and body[position]:
        match = _PAX_RECORD.match(body, position)
        length = int(match[1]) if match else 0
        end = position + length
        if match is None or end > len(body) or match.end() >= end or body[end - 1 : end] != b"\n":
            return None
        key = _text(match[2])
        if key in ("path", "size", "GNU.sparse.name"):
            records[key] = _text(body[match.end() : end - 1])
        elif key.startswith("GNU.sparse."):
            records["GNU.sparse"] = ""
        position = end
    return records


def _looks_like_extension(block: bytes) -> bool:
    return block[156:157] in b"LKxXg" or block.startswith(b"././@") or b"PaxHeader" in block[:100]


def _refuse_foreign(url: str, start: bytes) -> None:
    for signature, description in _FOREIGN:
        if start.startswith(signature) and b"ustar" not in start:
            raise _Damage(BadShard(description, url, 0), None)


def _text(raw: bytes) -> str:
    return raw.decode("utf-8", "surrogateescape")


def _padded(size: int) -> int:
    return -(-size // BLOCK) * BLOCK
