"""The tar walk against Python's tarfile, and against damage."""

import io
import itertools
import tarfile

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zsdata.faults import BadShard
from zsdata.source import tar
from zsdata.source.ranges import ShardFile
from zsdata.source.tar import MAX_EXTENSION_BYTES, walk_tar

FORMATS = {"ustar": tarfile.USTAR_FORMAT, "gnu": tarfile.GNU_FORMAT, "pax": tarfile.PAX_FORMAT}

parts = st.text(st.characters(codec="utf-8", exclude_characters="/\0", exclude_categories=["Cs"]), min_size=1, max_size=90).filter(
    lambda part: part not in (".", "..")
)
names = st.lists(parts, min_size=1, max_size=4).map("/".join)
bodies = st.one_of(st.binary(max_size=40), st.integers(0, 2000).map(lambda size: b"\xab" * size))
members = st.lists(st.tuples(names, bodies), max_size=8)


def write_tar(entries, archive_format=tarfile.GNU_FORMAT):
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w", format=archive_format) as archive:
        for name, body in entries:
            member = tarfile.TarInfo(name)
            member.size = len(body)
            archive.addfile(member, io.BytesIO(body))
    return stream.getvalue()


class BytesShard(ShardFile):
    """A shard in memory."""

    def __init__(self, data):
        self.url, self.size, self._data = "memory.tar", len(data), data

    def read_at(self, offset, size):
        return self._data[offset : offset + size]

    def close(self):
        pass


def walk(data, on_damage=None):
    return [(member.name, data[member.offset : member.offset + member.size]) for member in walk_tar(BytesShard(data), on_damage)]


@pytest.mark.parametrize("archive_format", FORMATS.values(), ids=FORMATS.keys())
@given(entries=members)
def test_the_walk_finds_what_tarfile_wrote(archive_format, entries):
    try:
        data = write_tar(entries, archive_format)
    except ValueError:  # ustar has no room for such a name
        return
    assert walk(data) == entries


@given(entries=members, archive_format=st.sampled_from(list(FORMATS.values())), position=st.floats(0, 1), bit=st.integers(0, 7))
@settings(max_examples=200)
def test_a_flipped_bit_loses_no_member_in_silence_and_invents_none(entries, archive_format, position, bit):
    entries = [(f"{number}-{name}", body) for number, (name, body) in enumerate(entries)]
    try:
        data = bytearray(write_tar(entries, archive_format))
    except ValueError:
        return
    headers = [member.offset - 512 for member in walk_tar(BytesShard(bytes(data)))]
    if not headers:
        return
    place = int(position * (512 * len(headers) - 1))
    data[headers[place // 512] + place % 512] ^= 1 << bit
    faults = []
    found = walk(bytes(data), faults.append)
    assert set(found) <= set(entries)
    assert len(entries) - len(found) <= len(faults)


@pytest.mark.parametrize("archive_format", [tarfile.GNU_FORMAT, tarfile.PAX_FORMAT], ids=["gnu", "pax"])
def test_a_bit_flipped_anywhere_in_a_long_name_header_invents_no_name(archive_format):
    entries = [("a.jpg", b"a" * 700), ("long/" * 30 + "b.jpg", b"b" * 900), ("photo é.jpg", b"c"), ("d.jpg", b"d")]
    data = write_tar(entries, archive_format)
    start = walk_tar(BytesShard(data))
    first = next(start)
    extension = first.offset + 1024  # behind the 700 bytes
    for place in range(extension, extension + 512):
        for bit in (0, 3, 6):
            damaged = bytearray(data)
            damaged[place] ^= 1 << bit
            faults = []
            found = walk(bytes(damaged), faults.append)
            assert set(found) <= set(entries)
            assert len(entries) - len(found) <= len(faults)


@pytest.mark.parametrize("wiped", [b"\xff" * 512, bytes(512)], ids=["noise", "zeros"])
@pytest.mark.parametrize(("archive_format", "name"), [(tarfile.GNU_FORMAT, "long/" * 30 + "b.jpg"), (tarfile.PAX_FORMAT, "é.jpg")])
def test_a_member_whose_long_name_header_is_wiped_out_gets_no_other_name(archive_format, name, wiped):
    data = bytearray(write_tar([("a.jpg", b"a"), (name, b"b"), ("c.jpg", b"c")], archive_format))
    data[1024 : 1024 + 512] = wiped
    faults = []
    assert walk(bytes(data), faults.append)[-1] == ("c.jpg", b"c")
    assert set(walk(bytes(data), faults.append)) <= {("a.jpg", b"a"), ("c.jpg", b"c")}
    assert faults


@pytest.mark.parametrize("archive_format", FORMATS.values(), ids=FORMATS.keys())
def test_a_cut_at_any_byte_is_reported_and_yields_whole_members_only(archive_format):
    entries = [("a.jpg", b"a" * 700), ("n" * 90 + ".jpg", b"b" * 512), ("long/" * 25 + "c.jpg", b"c" * 10), ("é.jpg", b"")]
    data = write_tar(entries, archive_format)
    last = [member.offset + member.size for member in walk_tar(BytesShard(data))]
    end = -(-last[-1] // 512) * 512
    for cut in range(end + 1):
        faults = []
        found = walk(data[:cut], faults.append)
        assert found == entries[: len(found)]
        assert len(found) == sum(offset <= cut for offset in last)
        assert len(faults) == 1 and faults[0].offset <= cut
        with pytest.raises(BadShard, match=r"ends|empty file"):
            walk(data[:cut])


@pytest.mark.parametrize("size", [1024 + 512, 2048, 10_240, 2**14, 2**20])
def test_an_archive_ends_in_one_or_two_blocks_of_zeros_or_fills_its_record(size):
    assert walk(write_tar([("a.jpg", b"a")])[:1024] + bytes(size - 1024)) == [("a.jpg", b"a")]


@pytest.mark.parametrize("size", [1024 + 513, 3000, 2560, 10_239, 10_752, 30_720, 2**20 + 10_240, 2**21])
def test_zeros_that_no_writer_leaves_are_damage_and_cast_doubt_on_the_last_member(size):
    data = write_tar([("a.jpg", b"a"), ("b.jpg", b"b")])[:2048] + bytes(size - 1024)
    faults = []
    assert walk(data, faults.append) == [("a.jpg", b"a")]
    assert ["zeros at its end" in fault.reason or '"b.jpg" does not end' in fault.reason for fault in faults] == [True, True]
    with pytest.raises(BadShard, match="zeros at its end, which no tar writes"):
        walk(data)


def test_an_endless_hole_behind_the_archive_is_not_read_to_its_end(monkeypatch):
    class Hole(BytesShard):
        read = 0

        def read_at(self, offset, size):
            data = super().read_at(offset, size)
            self.read += size
            return data + bytes(min(size, self.size - offset) - len(data))

    monkeypatch.setattr(tar, "MAX_SEARCH_BYTES", 1 << 24)
    shard = Hole(write_tar([("a.jpg", b"a")]))
    shard.size = 1 << 50
    with pytest.raises(BadShard, match="zeros at its end"):
        list(walk_tar(shard))
    assert shard.read < 1 << 25


@pytest.mark.parametrize("zeros", [512, 1024, 4096])
def test_what_follows_the_end_is_reported_and_found(zeros):
    one = write_tar([("a.jpg", b"a")])[:1024]
    two = write_tar([("b.jpg", b"b")])
    faults = []
    assert walk(one + bytes(zeros) + two, faults.append) == [("a.jpg", b"a"), ("b.jpg", b"b")]
    assert len(faults) == 1 and "end of the archive" in faults[0].reason
    with pytest.raises(BadShard, match="end of the archive"):
        walk(one + bytes(zeros) + two)


def test_the_walk_goes_on_behind_a_damaged_header():
    entries = [("a.jpg", b"a" * 700), ("b.jpg", b"b" * 600), ("c.jpg", b"c")]
    data = bytearray(write_tar(entries))
    data[1536 + 130] ^= 1
    faults = []
    assert walk(bytes(data), faults.append) == [entries[0], entries[2]]
    assert [(fault.offset, fault.shard) for fault in faults] == [(1536, "memory.tar")]
    with pytest.raises(BadShard, match=r"memory.tar at byte 1,536: damaged header"):
        walk(bytes(data))


@pytest.mark.parametrize("lost", [-700, -512, -1, 1, 300, 512, 1024])
@pytest.mark.parametrize("place", [600, 1100, 1300])
def test_bytes_lost_or_inserted_in_a_member_cost_that_member_and_no_other(place, lost):
    entries = [("a.jpg", bytes(range(1, 256)) * 8), ("b.jpg", b"b" * 600), ("c.jpg", b"c")]
    data = write_tar(entries)
    damaged = data[:place] + b"x" * lost + data[place + max(0, -lost) :]
    faults = []
    assert walk(damaged, faults.append) == entries[1:]
    assert '"a.jpg" does not end where its size says' in faults[0].reason
    with pytest.raises(BadShard):
        walk(damaged)


def test_a_header_that_is_a_byte_off_is_none_though_its_sum_fits():
    data = write_tar([("a.jpg", b"abc"), ("b.jpg", b"b" * 600)])
    moved = data[:513] + data[514:1600] + b"b" + data[1600:]
    assert sum(moved[1024:1536]) == sum(data[1024:1536])
    faults = []
    assert walk(moved, faults.append) == [("b.jpg", b"b" * 600)]
    assert len(faults) == 2


def test_what_lies_in_a_nested_archive_is_never_found_even_when_its_header_is_damaged():
    inner = write_tar([("inner.jpg", b"x" * 3000), ("more.jpg", b"y")])
    data = write_tar([("a.jpg", b"a"), ("inner.tar", inner), ("b.jpg", b"b"), ("c.jpg", b"c")])
    header = data.index(b"inner.tar")
    for wiped in (data[header : header + 100] + b"9" + data[header + 101 : header + 512], bytes(512), b"\xff" * 512):
        faults = []
        found = walk(data[:header] + wiped + data[header + 512 :], faults.append)
        assert faults and set(found) <= {("a.jpg", b"a"), ("b.jpg", b"b"), ("c.jpg", b"c")} and found[-1] == ("c.jpg", b"c")


def test_the_inside_of_a_cut_off_archive_is_not_searched():
    inner = write_tar([("inner.jpg", b"x" * 3000), ("more.jpg", b"y")])
    data = write_tar([("a.jpg", b"a"), ("inner.tar", inner)])
    faults = []
    assert walk(data[:6000], faults.append) == [("a.jpg", b"a")]
    assert 'ends inside "inner.tar"' in faults[0].reason


def raw_header(name=b"a.jpg", size=b"00000000005\0", kind=b"0", magic=b"ustar\x0000", signed=False, tail=b""):
    block = bytearray(512)
    block[: len(name)] = name
    block[124 : 124 + len(size)] = size
    block[156:157] = kind
    block[257 : 257 + len(magic)] = magic
    block[345 : 345 + len(tail)] = tail
    block[148:156] = b" " * 8
    total = sum(block) - (256 * sum(byte > 127 for byte in block) if signed else 0)
    block[148:156] = b"%06o\0 " % total
    return bytes(block)


BODY = b"12345" + bytes(507)
END = bytes(1024)


@pytest.mark.parametrize(
    "header",
    [
        raw_header(magic=b""),
        raw_header(size=b"\x80" + bytes(10) + b"\x05"),
        raw_header(size=b"          5 "),
        raw_header(kind=b"\0"),
        raw_header(kind=b"7"),
        raw_header(magic=b"ustar  \0", tail=b"12345670123"),  # GNU keeps a time where ustar has the name's beginning
    ],
)
def test_headers_of_other_writers_are_read(header):
    assert walk(header + BODY + END) == [("a.jpg", b"12345")]


def test_a_block_whose_sum_fits_is_no_header_with_something_else_in_the_place_of_the_magic():
    with pytest.raises(BadShard, match="not a tar"):
        walk(raw_header(magic=b"other") + BODY + END)


def test_a_signed_checksum_is_accepted():
    name = "é.jpg".encode()
    assert walk(raw_header(name, signed=True) + BODY + END) == [("é.jpg", b"12345")]


def test_a_name_that_is_no_text_keeps_its_bytes():
    (name, _), *_ = walk(raw_header(b"\xff\xfe.jpg") + BODY + END)
    assert name.encode("utf-8", "surrogateescape") == b"\xff\xfe.jpg"


def test_other_kinds_of_members_are_told_apart_and_never_opened():
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as archive:
        for name, kind in {
            "folder": tarfile.DIRTYPE, "soft": tarfile.SYMTYPE, "hard": tarfile.LNKTYPE, "tty": tarfile.CHRTYPE,
            "disk": tarfile.BLKTYPE, "pipe": tarfile.FIFOTYPE,
        }.items():  # fmt: skip
            member = tarfile.TarInfo(name)
            member.type, member.linkname = kind, "/etc/hostname"
            archive.addfile(member)
        archive.addfile(tarfile.TarInfo("last.jpg"))
    kinds = [member.kind for member in walk_tar(BytesShard(stream.getvalue()))]
    assert kinds == ["folder", "link", "link", "device", "device", "device", "file"]


def test_an_unknown_kind_of_member_is_stepped_over():
    found = walk_tar(BytesShard(raw_header(b"odd", kind=b"Z") + BODY + raw_header() + BODY + END))
    assert [(member.name, member.kind) for member in found] == [("odd", "other"), ("a.jpg", "file")]


@pytest.mark.parametrize("kind", [b"L", b"x", b"g"])
def test_a_long_name_without_bound_is_not_read(kind):
    class Watched(BytesShard):
        largest = 0

        def read_at(self, offset, size):
            self.largest = max(self.largest, size)
            return super().read_at(offset, size)

    claimed = 64 * MAX_EXTENSION_BYTES
    shard = Watched(raw_header(size=b"%011o\0" % claimed, kind=kind) + BODY + END)
    with pytest.raises(BadShard, match="a long name of"):
        list(walk_tar(shard))
    assert shard.largest <= MAX_EXTENSION_BYTES


@pytest.mark.parametrize("size", [b"\xff" * 12, b"\x80" + b"\xff" * 11, b"7" * 12, b"99999999999\0"])
def test_a_senseless_size_is_damage(size):
    with pytest.raises(BadShard, match=r"size|ends inside"):
        walk(raw_header(size=size) + BODY + END)


def pax(body):
    return raw_header(kind=b"x", size=b"%011o\0" % len(body)) + body + bytes(-len(body) % 512)


@pytest.mark.parametrize(
    "body", [b"nonsense", b"99 path=a\n", b"5 a\n", b"0 path=x\n", b"11 path=abcd", b"12 size=abc\n", b"5006 size=" + b"9" * 4995 + b"\n"]
)
def test_damaged_pax_records_are_damage(body):
    faults = []
    assert walk(pax(body) + raw_header() + BODY + raw_header(b"z.jpg") + BODY + END, faults.append)[-1] == ("z.jpg", b"12345")
    assert len(faults) in (1, 2) and all("name" in fault.reason or "pax" in fault.reason for fault in faults)


def test_a_sparse_file_is_told_apart():
    body = b"22 GNU.sparse.major=1\n31 GNU.sparse.name=photo/a.jpg\n"
    (member,) = walk_tar(BytesShard(pax(body) + raw_header(b"GNUSparseFile.0/a.jpg") + BODY + END))
    assert (member.name, member.kind) == ("photo/a.jpg", "sparse")
    (member,) = walk_tar(BytesShard(raw_header(kind=b"S") + BODY + END))
    assert (member.name, member.kind) == ("a.jpg", "sparse")


def test_the_long_target_of_a_link_is_stepped_over():
    target = raw_header(b"././@LongLink", size=b"%011o\0" % 200, kind=b"K") + b"t" * 199 + bytes(313)
    found = walk_tar(BytesShard(target + raw_header(b"link.jpg", kind=b"2") + raw_header() + BODY + END))
    assert [(member.name, member.kind) for member in found] == [("link.jpg", "link"), ("a.jpg", "file")]


@pytest.mark.parametrize("extension", [raw_header(kind=b"L", size=b"00000000000\0"), pax(b"12 path=a\0b\n")], ids=["empty", "null"])
def test_a_name_of_nothing_or_with_a_null_is_damage_and_its_member_lost(extension):
    faults = []
    assert walk(extension + raw_header() + BODY + raw_header(b"z.jpg") + BODY + END, faults.append) == [("z.jpg", b"12345")]
    assert [("name" in fault.reason or "pax" in fault.reason) for fault in faults] == [True, True]


def test_the_name_of_an_author_is_no_header():
    entries = [("a.jpg", b"ustar" * 200), ("b.jpg", b"b")]
    data = write_tar(entries)
    assert tar.find_header(entries[0][1]) == -1
    faults = []
    assert walk(bytes([data[0] ^ 1]) + data[1:], faults.append) == entries[1:]


def test_an_archive_of_nothing_but_a_comment_is_whole():
    body = b"17 comment=hello\n"
    assert walk(raw_header(kind=b"g", size=b"%011o\0" % len(body)) + body + bytes(512 - len(body)) + END) == []


def test_a_pax_size_overrides_the_header():
    assert walk(pax(b"9 size=5\n") + raw_header(size=b"00000000000\0") + BODY + END) == [("a.jpg", b"12345")]


def test_global_pax_records_count_for_every_member_after_them():
    body = b"9 size=3\n"
    start = raw_header(kind=b"g", size=b"%011o\0" % len(body)) + body + bytes(512 - len(body))
    assert walk(start + raw_header() + BODY + raw_header(b"b.jpg") + BODY + END) == [("a.jpg", b"123"), ("b.jpg", b"123")]


@pytest.mark.parametrize(
    ("start", "says"),
    [
        (b"\x1f\x8b\x08", "gunzip"),
        (b"\x28\xb5\x2f\xfd", "unzstd"),
        (b"PK\x03\x04", "zip"),
        (b"<!DOCTYPE html>", "HTML"),
        (b"noise", "not a tar"),
    ],
)
def test_other_files_are_named(start, says):
    with pytest.raises(BadShard, match=says):
        walk(start + b"\x55" * 2000)


def size_record(size):
    return b"%d size=%d\n" % (len(str(size)) + 9, size)


kinds = st.sampled_from([b"0", b"1", b"2", b"5", b"L", b"K", b"x", b"g", b"S", b"7", b"Z"])
headers = st.builds(
    lambda name, kind, size: raw_header(name, b"%011o\0" % size, kind), st.binary(max_size=100), kinds, st.integers(0, 3000)
)
extensions = st.builds(pax, st.one_of(st.binary(max_size=60), st.integers(0, 2000).map(size_record), st.just(b"14 path=xx.jpg\n")))
blocks = st.one_of(headers, extensions, st.binary(min_size=512, max_size=512), st.just(bytes(512)), st.binary(max_size=700))


@given(st.lists(blocks, max_size=12))
@settings(max_examples=400)
def test_blocks_in_any_order_end_the_walk_with_members_inside_the_file_that_do_not_overlap(parts):
    data, faults = b"".join(parts), []
    members = list(walk_tar(BytesShard(data), faults.append))
    assert all(0 <= member.offset and member.offset + member.size <= len(data) for member in members)
    assert all(before.offset + before.size <= after.offset for before, after in itertools.pairwise(members))
    assert all(0 <= fault.offset <= len(data) and fault.reason for fault in faults)
    try:
        assert list(walk_tar(BytesShard(data))) == members and not faults
    except BadShard:
        assert faults


@given(st.binary(max_size=3000), st.integers(0, 3))
def test_noise_never_crashes_the_walk(noise, blocks):
    faults = []
    walk(raw_header() + BODY * (blocks > 0) + noise, faults.append)
    assert faults or not noise.strip(b"\0")
