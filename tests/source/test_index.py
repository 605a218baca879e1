"""The index: what it saves, when it is not believed, and what it finds."""

import json
import os
from pathlib import Path

import fsspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsdata.faults import BadPhoto
from zsdata.source import index
from zsdata.source.index import StaleIndex, load_listing, write_index
from zsdata.source.manifest import build_manifest
from zsdata.source.verify import verify

from ..scenes import jpeg, photo, photo_tar, write_tar


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    """A cache of its own for each test."""
    folder = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("ZSDATA_CACHE", str(folder))
    return folder


def all_of(manifest):
    return [(*manifest.member(i), manifest.read(i)) for i in range(len(manifest))], manifest.problems, manifest.digest, manifest.shard_sizes


def test_with_an_index_the_manifest_is_the_same_and_no_header_is_read(tmp_path, monkeypatch, caplog):
    for number in range(3):
        photo_tar(tmp_path / f"{number}.tar", count=2, first_seed=number)
    write_tar(tmp_path / "3.tar", {"a.jpg": b"1", "a.png": b"2", "b.tif": b"3", "\udcff.jpg": b"4"})
    before = all_of(build_manifest(tmp_path))
    report = write_index(tmp_path)
    assert (report.shards, report.photos, report.unchanged, len(report.problems)) == (4, 8, 0, 2)
    assert sorted(report.files) == [str(tmp_path / f"{number}.tar.index.json") for number in range(4)]
    monkeypatch.setattr(index, "list_shard", None)
    assert all_of(build_manifest(tmp_path)) == before
    assert not caplog.records


def test_only_what_changed_is_indexed_again(tmp_path):
    shards = [photo_tar(tmp_path / f"{number}.tar", count=1) for number in range(2)]
    write_index(shards)
    photo_tar(tmp_path / "1.tar", count=2)
    report = write_index(shards)
    assert (report.unchanged, report.files) == (1, [f"{shards[1]}.index.json"])
    assert len(build_manifest(shards)) == 3


@pytest.mark.parametrize("change", ["longer", "same size", "touched"])
def test_the_index_of_a_changed_shard_is_ignored_with_a_word(tmp_path, change, caplog):
    shard = write_tar(tmp_path / "a.tar", {"a.jpg": b"1", "b.jpg": b"2"})
    write_index(shard)
    write_tar(
        tmp_path / "a.tar",
        {"longer": {"a.jpg": b"1" * 9000}, "same size": {"c.jpg": b"3", "d.jpg": b"4"}}.get(change, {"a.jpg": b"1", "b.jpg": b"2"}),
    )
    os.utime(shard, ns=(0, 10**18))
    manifest = build_manifest(shard)
    assert [manifest.member(i).key for i in range(len(manifest))] == {"longer": ["a"], "same size": ["c", "d"]}.get(change, ["a", "b"])
    (record,) = caplog.records
    assert (
        record.getMessage()
        == f"1 of 1 indexes are not used, the first as {shard}.index.json is older than its shard; `zsdata index` renews them"
    )


def broken(text):
    content = json.loads(text)

    def signed(**changes):
        changed = {**content, **changes}
        changed.pop("sha256")
        return json.dumps({**changed, "sha256": index._digest(changed)}).encode()

    yield from (b"", text[: len(text) // 2], b"null", b"[]", b"{}", b"[" * 100_000, b"\xff\xfe", text.replace(b'"a"', b'"z"'))
    yield from (signed(zsdata_index=1), signed(shard="b.tar"), signed(keys=["a"]), signed(keys=["a", "a"]), signed(keys=["a", 5]))
    yield from (signed(offsets=[512, 512]), signed(offsets=[-512, 1536]), signed(offsets=[512, 1e9]), signed(offsets=[512, 10**30]))
    yield from (
        signed(sizes=[1, 10**9]),
        signed(sizes=[1, -1]),
        signed(sizes=[1, 2**29]),
        signed(crc32=[0, 2**32]),
        signed(crc32=[0, None]),
    )
    yield from (
        signed(problems=[["a", 5]]),
        signed(problems=[["a", "5", ""]]),
        signed(stamp={}),
        signed(stamp=5),
        signed(stamp={"size": "x"}),
    )


def test_an_index_that_no_one_wrote_is_ignored_with_a_word(tmp_path, caplog):
    shard = write_tar(tmp_path / "a.tar", {"a.jpg": b"1", "b.jpg": b"2"})
    write_index(shard)
    text = (tmp_path / "a.tar.index.json").read_bytes()
    expected = all_of(build_manifest(shard))
    for number, changed in enumerate(broken(text)):
        (tmp_path / "a.tar.index.json").write_bytes(changed)
        with pytest.raises(StaleIndex, match="no index of version 2, or damaged"):
            load_listing(shard)
        assert all_of(build_manifest(shard)) == expected
        assert len(caplog.records) == number + 1


@given(st.binary(max_size=300))
def test_noise_is_no_index(tmp_path_factory, noise):
    shard = write_tar(tmp_path_factory.mktemp("noise") / "a.tar", {"a.jpg": b"1"})
    with open(f"{shard}.index.json", "wb") as file:
        file.write(noise)
    with pytest.raises(StaleIndex):
        load_listing(shard)


def test_an_index_too_large_to_be_one_is_not_read(tmp_path, monkeypatch):
    shard = write_tar(tmp_path / "a.tar", {"a.jpg": b"1"})
    monkeypatch.setattr(index, "MAX_INDEX_BYTES", 10)
    write_index(shard)
    with pytest.raises(StaleIndex, match="too large for an index"):
        load_listing(shard)


def test_a_changed_byte_is_found_when_a_photo_is_read_and_by_verify(tmp_path):
    shard = photo_tar(tmp_path / "a.tar", count=3)
    write_index(shard)
    assert (verify(shard).photos, verify(shard).indexed) == (3, 1)
    manifest, state = build_manifest(shard), os.stat(shard)
    _, key, offset, size = manifest.member(1)
    with open(shard, "r+b") as file:
        file.seek(offset + size // 2)
        byte = file.read(1)
        file.seek(offset + size // 2)
        file.write(bytes([byte[0] ^ 4]))
    for time in (state.st_mtime_ns, 5):
        os.utime(shard, ns=(0, time))
        report = verify(shard)
        assert [(problem.key, problem.reason) for problem in report.problems] == [(key, index.CHANGED_BYTES)]
        assert report.photos == 2
    with pytest.raises(BadPhoto, match="other bytes than when the shard was indexed"):
        manifest.read(1)
    assert manifest.read(0) and manifest.read(2)


def test_an_indexed_photo_that_no_longer_decodes_is_one_problem(tmp_path):
    shard = photo_tar(tmp_path / "a.tar", count=3)
    write_index(shard)
    _, key, offset, size = build_manifest(shard).member(1)
    with open(shard, "r+b") as file:
        file.seek(offset)
        file.write(bytes(size))
    report = verify(shard)
    assert [(problem.key, problem.reason) for problem in report.problems] == [(key, "only zeros")]
    assert report.photos == 2


def test_verify_misses_what_the_index_lists_and_names_what_it_does_not(tmp_path):
    photos = {key: jpeg(photo(number)) for number, key in enumerate("abc")}
    shard = write_tar(tmp_path / "a.tar", {f"{key}.jpg": data for key, data in photos.items()})
    write_index(shard)
    size = os.path.getsize(shard)
    write_tar(tmp_path / "a.tar", {"a.jpg": photos["a"], "c.jpg": photos["c"], "d.jpg": photos["a"]})
    with open(shard, "ab") as file:
        file.truncate(size)
    reasons = {(problem.key, problem.reason) for problem in verify(shard).problems if problem.key}
    assert reasons == {("d", "not in the index of its shard"), ("b", "lost: it was there when the shard was indexed")}
    write_tar(tmp_path / "a.tar", {"a.jpg": photos["a"]})
    (problem,) = verify(shard).problems
    assert "index not usable" in problem.reason and "older than its shard" in problem.reason


def test_a_folder_that_cannot_be_written_leaves_the_index_in_the_cache(tmp_path, cache, monkeypatch):
    shard = photo_tar(tmp_path / "a.tar", count=1)
    beside = f"{shard}.index.json"
    monkeypatch.setattr(index.Path, "write_text", lambda path, *rest, **more: _refuse(path, beside) or _write(path, *rest, **more))
    report = write_index(shard)
    assert len(report.files) == 1 and report.files[0].startswith(str(cache))
    assert load_listing(shard).keys == ["000000"]
    assert os.listdir(tmp_path) == ["a.tar"]


_write = index.Path.write_text


def _refuse(path, beside):
    if str(path).startswith(beside):
        raise PermissionError(13, "Permission denied", str(path))


def test_where_neither_can_be_written_the_error_is_told(tmp_path, monkeypatch):
    shard = photo_tar(tmp_path / "a.tar", count=1)
    monkeypatch.setattr(index.Path, "write_text", lambda path, *rest, **more: _refuse(path, "/"))
    with pytest.raises(PermissionError):
        write_index(shard)


def test_the_index_of_a_remote_shard_is_in_the_cache_and_goes_stale_with_it(tmp_path, cache, caplog):
    memory = fsspec.filesystem("memory")
    data = Path(photo_tar(tmp_path / "a.tar", count=2)).read_bytes()
    memory.pipe("/index/a.tar", data)
    report = write_index("memory://index/a.tar")
    assert [os.path.dirname(path) for path in report.files] == [str(cache / "index")]
    manifest = build_manifest("memory://index/a.tar")
    assert len(manifest) == 2 and (manifest.checksums >= 0).all() and not caplog.records
    memory.pipe("/index/a.tar", data)
    assert (build_manifest("memory://index/a.tar").checksums < 0).all() and len(caplog.records) == 1


def test_a_shard_that_changes_while_it_is_indexed_gets_no_index(tmp_path, monkeypatch):
    shard = photo_tar(tmp_path / "a.tar", count=1)
    whole = index.list_shard
    monkeypatch.setattr(index, "list_shard", lambda *given, **more: (whole(*given, **more), os.utime(shard, ns=(0, 7)))[0])
    with pytest.raises(OSError, match=r"a\.tar changed while it was indexed"):
        write_index(shard)
    assert os.listdir(tmp_path) == ["a.tar"]


def test_a_photo_that_swallowed_another_member_is_a_problem_of_the_index(tmp_path):
    shard = write_tar(tmp_path / "a.tar", {"a.jpg": b"a" * 1200, "b.jpg": b"b" * 500, "c.jpg": b"c"})
    data = Path(shard).read_bytes()
    with open(shard, "wb") as file:
        file.write(data[:600] + data[600 + 1024 :] + bytes(1024))
    report = write_index(shard)
    assert (report.photos, [problem.key for problem in report.problems]) == (1, ["a"])


def test_the_progress_bar_is_on_stderr_when_asked_for(tmp_path, capsys):
    write_index(photo_tar(tmp_path / "a.tar", count=1), progress=True)
    out, err = capsys.readouterr()
    assert not out and "indexing" in err


def test_an_index_that_cannot_be_finished_leaves_the_old_one_and_nothing_beside_it(tmp_path, monkeypatch):
    tar = photo_tar(tmp_path / "a.tar", 2)
    write_index(tar)
    photo_tar(tmp_path / "a.tar", 3)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def fails(*paths):
        raise OSError("out of luck")

    monkeypatch.setattr("os.replace", fails)
    with pytest.raises(OSError, match="out of luck"):
        write_index(tar)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
