"""Ranged reads: all bytes or an error."""

import os

import fsspec
import pytest

from zsdata.faults import BadShard
from zsdata.source import fsspec_ranges
from zsdata.source.ranges import ShardFile, read_range


@pytest.fixture(params=["path", "file", "memory"])
def url(request, tmp_path):
    data = bytes(range(200))
    (tmp_path / "s.tar").write_bytes(data)
    if request.param == "memory":
        fsspec.filesystem("memory").pipe("/ranges/s.tar", data)
        return "memory://ranges/s.tar"
    return ("file://" if request.param == "file" else "") + str(tmp_path / "s.tar")


def test_a_range_is_read_exactly(url):
    assert read_range(url, 10, 5) == bytes(range(10, 15))
    assert read_range(url, 0, 200) == bytes(range(200))
    assert read_range(url, 100, 0) == b""


def test_a_range_beyond_the_end_is_damage_and_never_fewer_bytes(url):
    with pytest.raises(BadShard, match=r'ends inside "k" \(10 of 20 bytes\)') as caught:
        read_range(url, 190, 20, inside='"k"')
    assert caught.value.offset == 200


def test_an_open_shard_reads_anywhere(url):
    with ShardFile(url) as file:
        assert file.size == 200
        assert file.read_at(150, 10) == bytes(range(150, 160))
        assert file.read_at(0, 3) == b"\0\1\2"
        assert file.read_at(195, 10) == bytes(range(195, 200))
        assert file.read_at(200, 1) == file.read_at(9000, 1) == b""


def test_reading_leaves_no_file_open(tmp_path):
    (tmp_path / "s.tar").write_bytes(bytes(10))
    before = len(os.listdir("/proc/self/fd"))
    read_range(str(tmp_path / "s.tar"), 0, 5)
    with pytest.raises(BadShard):
        read_range(str(tmp_path / "s.tar"), 0, 50)
    with ShardFile(str(tmp_path / "s.tar")):
        pass
    assert len(os.listdir("/proc/self/fd")) == before


def test_a_server_that_ignores_ranges_is_named(monkeypatch):
    memory = fsspec.filesystem("memory")
    memory.pipe("/ranges/s.tar", bytes(200))
    monkeypatch.setattr(type(memory), "cat_file", lambda self, path, start=None, end=None: bytes(200))
    with pytest.raises(OSError, match="ignores ranges; download"):
        read_range("memory://ranges/s.tar", 0, 10)


def test_a_missing_package_is_named_with_its_cure(monkeypatch):
    def missing(url):
        raise ImportError("Install s3fs to access S3")

    monkeypatch.setattr(fsspec_ranges, "url_to_fs", missing)
    with pytest.raises(ImportError, match=r's3://b/s.tar: Install s3fs.*pip install "zsdata\[remote\]"'):
        ShardFile("s3://b/s.tar")


def test_a_missing_remote_shard_is_an_error():
    with pytest.raises(FileNotFoundError):
        ShardFile("memory://ranges/missing.tar")
