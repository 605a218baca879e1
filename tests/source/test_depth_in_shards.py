"""Depth maps as members of a shard: which photo each belongs to, in the listing, the index, the manifest, verify and pack."""

import json
import logging
import os
import tarfile

import numpy as np
import pytest

from zsdata.faults import BadPhoto, BadShard
from zsdata.source import archive, index
from zsdata.source.archive import read_shard
from zsdata.source.index import StaleIndex, list_shard, load_listing, write_index
from zsdata.source.manifest import build_manifest
from zsdata.source.pack import pack
from zsdata.source.verify import verify

from ..scenes import grey16, jpeg, npy, photo, write_tar

PHOTO = jpeg(photo(0, 40, 60))
DEPTH = np.arange(2400, dtype=np.float32).reshape(40, 60)
NPY, PNG = npy(DEPTH), grey16((DEPTH * 20).astype(np.uint16))


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("ZSDATA_CACHE", str(tmp_path_factory.mktemp("cache")))


def depths_of(manifest):
    """The key and the bytes of the depth map of each photo; None without one."""
    found = {}
    for number in range(len(manifest)):
        try:
            found[manifest.member(number).key] = manifest.read_depth(number)
        except BadPhoto as fault:
            assert fault.reason.startswith("no stored depth: ")
            found[manifest.member(number).key] = None
    return found


MEMBERS = {
    "late/0.depth.npy": b"before its photo",
    "a/1.jpg": b"1",
    "a/1.depth.png": b"one",
    "late/0.jpg": b"0",
    "b.JPG": b"2",
    "B.jpg": b"another",
    "b.Depth.PNG": b"two",
    "c.webp": b"3",
    "d.png": b"4",
    "c.json": b"{}",
    "d.depth.png": b"the second",
    "d.depth.npy": b"the first",
    "e.jpg": b"5",
    "e.depth.npy": b"the first",
    "e.depth.png": b"the second",
    "f.jpg": b"6",
    "f.depth.exr": b"no",
    "f.mask.png": b"no",
    "f.depth": b"no",
}
EXPECTED = {
    "a/1": b"one",
    "late/0": b"before its photo",
    "b": b"two",
    "B": None,
    "c": None,
    "d": b"the first",
    "e": b"the first",
    "f": None,
}


@pytest.mark.parametrize("indexed", [False, True])
def test_each_map_is_its_photos_and_of_two_the_npy_counts(tmp_path, indexed, monkeypatch):
    shard = write_tar(tmp_path / "a.tar", MEMBERS)
    if indexed:
        write_index(shard)
        monkeypatch.setattr(index, "list_shard", None)
    manifest = build_manifest(shard)
    assert depths_of(manifest) == EXPECTED and list(EXPECTED) == [manifest.member(i).key for i in range(8)]
    assert (manifest.depth_maps, manifest.problems) == (5, ())
    assert [key for key, _ in read_shard(shard)] == list(EXPECTED)


def test_the_index_changes_nothing_but_the_checksums(tmp_path):
    shards = [write_tar(tmp_path / "a.tar", MEMBERS), write_tar(tmp_path / "b.tar", {"x.jpg": b"1"})]
    before = build_manifest(shards)
    write_index(shards)
    after = build_manifest(shards)
    assert (after.digest, depths_of(after)) == (before.digest, depths_of(before))
    assert before.depth_checksums is not None and after.depth_checksums is not None and after.depth_offsets is not None
    assert (before.depth_checksums < 0).all() and np.array_equal(after.depth_checksums >= 0, after.depth_offsets >= 0)


def test_maps_that_cannot_be_taken_are_listed(tmp_path):
    path = tmp_path / "a.tar"
    with tarfile.open(write_tar(path, {"a.jpg": b"1", "a.depth.npy": b"first", "b.jpg": b"2"}), "a") as tar:
        link = tarfile.TarInfo("b.depth.npy")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        tar.addfile(link)
        for name in ("a.depth.NPY", "c.depth.npy"):
            tar.addfile(tarfile.TarInfo(name))
    manifest = build_manifest(path)
    assert [(problem.key, problem.reason) for problem in manifest.problems] == [
        ("b", "depth map not a regular file: link"),
        ("a", "duplicate depth map"),
        ("c", "no photo: only .depth.npy"),
    ]
    assert depths_of(manifest) == {"a": b"first", "b": None}


def test_a_map_larger_than_any_photo_is_listed_and_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(archive, "MAX_PHOTO_BYTES", 4)
    manifest = build_manifest(write_tar(tmp_path / "a.tar", {"a.jpg": b"1", "a.depth.npy": b"12345"}))
    assert depths_of(manifest) == {"a": None}
    assert [problem.reason for problem in manifest.problems] == ["depth map too large: 5 bytes, at most 4"]


def test_maps_without_any_photo_of_theirs_are_reported_by_those_who_read_photos_too(tmp_path):
    shard = write_tar(tmp_path / "a.tar", {"a.jpg": b"1", "b.depth.png": b"x"})
    faults = []
    assert list(read_shard(shard, faults.append)) == [("a", b"1")]
    assert [fault.reason for fault in faults] == ['no photo: only .depth.png ("b")']


def test_the_digest_changes_with_the_maps_and_stays_without_any(tmp_path):
    def digest(members):
        return build_manifest(write_tar(tmp_path / "s.tar", members)).digest

    photos = {"a.jpg": b"1", "b.jpg": b"2"}
    plain = digest(photos)
    variants = [
        photos | {"a.depth.npy": b"x"},
        photos | {"b.depth.npy": b"x"},
        photos | {"a.depth.npy": b"xy"},
        photos | {"a.depth.npy": b"x", "b.depth.npy": b"x"},
        photos | {"a.segm.npy": b"x"},
    ]
    digests = [digest(members) for members in variants]
    assert digest(photos) == plain
    assert digests[-1] == plain  # the tar's size is the same, filled up to whole records
    assert len({plain, *digests}) == len(variants)


def test_a_map_is_read_by_range_and_alone(tmp_path, monkeypatch):
    from zsdata.source import manifest as module

    manifest = build_manifest(write_tar(tmp_path / "a.tar", {"a.jpg": PHOTO, "a.depth.npy": NPY}))
    read, asked = module.read_range, []
    monkeypatch.setattr(module, "read_range", lambda url, offset, size, **more: asked.append(size) or read(url, offset, size, **more))
    manifest.read(0)
    assert asked == [len(PHOTO)]
    assert manifest.read_depth(0) == NPY and asked == [len(PHOTO), len(NPY)]


def test_a_map_that_swallowed_the_next_member_is_damage(tmp_path):
    shard = write_tar(tmp_path / "a.tar", {"a.jpg": b"a", "a.depth.npy": b"d" * 1200, "b.jpg": b"b" * 500, "c.jpg": b"c"})
    with open(shard, "rb") as file:
        data = file.read()
    start = 3 * 512
    with open(shard, "wb") as file:
        file.write(data[: start + 88] + data[start + 88 + 1024 :] + bytes(1024))
    manifest = build_manifest(shard)
    with pytest.raises(BadShard, match=r'"a\.depth" holds the header of another member'):
        manifest.read_depth(0)
    assert [problem.key for problem in write_index(shard).problems] == ["a"]


def test_an_index_of_the_version_without_maps_is_renewed_and_not_misread(tmp_path, caplog):
    shard = write_tar(tmp_path / "a.tar", {"a.jpg": b"1", "a.depth.npy": b"x"})
    write_index(shard)
    path = tmp_path / "a.tar.index.json"
    content = json.loads(path.read_bytes())
    old = {name: value for name, value in content.items() if not name.startswith("depth_") and name != "sha256"} | {"zsdata_index": 1}
    path.write_text(json.dumps({**old, "sha256": index._digest(old)}))
    assert depths_of(build_manifest(shard)) == {"a": b"x"}
    assert "no index of version 2" in caplog.text and "`zsdata index` renews them" in caplog.text
    report = write_index(shard)
    assert (report.unchanged, report.files) == (0, [str(path)])
    renewed = load_listing(shard)
    assert renewed is not None and list(renewed.depth_sizes) == [1]


@pytest.mark.parametrize(
    "change",
    [
        {"depth_offsets": [1536]},
        {"depth_offsets": []},
        {"depth_offsets": [512, -1]},  # where the photo is
        {"depth_offsets": [1536, 10**9]},
        {"depth_offsets": [-2, -1]},
        {"depth_offsets": [-1, -1]},  # with a size
        {"depth_offsets": None},
        {"depth_sizes": [-1, 0]},
        {"depth_sizes": [1100, 0]},
        {"depth_sizes": [1, 5]},
        {"depth_sizes": ["1", 0]},
        {"depth_crc32": [-1, -1]},
        {"depth_crc32": [2**32, -1]},
    ],
)
def test_an_index_whose_maps_cannot_be_is_not_believed(tmp_path, change):
    shard = write_tar(tmp_path / "a.tar", {"a.jpg": b"1", "a.depth.npy": b"x", "b.jpg": b"2"})
    write_index(shard)
    path = tmp_path / "a.tar.index.json"
    content = json.loads(path.read_bytes())
    assert load_listing(shard) is not None and content["depth_offsets"] == [1536, -1]
    content = {name: value for name, value in {**content, **change}.items() if name != "sha256"}
    path.write_text(json.dumps({**content, "sha256": index._digest(content)}))
    with pytest.raises(StaleIndex, match="or damaged"):
        load_listing(shard)


def test_a_shard_without_maps_has_no_columns_for_them(tmp_path):
    listing = list_shard(write_tar(tmp_path / "a.tar", {"a.jpg": b"1", "b.json": b"2"}))
    assert not listing.depth_offsets and build_manifest(tmp_path).depth_offsets is None


def flip(path, place):
    state = os.stat(path)
    with open(path, "r+b") as file:
        file.seek(place)
        byte = file.read(1)
        file.seek(place)
        file.write(bytes([byte[0] ^ 1]))
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))


def test_a_changed_byte_of_an_indexed_map_is_found_when_it_is_read_and_by_verify(tmp_path):
    shard = write_tar(tmp_path / "a.tar", {"a.jpg": PHOTO, "a.depth.npy": NPY})
    write_index(shard)
    assert (verify(shard).depth_maps, verify(shard).problems) == (1, [])
    manifest = build_manifest(shard)
    assert manifest.depth_offsets is not None
    flip(shard, int(manifest.depth_offsets[0]) + 1000)
    with pytest.raises(BadPhoto, match="stored depth damaged: other bytes than when the shard was indexed"):
        manifest.read_depth(0)
    assert manifest.read(0) == PHOTO
    report = verify(shard)
    assert [problem.reason for problem in report.problems] == ["stored depth damaged: other bytes than when the shard was indexed"]
    assert (report.photos, report.depth_maps) == (1, 0)


def test_verify_decodes_maps_and_names_those_a_stream_could_not_use(tmp_path):
    members = {
        "late.depth.npy": npy(DEPTH[:, :30]),
        "good.jpg": PHOTO,
        "good.depth.png": PNG,
        "late.jpg": PHOTO,
        "both.jpg": PHOTO,
        "both.depth.png": b"not looked at",
        "both.depth.npy": NPY,
        "bad.jpg": PHOTO,
        "bad.depth.png": PNG[:80],
        "nan.jpg": PHOTO,
        "nan.depth.npy": npy(DEPTH * np.nan),
        "none.jpg": PHOTO,
        "cut.jpg": PHOTO[:500],
        "cut.depth.npy": NPY,
    }
    shard = write_tar(tmp_path / "a.tar", members)
    report = verify(shard)
    assert (report.photos, report.depth_maps) == (6, 2)
    assert {problem.key: problem.reason.split(":")[0] for problem in report.problems} == {
        "late": "stored depth does not fit",
        "bad": "stored depth damaged",
        "nan": "stored depth not finite",
        "cut": "truncated",
    }
    offsets = {problem.key: problem.offset for problem in report.problems}
    with open(shard, "rb") as file:
        file.seek(offsets["bad"])
        assert file.read(80) == PNG[:80]


def test_verify_misses_the_maps_that_the_index_lists_and_names_those_it_does_not(tmp_path):
    shard = write_tar(tmp_path / "a.tar", {"a.jpg": PHOTO, "a.depth.npy": NPY, "b.jpg": PHOTO})
    write_index(shard)
    write_tar(tmp_path / "a.tar", {"a.jpg": PHOTO, "b.jpg": PHOTO, "b.depth.npy": NPY})
    assert {(problem.key, problem.reason) for problem in verify(shard).problems} == {
        ("a", "depth map lost: it was there when the shard was indexed"),
        ("b", "depth map not in the index of its shard"),
    }


@pytest.fixture
def folder(tmp_path):
    def write(files):
        for name, data in files.items():
            (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / "in" / name).write_bytes(data)
        return tmp_path / "in"

    return write


def names_in(report):
    names = []
    for shard in report.shards:
        with tarfile.open(shard) as tar:
            names.append(tar.getnames())
    return names


def test_pack_takes_a_map_with_its_photo_into_the_same_shard(folder, tmp_path):
    files = {
        "a.jpg": PHOTO,
        "a.depth.npy": NPY,
        "x/b.v2.JPG": PHOTO,
        "x/b.v2.Depth.PNG": PNG,
        "c.jpg": PHOTO,
        "d.jpg": PHOTO,
        "d.depth.png": NPY,
    }
    report = pack(folder(files), tmp_path / "out", photos_per_shard=2)
    assert names_in(report) == [["a.jpg", "a.depth.npy", "c.jpg"], ["d.jpg", "d.depth.npy", "x/b_v2.jpg", "x/b_v2.depth.png"]]
    assert (report.photos, report.depth_maps, report.skipped) == (4, 3, [])
    assert depths_of(build_manifest(tmp_path / "out")) == {"a": NPY, "c": None, "d": NPY, "x/b_v2": PNG}
    assert verify(tmp_path / "out").problems == []


def test_pack_names_the_maps_that_it_leaves_out_and_takes_none_for_a_photo(folder, tmp_path):
    files = {
        "a.jpg": PHOTO,
        "a.depth.npy": NPY,
        "a.depth.png": PNG,
        "b.jpg": PHOTO,
        "b.depth.npy": npy(DEPTH * 0),
        "bad.jpg": PHOTO[:300],
        "bad.depth.png": PNG,
        "alone.depth.png": PNG,
        "other.npy": NPY,
    }
    report = pack(folder(files), tmp_path / "out")
    assert names_in(report) == [["a.jpg", "a.depth.npy", "b.jpg"]]
    assert [(path, reason.split(":")[0]) for path, reason in report.skipped] == [
        ("b.depth.npy", "stored depth flat"),
        ("bad.jpg", "truncated"),
        ("a.depth.png", "a second depth map"),
        ("alone.depth.png", "a depth map whose photo is not packed"),
        ("bad.depth.png", "a depth map whose photo is not packed"),
    ]


def test_listing_says_nothing_more_where_there_are_no_maps(tmp_path, caplog):
    caplog.set_level(logging.DEBUG)
    build_manifest(write_tar(tmp_path / "a.tar", {"a.jpg": PHOTO}))
    assert not caplog.records
