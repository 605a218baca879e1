"""Which members are photos, and what read_shard yields of a whole or damaged shard."""

import io
import tarfile

import pytest
import webdataset
from webdataset.tariterators import base_plus_ext

from zsdata.faults import BadShard
from zsdata.source import archive
from zsdata.source.archive import read_shard, split_name

from .test_tar import raw_header, write_tar


@pytest.fixture
def shard(tmp_path):
    def write(*entries):
        path = tmp_path / "shard.tar"
        path.write_bytes(write_tar(entries))
        return str(path)

    return write


@pytest.mark.parametrize("name", ["a.jpg", "a.b/c.depth.PNG", "./x/y.tar.gz", "plain", "a/b.", "a.b/c", "é ü/ñ.JPG", "/abs/a.jpg"])
def test_keys_and_extensions_are_those_of_webdataset(name):
    key, extension = base_plus_ext(name)
    assert split_name(name) == (None if key is None else (key, extension.lower()))


def test_photos_come_in_order_with_their_bytes(shard):
    entries = [("b/2.jpg", b"two"), ("a.JPEG", b"one"), ("x.png", b""), ("y.webp", b"y" * 3000)]
    assert list(read_shard(shard(*entries))) == [("b/2", b"two"), ("a", b"one"), ("x", b""), ("y", b"y" * 3000)]


def test_what_is_no_photo_is_left_out(shard):
    others = [
        "a.txt",
        "a.cls",
        "a.json",
        "a.npy",
        "a.depth.png",
        "._b.jpg",
        ".c.jpg",
        "d/._e.jpg",
        "__MACOSX/f.jpg",
        "x/__MACOSX/f.jpg",
        "g",
    ]
    faults = []
    assert list(read_shard(shard(*((name, b"no") for name in others), ("a.jpg", b"yes")), faults.append)) == [("a", b"yes")]
    assert not faults


def test_the_first_photo_of_a_key_is_kept_and_the_second_reported(shard):
    url = shard(("a.jpg", b"1"), ("b.jpg", b"2"), ("a.png", b"3"), ("a.jpg", b"4"))
    faults = []
    assert list(read_shard(url, faults.append)) == [("a", b"1"), ("b", b"2")] == list(read_shard(url))
    assert [fault.reason for fault in faults] == ['duplicate key ("a")'] * 2


def test_a_sample_whose_photo_is_missing_is_reported_with_its_key(shard):
    url = shard(
        ("0.jpg", b"0"), ("0.json", b"{}"), ("1.json", b"{}"), ("1.txt", b""), ("2.tif", b""), ("2.json", b"{}"), ("readme.md", b"")
    )
    faults = []
    assert list(read_shard(url, faults.append)) == [("0", b"0")]
    assert [fault.reason for fault in faults] == ['not a JPEG, PNG or WebP: .tif ("2")', 'no photo: only .json, .txt ("1")']


def test_a_photo_with_a_dot_in_its_stem_is_reported_as_no_other_tool_finds_it_either(shard):
    faults = []
    assert not list(
        read_shard(
            shard(
                ("2024.05.01.jpg", b"0"),
            ),
            faults.append,
        )
    )
    assert [fault.reason for fault in faults] == [
        'no photo: the extension begins at the first dot of the name, .05.01.jpg; rename it ("2024")'
    ]


def test_each_photo_with_a_dot_in_its_stem_is_reported_not_one_for_all_that_share_a_key(shard):
    """As Dropbox names camera uploads: all of an hour have one key."""
    names = [f"2023-05-01 12.30.{second}.jpg" for second in range(11, 15)]
    faults = []
    assert [key for key, _ in read_shard(shard(*((name, b"0") for name in ("a.jpg", "b.jpg", *names))), faults.append)] == ["a", "b"]
    assert [fault.reason for fault in faults] == [
        f'no photo: the extension begins at the first dot of the name, .30.{second}.jpg; rename it ("2023-05-01 12")'
        for second in range(11, 15)
    ]
    assert len({fault.offset for fault in faults}) == 4


def test_photos_that_only_a_dot_makes_part_of_another_are_reported_and_annotations_are_not(shard):
    names = ["a.jpg", "a.mask.png", "a.json", "b.jpg", "b.mask.png", "scan.jpg", "scan.1.jpg", "scan.2.jpg", "scan.txt"]
    faults = []
    assert [key for key, _ in read_shard(shard(*((name, b"0") for name in names)), faults.append)] == ["a", "b", "scan"]
    assert [fault.reason for fault in faults] == [
        f'no photo of its own: the extension begins at the first dot of the name, .{number}.jpg; rename it if it is one ("scan")'
        for number in (1, 2)
    ]


def test_a_photo_that_swallowed_the_next_member_is_damage(shard):
    url = shard(("a.jpg", b"a" * 1200), ("b.jpg", b"b" * 500), ("c.jpg", b"c"))
    with open(url, "rb") as file:
        data = file.read()
    with open(url, "wb") as file:
        file.write(data[:600] + data[600 + 1024 :] + bytes(1024))  # as long as b.jpg with its header: c.jpg follows in its place
    faults = []
    assert list(read_shard(url, faults.append)) == [("c", b"c")]
    assert [fault.reason for fault in faults] == ['"a" holds the header of another member; download it again']
    with pytest.raises(BadShard, match="the header of another member"):
        list(read_shard(url))


def test_a_shard_that_was_not_written_to_its_end_is_damage_even_where_a_photo_began(shard):
    url = shard(("a.jpg", b"a" * 600), ("b.jpg", b"b" * 600), ("c.jpg", b"c" * 600))
    with open(url, "r+b") as file:
        file.seek(512 + 1024 + 512 + 100)
        file.write(bytes(512 * 5))
    faults = []
    assert [key for key, _ in read_shard(url, faults.append)] == ["a", "b"]
    assert [fault.reason for fault in faults] == ['zeros from inside "b" to the end: more may be missing; download it again']
    with pytest.raises(BadShard, match='zeros from inside "b" to the end'):
        list(read_shard(url))


def test_other_image_formats_are_reported_by_name(shard):
    faults = []
    assert not list(read_shard(shard(("a.tif", b""), ("b.GIF", b""), ("c.heic", b"")), faults.append))
    assert [fault.reason for fault in faults] == [
        f'not a JPEG, PNG or WebP: .{kind} ("{key}")' for kind, key in (("tif", "a"), ("gif", "b"), ("heic", "c"))
    ]


def test_links_under_a_photo_name_are_reported_and_not_followed(tmp_path):
    with tarfile.open(tmp_path / "links.tar", "w") as tar:
        for name, kind in (("a.jpg", tarfile.SYMTYPE), ("b.jpg", tarfile.LNKTYPE)):
            member = tarfile.TarInfo(name)
            member.type, member.linkname = kind, "/etc/hostname"
            tar.addfile(member)
    faults = []
    assert not list(read_shard(str(tmp_path / "links.tar"), faults.append))
    assert [fault.reason for fault in faults] == ['not a regular file: link ("a")', 'not a regular file: link ("b")']


def test_damage_raises_or_is_reported(shard):
    url = shard(("a.jpg", b"a" * 600), ("b.jpg", b"b" * 600))
    with open(url, "r+b") as file:
        file.truncate(512 + 1024 + 512 + 100)
    with pytest.raises(BadShard, match=r'shard.tar at byte 2,148: ends inside "b.jpg" \(100 of 600 bytes\); download it again'):
        list(read_shard(url))
    faults = []
    assert list(read_shard(url, faults.append)) == [("a", b"a" * 600)]
    assert len(faults) == 1


def test_every_cut_of_a_shard_yields_whole_photos_only(tmp_path):
    photos = {"a": b"a" * 600, "b": b"b" * 20, "c": b"c" * 1024}
    data = write_tar([(f"{key}.jpg", photo) for key, photo in photos.items()])
    path = tmp_path / "cut.tar"
    for cut in [*range(0, 4608, 7), *range(505, 520), *range(2040, 2060)]:
        path.write_bytes(data[:cut])
        faults = []
        found = dict(read_shard(str(path), faults.append))
        assert found.items() <= photos.items() and faults


def test_a_photo_larger_than_any_photo_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(archive, "MAX_PHOTO_BYTES", 4)
    (tmp_path / "large.tar").write_bytes(raw_header() + b"12345" + bytes(507 + 1024))
    faults = []
    assert not list(read_shard(str(tmp_path / "large.tar"), faults.append))
    assert faults[0].reason.startswith("too large: 5 bytes, at most 4")


def test_a_shard_behind_fsspec_reads_the_same(shard):
    import fsspec

    url = shard(("a.jpg", b"a" * 600), ("b.jpg", b"b" * 70_000))
    with open(url, "rb") as file:
        fsspec.filesystem("memory").pipe("/read/shard.tar", file.read())
    assert list(read_shard("memory://read/shard.tar")) == list(read_shard(url)) == list(read_shard("file://" + url))


def test_webdatasets_own_tars_are_read(tmp_path):
    stream = io.BytesIO()
    with webdataset.TarWriter(stream) as writer:
        for number in range(3):
            writer.write({"__key__": f"{number:03d}", "jpg": bytes([number]) * 900, "json": {"caption": "a photo"}, "cls": number})
    (tmp_path / "w.tar").write_bytes(stream.getvalue())
    assert list(read_shard(str(tmp_path / "w.tar"))) == [(f"{number:03d}", bytes([number]) * 900) for number in range(3)]
