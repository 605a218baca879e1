"""The manifest: every photo, where it lies, and a digest that travels."""

import os
import pickle
import tarfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsdata.faults import BadShard
from zsdata.source.archive import split_name
from zsdata.source.index import write_index
from zsdata.source.manifest import Manifest, build_manifest

from .test_tar import FORMATS, members, write_tar


def shards(folder, *contents):
    folder.mkdir(parents=True, exist_ok=True)
    for number, entries in enumerate(contents):
        (folder / f"s-{number}.tar").write_bytes(write_tar(entries))
    return folder


TWO = [("a.jpg", b"aa"), ("é/b.png", b"b" * 600), ("c.txt", b"c")], [("a.jpg", b"other"), ("d.webp", b"")]


def test_photos_of_all_shards_in_order(tmp_path):
    folder = shards(tmp_path / "x", *TWO)
    manifest = build_manifest(folder)
    assert len(manifest) == 4 and manifest.problems == ()
    assert [tuple(manifest.member(index)) for index in range(4)] == [
        (f"{folder}/s-0.tar", "a", 512, 2),
        (f"{folder}/s-0.tar", "é/b", 1536, 600),
        (f"{folder}/s-1.tar", "a", 512, 5),
        (f"{folder}/s-1.tar", "d", 1536, 0),
    ]
    assert [manifest.read(index) for index in range(4)] == [b"aa", b"b" * 600, b"other", b""]
    for index in (-1, 4):
        with pytest.raises(IndexError, match=f"photo {index} of a source with 4"):
            manifest.member(index)


@given(entries=members, archive_format=st.sampled_from(list(FORMATS.values())))
def test_the_manifest_agrees_with_tarfile(tmp_path_factory, entries, archive_format):
    entries = [("first.jpg", b"photo"), *((name + ".jpg", body) for name, body in entries)]
    try:
        data = write_tar(entries, archive_format)
    except ValueError:
        return
    path = tmp_path_factory.mktemp("agree") / "s.tar"
    path.write_bytes(data)
    expected, rejected = {}, 0
    with tarfile.open(path) as tar:
        for member in tar:
            named = split_name(member.name)
            if named is None or named[1] != "jpg":
                continue
            rejected += named[0] in expected
            expected.setdefault(named[0], tar.extractfile(member).read())
    manifest = build_manifest(path)
    assert {manifest.member(index).key: manifest.read(index) for index in range(len(manifest))} == expected
    assert len([problem for problem in manifest.problems if not problem.reason.startswith("no photo")]) == rejected


def test_the_digest_stays_when_the_folder_moves(tmp_path):
    there, here = shards(tmp_path / "x", *TWO), shards(tmp_path / "y" / "z", *TWO)
    assert build_manifest(there).digest == build_manifest(here).digest == build_manifest(f"file://{here}/s-{{0,1}}.tar").digest


def test_the_digest_changes_with_anything_else(tmp_path):
    digests = [
        build_manifest(shards(tmp_path / "0", *TWO)).digest,
        build_manifest([tmp_path / "0" / "s-1.tar", tmp_path / "0" / "s-0.tar"]).digest,
        build_manifest(tmp_path / "0" / "s-0.tar").digest,
        build_manifest(shards(tmp_path / "1", [("A.jpg", b"aa"), *TWO[0][1:]], TWO[1])).digest,
        build_manifest(shards(tmp_path / "2", [("a.jpg", b"aaa"), *TWO[0][1:]], TWO[1])).digest,
        build_manifest(shards(tmp_path / "3", TWO[0][::-1], TWO[1])).digest,
    ]
    (tmp_path / "0" / "s-1.tar").rename(tmp_path / "0" / "t-1.tar")
    digests.append(build_manifest(tmp_path / "0").digest)
    assert len(set(digests)) == len(digests)


def test_the_digest_is_pinned_so_that_old_states_resume(tmp_path):
    assert build_manifest(shards(tmp_path, *TWO)).digest == "e241810562bcc3d85bdd8576c90196e1b68cae0064104350cba34b4b09773899"


def test_a_pickled_manifest_is_the_same(tmp_path):
    manifest = build_manifest(shards(tmp_path, *TWO))
    again = pickle.loads(pickle.dumps(manifest))
    assert again.digest == manifest.digest and [again.member(i) for i in range(4)] == [manifest.member(i) for i in range(4)]


def test_a_million_photos_take_less_than_100_megabytes():
    count, key = 1_000_000, b"some/folder/of/photos/000000000001"
    manifest = Manifest(
        shard_urls=("s.tar",),
        shard_sizes=(1,),
        shard_numbers=np.zeros(count, np.int32),
        offsets=np.zeros(count, np.int64),
        sizes=np.zeros(count, np.int32),
        key_text=key * count,
        key_ends=np.arange(1, count + 1, dtype=np.int64) * len(key),
        problems=(),
        digest="",
    )
    assert manifest.member(count - 1).key == key.decode()
    assert len(pickle.dumps(manifest)) < 100e6


def test_what_cannot_be_taken_is_listed(tmp_path):
    folder = shards(tmp_path, [("a.jpg", b"1"), ("a.png", b"2"), ("b.tif", b"3")], [("c.jpg", b"4"), ("d.jpg", b"5" * 600)])
    with open(folder / "s-1.tar", "r+b") as file:
        file.truncate(512 * 4)
    manifest = build_manifest(folder)
    assert [manifest.member(index).key for index in range(len(manifest))] == ["a", "c"]
    assert [(problem.shard[-7:], problem.key, problem.offset, problem.reason) for problem in manifest.problems] == [
        ("s-0.tar", "a", 1536, "duplicate key"),
        ("s-0.tar", "b", 2560, "not a JPEG, PNG or WebP: .tif"),
        ("s-1.tar", None, 2048, 'ends inside "d.jpg" (512 of 600 bytes); download it again'),
    ]


def test_a_shard_that_changed_is_damage(tmp_path):
    manifest = build_manifest(shards(tmp_path, *TWO))
    os.utime(tmp_path / "s-1.tar", ns=(0, 7))
    with open(tmp_path / "s-0.tar", "r+b") as file:
        file.truncate(1600)
    for index, says in ((0, "size 10,240 then, 1,600 now"), (2, r"modified_ns \d+ then, 7 now")):
        with pytest.raises(BadShard, match=rf"s-\d.tar at byte .*: changed since it was listed: {says}"):
            manifest.read(index)


def test_a_shard_that_was_only_touched_is_read_where_an_index_knows_its_bytes(tmp_path):
    urls = shards(tmp_path, *TWO)
    write_index(urls)
    manifest = build_manifest(urls)
    os.utime(tmp_path / "s-0.tar", ns=(0, 7))
    assert manifest.read(0) == b"aa"


@pytest.mark.parametrize(
    ("entries", "says"),
    [
        ([("a.txt", b""), ("b.txt", b""), ("c.npy", b"")], r"it holds 2 \.txt, 1 \.npy\. A photo is a member named KEY\.jpg"),
        ([("a.tif", b"")], r"it holds 1 \.tif; a: not a JPEG, PNG or WebP: \.tif"),
        ([], "it holds no files"),
    ],
)
def test_a_source_without_photos_says_what_it_holds(tmp_path, entries, says):
    with pytest.raises(ValueError, match=says):
        build_manifest(shards(tmp_path, entries))


def test_a_compressed_shard_says_how_to_unpack_it(tmp_path):
    import gzip

    (tmp_path / "s.tar").write_bytes(gzip.compress(write_tar(TWO[0])))
    with pytest.raises(ValueError, match=r"compressed with gzip.*uncompressed tar; unpack it with gunzip"):
        build_manifest(tmp_path)
    (tmp_path / "t.tar").write_bytes(write_tar(TWO[0]))
    assert "gunzip" in build_manifest(tmp_path).problems[0].reason


def test_the_progress_bar_is_on_stderr_when_asked_for(tmp_path, capsys):
    folder = shards(tmp_path, *TWO)
    build_manifest(folder)
    assert capsys.readouterr() == ("", "")
    build_manifest(folder, progress=True)
    out, err = capsys.readouterr()
    assert not out and "indexing" in err
