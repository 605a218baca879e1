"""Odd and hostile tars, made the same each time, and what a sensible user expects of each.

Each holds the photos PHOTO under the keys that are expected, but where its name says otherwise.
"""

# ruff: noqa: E501  one file a line
from __future__ import annotations

import bz2
import gzip
import io
import lzma
import pickle
import random
import tarfile
import zipfile
import zlib
from functools import cache
from typing import NamedTuple

from .hostile_photos import Canary
from .images import encode, picture
from .test_tar import pax, raw_header

PHOTO = encode(picture(), quality=90)
END = bytes(1024)


class OddTar(NamedTuple):
    """An archive, the keys that come out of it, and a part of each problem that is reported, in order.

    `length` makes the file longer than its data, by a hole that takes no room on the disk.
    """

    data: bytes
    keys: list[str]
    problems: list[str]
    length: int = 0


@cache
def hostile_tars() -> dict[str, OddTar]:
    """All of them, by name."""
    return {**_formats(), **_names(), **_kinds(), **_keys(), **_sizes(), **_cut(), **_damaged(), **_bombs(), **_not_tars()}


def member(name="a.jpg", body=PHOTO, **more) -> bytes:
    raw = name if isinstance(name, bytes) else name.encode()
    return raw_header(raw, size=more.pop("size", b"%011o\0" % len(body)), **more) + body + bytes(-len(body) % 512)


def written(entries, archive_format=tarfile.PAX_FORMAT, **more) -> bytes:
    """By Python's tarfile: entries are names, or (name, type, link)."""
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w", format=archive_format, **more) as archive:
        for entry in entries:
            name, kind, link = (entry, tarfile.REGTYPE, "") if isinstance(entry, str) else entry
            info = tarfile.TarInfo(name)
            info.type, info.linkname, info.size = kind, link, len(PHOTO) if kind == tarfile.REGTYPE else 0
            archive.addfile(info, io.BytesIO(PHOTO))
    return stream.getvalue()


TWO = member("a.jpg") + member("b.jpg")
LONG = "folder/" * 30 + "photo"


def _formats() -> dict[str, OddTar]:
    signed = raw_header("é.jpg".encode(), size=b"%011o\0" % len(PHOTO), signed=True) + PHOTO + bytes(-len(PHOTO) % 512)
    base256 = member(size=b"\x80" + len(PHOTO).to_bytes(11, "big"))
    negative = member(size=b"\xff" * 12)
    return {
        "ustar": OddTar(written(["a.jpg", "b.jpg"], tarfile.USTAR_FORMAT), ["a", "b"], []),
        "gnu with long names": OddTar(written([LONG + ".jpg", "b.jpg"], tarfile.GNU_FORMAT), [LONG, "b"], []),
        "pax with long names": OddTar(written([LONG + ".jpg", "b.jpg"]), [LONG, "b"], []),
        "ustar with a prefix": OddTar(written(["x" * 80 + "/" + "y" * 80 + ".jpg"], tarfile.USTAR_FORMAT), ["x" * 80 + "/" + "y" * 80], []),
        "v7": OddTar(member(magic=b"") + END, ["a"], []),
        "signed checksum": OddTar(signed + END, ["é"], []),
        "size in base 256": OddTar(base256 + END, ["a"], []),
        "size below zero": OddTar(negative + END, [], ["no size"]),
        "pax size": OddTar(pax(b"%d size=%d\n" % (len(str(len(PHOTO))) + 9, len(PHOTO))) + member(size=b"0" * 11 + b"\0") + END, ["a"], []),
        "pax global header": OddTar(written(["a.jpg"], pax_headers={"comment": "all of them"}), ["a"], []),
        "one block at the end": OddTar(TWO + bytes(512), ["a", "b"], []),
        "no block at the end": OddTar(TWO, ["a", "b"], ["ends without the end-of-archive blocks"]),
        "records of a megabyte": OddTar(TWO + bytes((1 << 20) - len(TWO)), ["a", "b"], []),
        "of nothing": OddTar(bytes(10_240), [], []),
        "two in one": OddTar(member("a.jpg") + END + member("b.jpg") + END, ["a", "b"], ["data behind the end"]),
        "in a tar": OddTar(member("inner.tar", TWO + END) + member("c.jpg") + END, ["c"], []),
    }


def _names() -> dict[str, OddTar]:
    names = {
        "upward": ("../../../tmp/a.jpg", "../../../tmp/a"),
        "absolute": ("/etc/a.jpg", "/etc/a"),
        "with a drive": ("C:\\Windows\\a.jpg", "C:\\Windows\\a"),
        "of a shell": ("$(touch executed).jpg", "$(touch executed)"),
        "with a pipe": ("|touch executed;.jpg", "|touch executed;"),
        "with a line feed": ("a\nb.jpg", "a\nb"),
        "with an escape": ("\x1b[2Ja.jpg", "\x1b[2Ja"),
        "in capitals": ("A.JPG", "A"),
        "by another extension": ("a.png", "a"),
        "in folders": ("./x/y/z/a.jpeg", "./x/y/z/a"),
        "of other letters": ("写真/é.webp", "写真/é"),
        "of 4000 letters": ("x/" * 2000 + "a.jpg", "x/" * 2000 + "a"),
    }
    odd = {f"name {kind}": OddTar(written([name]), [key], []) for kind, (name, key) in names.items()}
    return {
        **odd,
        "name that is no text": OddTar(member(b"\xff\xfe.jpg") + END, ["\udcff\udcfe"], []),
        "name of nothing": OddTar(member(b"") + member("b.jpg") + END, ["b"], []),
        "name of dots": OddTar(member("...jpg") + member("b.jpg") + END, ["b"], []),
        "name with dots": OddTar(member("2024.05.01.jpg") + member("b.jpg") + END, ["b"], ["begins at the first dot"]),
        "long name with a null": OddTar(
            member("././@LongLink", b"x" * 120 + b"\0.jpg\0", kind=b"L") + member() + member("b.jpg") + END, ["b"], ["long name", "long name"]
        ),
        "long name of a megabyte": OddTar(
            member("././@LongLink", b"x/" * 600_000 + b"a.jpg\0", kind=b"L") + member() + member("b.jpg") + END, ["b"], ["a long name of", "long name"]
        ),
        "long name without its member": OddTar(TWO + member("././@LongLink", b"c.jpg\0", kind=b"L") + END, ["a", "b"], ["without its member"]),
        "many long names for one": OddTar(member("././@LongLink", b"c.jpg\0", kind=b"L") * 3000 + member() + END, ["c"], []),
        "pax records without end": OddTar(pax(b"99999 path=a") + member() + member("b.jpg") + END, ["b"], ["pax", "long name"]),
        "pax record of no length": OddTar(pax(b"0 path=a\n") + member() + member("b.jpg") + END, ["b"], ["pax", "long name"]),
        "pax size of 5000 digits": OddTar(pax(b"5006 size=" + b"9" * 4995 + b"\n") + member() + member("b.jpg") + END, ["b"], ["the size of"]),
    }  # fmt: skip


def _kinds() -> dict[str, OddTar]:
    links = {
        "link to a secret": (tarfile.SYMTYPE, "/etc/passwd", "link"),
        "link upward": (tarfile.SYMTYPE, "../../../../etc/passwd", "link"),
        "link to itself": (tarfile.SYMTYPE, "x.jpg", "link"),
        "hard link": (tarfile.LNKTYPE, "/etc/passwd", "link"),
        "terminal": (tarfile.CHRTYPE, "", "device"),
        "disk": (tarfile.BLKTYPE, "", "device"),
        "pipe": (tarfile.FIFOTYPE, "", "device"),
    }
    odd = {
        kind: OddTar(written([("x.jpg", code, link), "b.jpg"]), ["b"], [f"not a regular file: {what}"])
        for kind, (code, link, what) in links.items()
    }
    sparse = b"22 GNU.sparse.major=1\n22 GNU.sparse.minor=0\n25 GNU.sparse.name=a.jpg\n36 GNU.sparse.realsize=999999999999\n"
    return {
        **odd,
        "folder with the name of a photo": OddTar(written([("x.jpg", tarfile.DIRTYPE, ""), "b.jpg"]), ["b"], []),
        "link that says to have data": OddTar(raw_header(b"x.jpg", size=b"%011o\0" % 10**9, kind=b"2") + member("b.jpg") + END, ["b"], ["link"]),
        "sparse photo": OddTar(pax(sparse) + member() + member("b.jpg") + END, ["b"], ["not a regular file: sparse"]),
        "old sparse photo": OddTar(member(kind=b"S") + member("b.jpg") + END, ["b"], ["not a regular file: sparse"]),
        "old sparse photo with a longer map": OddTar(
            resummed(member(kind=b"S"), 482, b"\1") + member("b.jpg") + END, ["b"], ["a sparse file; pack it without"]
        ),
        "unknown kind": OddTar(member(kind=b"Z") + member("b.jpg") + END, ["b"], ["not a regular file: other"]),
        "contiguous file": OddTar(member(kind=b"7") + END, ["a"], []),
    }  # fmt: skip


def _keys() -> dict[str, OddTar]:
    annotated = member("a.jpg") + member("a.json", b"{}") + member("b.json", b"{}") + member("b.txt", b"x") + END
    evil = pickle.dumps(Canary())
    return {
        "key twice": OddTar(member("a.jpg") + member("a.jpg", PHOTO + b"2") + END, ["a"], ["duplicate key"]),
        "key twice by extension": OddTar(member("a.jpg") + member("a.png") + member("a.webp") + END, ["a"], ["duplicate key"] * 2),
        "key 500 times": OddTar(member("a.jpg", b"") * 500 + END, [], ["empty file"] + ["duplicate key"] * 499),
        "photo missing": OddTar(annotated, ["a"], ["no photo: only .json, .txt"]),
        "other formats": OddTar(member("a.gif") + member("b.TIFF") + member("c.jpg") + END, ["c"], [".gif", ".tiff"]),
        "gif by the name of a photo": OddTar(member("a.jpg", encode(picture(), "GIF")) + member("b.jpg") + END, ["b"], ["GIF"]),
        "hidden files": OddTar(member("._a.jpg", b"macOS") + member("__MACOSX/a.jpg", b"macOS") + member("a.jpg") + END, ["a"], []),
        "empty photo": OddTar(member("a.jpg", b"") + member("b.jpg") + END, ["b"], ["empty file"]),
        "pickles beside": OddTar(
            member("a.jpg") + member("a.pyd", evil) + member("a.pickle", evil) + member("a.pth", evil) + END, ["a"], []
        ),
        "pickle by the name of a photo": OddTar(member("a.jpg", evil) + member("b.jpg") + END, ["b"], ["unknown format"]),
        "error page by the name of a photo": OddTar(member("a.jpg", b"<html>403") + member("b.jpg") + END, ["b"], ["HTML"]),
        "script beside": OddTar(
            member("a.jpg") + member("setup.py", b"open('executed', 'w')") + member("__init__.py", b"") + END, ["a"], []
        ),
    }


def _sizes() -> dict[str, OddTar]:
    return {
        "size of 8 GB": OddTar(member(size=b"77777777777\0") + member("b.jpg") + END, [], ["ends inside"]),
        "size of 2^95": OddTar(member(size=b"\x80" + b"\xff" * 11) + member("b.jpg") + END, [], ["ends inside"]),
        "size a byte too small": OddTar(member(size=b"%011o\0" % (len(PHOTO) - 1)) + member("b.jpg") + END, ["b"], ["truncated"]),
        "size a block too small": OddTar(member(size=b"%011o\0" % (len(PHOTO) - 512)) + member("b.jpg") + END, ["b"], ["does not end where", "damaged header"]),
        "size a block too large": OddTar(member(size=b"%011o\0" % (len(PHOTO) + 512)) + member("b.jpg") + member("c.jpg") + END, ["b", "c"], ["does not end where", "damaged header"]),
        "size over the next member": OddTar(
            member(size=b"%011o\0" % (len(member()) + len(PHOTO))) + member("b.jpg") + member("c.jpg") + END, ["c"], ["the header of another member"]
        ),
        "size that is no number": OddTar(member(size=b"abcdefghijk\0") + member("b.jpg") + END, ["b"], ["no size"]),
        "photo of 200 MB": OddTar(member(body=b"", size=b"%011o\0" % 200_000_000), [], ["too large"], length=512 + 200_000_000 + 1024),
        "photo of 100 MB of nothing": OddTar(member(body=b"", size=b"%011o\0" % 100_000_000), [], ["only zeros", "zeros from inside"], length=512 + 100_000_256 + 1024),
        "annotation of 10 TB": OddTar(member("a.bin", b"", size=b"\x80" + (10**13).to_bytes(11, "big")), [], [], length=512 + 10**13 // 512 * 512 + 512 + 1024),
    }  # fmt: skip


def _cut() -> dict[str, OddTar]:
    whole = TWO + END
    second = len(member())
    places = {
        "in the first header": (100, [], ["ends inside a header"]),
        "behind the first header": (512, [], ["ends inside"]),
        "in the first photo": (800, [], ["ends inside"]),
        "at the end of the first photo": (512 + len(PHOTO), ["a"], ["without the end-of-archive"]),
        "behind the first photo": (second, ["a"], ["without the end-of-archive"]),
        "in the second header": (second + 200, ["a"], ["ends inside a header"]),
        "in the second photo": (second + 600, ["a"], ["ends inside"]),
        "in the end": (len(whole) - 700, ["a", "b"], ["without the end-of-archive"]),
        "in the second block of the end": (len(whole) - 100, ["a"], ["does not end where", "zeros at its end"]),
    }
    odd = {f"cut {where}": OddTar(whole[:place], keys, problems) for where, (place, keys, problems) in places.items()}
    filled = whole[: second + 600]
    return {
        **odd,
        "cut and filled up with zeros": OddTar(filled, ["a"], ["does not end where", "zeros at its end"], length=10_240 * 7),
        "cut in a long name": OddTar((member("././@LongLink", b"x" * 2000, kind=b"L") + TWO)[:900], [], ["ends inside a long name"]),
    }


def _damaged() -> dict[str, OddTar]:
    three = member("a.jpg") + member("b.jpg") + member("c.jpg") + END
    second = len(member())
    noise = random.Random(0).randbytes(512)
    return {
        "header with a flipped bit": OddTar(flipped(three, second), ["a", "c"], ["damaged header"]),
        "first header with a flipped bit": OddTar(flipped(three, 3), ["b", "c"], ["first header is damaged"]),
        "header wiped with zeros": OddTar(put(three, second, bytes(512)), ["a", "c"], ["data behind the end"]),
        "header wiped with noise": OddTar(put(three, second, noise), ["c"], ["does not end where", "damaged header"]),
        "a byte lost": OddTar(three[:700] + three[701:], ["b", "c"], ["does not end where", "damaged header"]),
        "a byte too many": OddTar(three[:700] + b"x" + three[700:], ["b", "c"], ["does not end where", "damaged header"]),
        "a sector lost": OddTar(three[:1024] + three[1536:], ["b", "c"], ["does not end where", "damaged header"]),
        "a sector twice": OddTar(three[:1024] + three[512:1024] + three[1024:], ["b", "c"], ["does not end where", "damaged header"]),
        "lines turned to DOS": OddTar(three.replace(b"\n", b"\r\n"), [], ["does not end where", "damaged header", "truncated"]),
        "bytes behind the end": OddTar(TWO + END + b"</html>", ["a", "b"], ["data behind the end"]),
        "damaged inside": OddTar(put(three, second + 700, noise), ["a", "c"], ["truncated"]),
        "checksum that is blank": OddTar(put(three, second + 148, b" " * 8), ["a", "c"], ["damaged header"]),
        "the end overwritten": OddTar(TWO + noise * 2, ["a"], ["does not end where", "damaged header"]),
    }


def _bombs() -> dict[str, OddTar]:
    many = b"".join(member(f"{number}.txt", b"") for number in range(20_000))
    nested = PHOTO
    for depth in range(30):
        nested = member(f"{depth}.tar", nested) + END
    return {
        "20 000 empty members": OddTar(many + member("a.jpg") + END, ["a"], []),
        "20 000 damaged headers": OddTar(member("a.jpg") + b"".join(flipped(member("x.txt", b""), 3) for _ in range(20_000)) + member("b.jpg") + END, ["a", "b"], ["damaged header"]),
        "20 000 headers of no size": OddTar(member("a.jpg") + raw_header(b"x.txt", size=b"x" * 12) * 20_000 + member("b.jpg") + END, ["a", "b"], ["no size"] * 20_000),
        "30 tars in each other": OddTar(nested, [], []),
        "hole of 10 TB behind the end": OddTar(TWO + END, ["a"], ["does not end where", "zeros at its end"], length=10**13),
        "hole of 10 TB behind damage": OddTar(member("a.jpg") + random.Random(1).randbytes(512), [], ["does not end where", "damaged header"], length=10**13),
        "hole of 10 TB and nothing else": OddTar(b"", [], ["zeros at its end"], length=10**13),
    }  # fmt: skip


def _not_tars() -> dict[str, OddTar]:
    whole = TWO + END
    zipped = io.BytesIO()
    with zipfile.ZipFile(zipped, "w") as archive:
        archive.writestr(zipfile.ZipInfo("a.jpg"), PHOTO)  # without the time of day
    files = {
        "gzip": (gzip.compress(whole, mtime=0), "compressed with gzip"),
        "gzip bomb": (gzip.compress(bytes(200_000_000), mtime=0), "compressed with gzip"),
        "zstd": (b"\x28\xb5\x2f\xfd" + bytes(100), "compressed with zstd"),
        "xz": (lzma.compress(whole), "compressed with xz"),
        "bzip2": (bz2.compress(whole), "compressed with bzip2"),
        "zip": (zipped.getvalue(), "a zip"),
        "html error page": (b"<!DOCTYPE html><title>404</title>", "HTML"),
        "xml error": (b"<?xml version='1.0'?><Error><Code>AccessDenied</Code></Error>", "HTML or XML"),
        "json error": (b'{"error": "expired"}', "ends inside a header"),
        "git lfs pointer": (b"version https://git-lfs.github.com/spec/v1\n", "Git LFS pointer"),
        "photo": (PHOTO, "not a tar"),
        "pickle": (pickle.dumps(Canary()) + bytes(600), "not a tar"),
        "noise": (random.Random(2).randbytes(100_000), "not a tar"),
        "empty": (b"", "empty file"),
        "one byte": (b"x", "ends inside a header"),
        "zlib": (zlib.compress(whole), "not a tar"),
    }
    return {f"not a tar: {name}": OddTar(data, [], [says]) for name, (data, says) in files.items()}


def put(data: bytes, place: int, new: bytes) -> bytes:
    return data[:place] + new + data[place + len(new) :]


def flipped(data: bytes, place: int) -> bytes:
    return put(data, place, bytes([data[place] ^ 1]))


def resummed(data: bytes, place: int, new: bytes) -> bytes:
    """A member with a changed header whose checksum is right."""
    header = bytearray(put(data[:512], place, new))
    header[148:156] = b" " * 8
    header[148:156] = b"%06o\0 " % sum(header)
    return bytes(header) + data[512:]
