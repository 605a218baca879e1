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
SCAN_BYTES = 1 << 20  # read at a time when looking for the next header
MAX_SEARCH_BYTES = 1 << 30  # how far a header is looked for, and zeros are read: a file may have a hole of terabytes
RECORD_BYTES = (10_240, *(BLOCK << power for power in range(1, 12)))  # what writers fill the last record up to; tar itself 10,240

Kind = Literal["file", "folder", "link", "device", "sparse", "other"]
_KINDS: dict[bytes, Kind] = {
    **dict.fromkeys((b"0", b"\0", b"7"), "file"),
    **dict.fromkeys((b"1", b"2"), "link"),
    **dict.fromkeys((b"3", b"4", b"6"), "device"),
    b"5": "folder",
    b"S": "sparse",
}
_WITHOUT_DATA = ("folder", "link", "device")  # a size in their header says nothing about the archive
_OCTAL_FIELDS = ((100, 108), (108, 116), (116, 124), (124, 136), (136, 148), (148, 156))  # mode, owner, group, size, time, checksum
_OCTAL = re.compile(rb" *([0-7]*)[ \0]*")
_OCTAL_FIELD = re.compile(rb" *[0-7]+[ \0]+")  # as _OCTAL, neither blank nor without its end
_WHOLE_SIZE = re.compile(rb"[0-7]{11}[ \0]")
_PAX_SIZE = re.compile(r"[0-9]{1,19}")
_PAX_RECORD = re.compile(rb"(\d{1,9}) ([^=]+)=")

_FOREIGN = (  # what else is found under the name .tar, and the way out
    (
        b"\x1f\x8b",
        "compressed with gzip: photos are read by range, which needs an uncompressed tar; unpack it with gunzip or `zsdata decompress`",
    ),
    (
        b"\x28\xb5\x2f\xfd",
        "compressed with zstd: photos are read by range, which needs an uncompressed tar; unpack it with unzstd or `zsdata decompress`",
    ),
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
    """What is wrong, and where the reading may go on.

    Args:
        resume: where the search for the next header starts; None: nowhere.
        renames_next: that header may have lost its long name.
        claimed_end: where the next header should be by what is legible of the damaged one.
        misplaced: nothing like a header is where one should be, so that bytes may be missing from, or too many in, the member before.
        behind_end: `resume` lies behind a block of zeros, the end of an archive or a header that was wiped out.
    """

    def __init__(
        self,
        fault: BadShard,
        resume: int | None,
        *,
        renames_next: bool = False,
        claimed_end: int | None = None,
        misplaced: bool = False,
        behind_end: bool = False,
    ) -> None:
        super().__init__(fault)
        self.fault = fault
        self.resume = resume
        self.renames_next = renames_next
        self.claimed_end = claimed_end
        self.misplaced = misplaced
        self.behind_end = behind_end


def walk_tar(file: ShardFile, on_damage: Callable[[BadShard], None] | None = None) -> Iterator[TarMember]:
    """The members of an uncompressed tar in order: ustar, GNU (long names, large sizes), pax (path, size) and old V7.

    Only headers are read; links are not followed and nothing is unpacked. A member is yielded once what follows it is seen: another header,
    even a damaged one, or the end. The archive's end is a block of zeros (two or more by the standard, one where a writer was frugal) with
    nothing but zeros up to the end of a record. A file that ends without it is damaged: it was cut off.

    What is reported reaches from the damage to the next member that is yielded; what lies between is lost. Some damage cannot
    be seen in a tar, as it has no checksum but the sum of a header's bytes: other bytes in a member's data or in a long name, changes of a
    header that cancel out, and members that were zeroed together with the end. An index knows (`zsdata.source.index`).

    Args:
        on_damage: gets each damage; the walk then goes on with the next header that is whole, if it surely belongs to this archive and
            not to one inside of it. (It cannot tell for a tar in the tar that is the last member and whose own header is damaged.)
            A member that the file's end cuts off is never yielded, nor one whose long name was lost. Without it, damage raises.

    Raises:
        BadShard: damage, when there is no `on_damage`.
    """
    global_records: dict[str, str] = {}
    offset: int | None = 0
    last: TarMember | None = None  # found, not yet yielded
    renamed = False  # the next member may have lost its long name
    extended = False  # names have come in extension headers
    damaged = False
    while offset is not None:
        try:
            header = _next_header(file, offset, global_records)
            if header is None:
                if not damaged:
                    _check_records(file, offset)
                break
            if renamed and header.own_name:
                lost = BadShard(f'the long name of "{header.member.name}" is damaged; download the shard again', file.url, offset)
                raise _Damage(lost, header.end)
        except _Damage as damage:
            damaged = True
            doubtful = last if damage.misplaced and damage.fault.offset == offset else None
            if last is not None and doubtful is None:
                yield last
            last = None
            if on_damage is None:
                raise damage.fault from None
            if doubtful is not None:
                what = f'"{doubtful.name}" does not end where its size says: bytes were lost or inserted; download it again'
                on_damage(BadShard(what, file.url, doubtful.offset))
            on_damage(damage.fault)
            offset = _resynchronise(file, damage, doubtful)
            renamed = offset is not None and (damage.renames_next or (offset != damage.claimed_end and (extended or _is_cut(file, offset))))
            continue
        renamed = False
        extended |= not header.own_name
        if last is not None:
            yield last
        last, offset = header.member, header.end
    if last is not None:
        yield last


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
            in_place = _resembles_header(block)
            raise _Damage(
                BadShard(f"{what}; download it again", file.url, offset),
                offset + BLOCK,
                renames_next=extension.seen or (in_place and _looks_like_extension(block)),
                claimed_end=_claimed_end(block, offset) if in_place else None,
                misplaced=not in_place,
            )
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
            name = body.removesuffix(b"\0")
            if not name or b"\0" in name:
                raise _Damage(BadShard("damaged long name; download it again", file.url, offset), data, renames_next=True)
            extension.name = _text(name)
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
    while position - offset < MAX_SEARCH_BYTES and (chunk := file.read_at(position, SCAN_BYTES)):
        if chunk != bytes(len(chunk)):
            rest = chunk.lstrip(b"\0")
            start = offset + (position + len(chunk) - len(rest) - offset) // BLOCK * BLOCK
            raise _Damage(
                BadShard("data behind the end of the archive: zeroed in the middle, or several tars in one", file.url, offset),
                start,
                behind_end=True,
            )
        position += len(chunk)


def _check_records(file: ShardFile, end: int) -> None:
    """Accepts as many zeros behind the last member as a writer of tars leaves there."""
    zeros = file.size - end
    if zeros in (BLOCK, 2 * BLOCK) or any(file.size % record == 0 and zeros < record + 2 * BLOCK for record in RECORD_BYTES):
        return
    what = f"{zeros:,} bytes of zeros at its end, which no tar writes: bytes are missing or were never written; download it again"
    raise _Damage(BadShard(what, file.url, end), None, misplaced=True)


def _resynchronise(file: ShardFile, damage: _Damage, doubtful: TarMember | None) -> int | None:
    """Where the next whole header of this archive is.

    A header that is found may be one of a tar inside of the tar. Where that is possible, the headers from there on are followed: an
    archive that ends before the file does is an inner one. Off the grid of blocks, or inside a doubtful member, they must lead to the end.
    """
    if damage.resume is None:
        return None
    if damage.claimed_end is not None and _is_header(file.read_at(damage.claimed_end, BLOCK)):
        return damage.claimed_end
    start = damage.resume if doubtful is None else doubtful.offset
    position = _find_header(file, start, start + MAX_SEARCH_BYTES)
    while position is not None:
        on_grid = position >= damage.resume and (position - damage.resume) % BLOCK == 0
        stop = _follow(file, position)
        if stop is None or (on_grid and not stop.behind_end):
            return position
        position = _find_header(file, stop.fault.offset + 1, start + MAX_SEARCH_BYTES)
    return None


def _follow(file: ShardFile, offset: int) -> _Damage | None:
    """What stops the chain of headers that begins at `offset`; None where it is a proper end of the file."""
    global_records: dict[str, str] = {}
    try:
        while (header := _next_header(file, offset, global_records)) is not None:
            offset = header.end
    except _Damage as damage:
        return damage
    return None


def _find_header(file: ShardFile, position: int, limit: int) -> int | None:
    """The first whole header, at any byte from `position` on; old V7 headers have no magic and are not found."""
    while position < limit and len(chunk := file.read_at(position, SCAN_BYTES)) >= BLOCK:
        found = find_header(chunk)
        if found >= 0:
            return position + found
        position += len(chunk) - (BLOCK - 1)
    return None


def find_header(data: bytes) -> int:
    """Where the first whole header begins in `data`, -1 without one."""
    magic = data.find(b"ustar", 257)
    while magic >= 0:
        if _is_header(data[magic - 257 : magic - 257 + BLOCK]):
            return magic - 257
        magic = data.find(b"ustar", magic + 1)
    return -1


def _is_header(block: bytes) -> bool:
    return len(block) == BLOCK and block[257:262] == b"ustar" and _checksum_fits(block)


def _is_cut(file: ShardFile, offset: int) -> bool:
    """Whether the name in a header stands for a longer one, or, as Python writes it, for one with other letters than ASCII's."""
    name = file.read_at(offset, 100).partition(b"\0")[0]
    return len(name) >= 99 or b"?" in name


def _resembles_header(block: bytes) -> bool:
    """Whether a damaged block is a header in its place."""
    return block[257:262] == b"ustar" or sum(_OCTAL_FIELD.fullmatch(block[start:end]) is not None for start, end in _OCTAL_FIELDS) >= 5


def _claimed_end(block: bytes, offset: int) -> int | None:
    """Where the data of a damaged header end by its size, if that looks untouched."""
    size = int(block[124:135], 8) if _WHOLE_SIZE.fullmatch(block[124:136]) else 0
    return offset + BLOCK + _padded(size) if size else None


def _checksum_fits(block: bytes) -> bool:
    if block[257:262] != b"ustar" and block[257:].strip(b"\0"):  # V7 has nothing there; a sum alone may fit a header that is a byte off
        return False
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
    match = _OCTAL.fullmatch(field)
    return None if match is None else int(match[1] or b"0", 8)


def _header_name(block: bytes) -> str:
    name = block[:100].partition(b"\0")[0]
    prefix = block[345:500].partition(b"\0")[0]
    if prefix and block[257:263] == b"ustar\0":  # GNU keeps times there
        name = prefix + b"/" + name
    return _text(name)


def _pax_records(body: bytes) -> dict[str, str] | None:
    """The records that matter here; None where they are damaged."""
    records, position = {}, 0
    while position < len(body):
        match = _PAX_RECORD.match(body, position)
        length = int(match[1]) if match else 0
        end = position + length
        if match is None or end > len(body) or match.end() >= end or body[end - 1 : end] != b"\n":
            return None
        key = _text(match[2])
        if key in ("path", "size", "GNU.sparse.name"):
            value = body[match.end() : end - 1]
            if b"\0" in value:
                return None
            records[key] = _text(value)
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
