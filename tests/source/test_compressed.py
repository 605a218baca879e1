"""Compressed tars to plain ones: whole or not at all, and never a bomb."""

import gzip
import io
import os

import fsspec
import pytest

from zsdata.faults import BadShard
from zsdata.source import compressed, http_ranges, ranges
from zsdata.source.archive import read_shard
from zsdata.source.compressed import decompress
from zsdata.source.retry import MissingShard, UnreachableShard

from .http_server import ScriptedServer, answer, cut, whole
from .test_tar import write_tar

PLAIN = write_tar([(f"{number}.jpg", os.urandom(3000)) for number in range(5)])


def files(folder):
    return sorted(path.name for path in folder.iterdir()) if folder.exists() else []


@pytest.mark.parametrize("name", ["a.tar.gz", "a.tgz", "a.TAR.GZ", "a.gz", "a.tar"])
def test_a_compressed_shard_becomes_the_plain_one(tmp_path, name):
    (tmp_path / name).write_bytes(gzip.compress(PLAIN))
    (path,) = decompress(tmp_path / name, tmp_path / "out")
    assert path == str(tmp_path / "out" / "a.tar")
    with open(path, "rb") as file:
        assert file.read() == PLAIN
    assert len(list(read_shard(path))) == 5 and len(files(tmp_path / "out")) == 1


def test_several_streams_in_one_file_are_one_shard(tmp_path):
    (tmp_path / "a.tar.gz").write_bytes(gzip.compress(PLAIN[:5000]) + gzip.compress(PLAIN[5000:]))
    (path,) = decompress([tmp_path / "a.tar.gz"], tmp_path / "out")
    assert len(list(read_shard(path))) == 5


@pytest.mark.parametrize("cut", [3, 9, 200, -9, -1])
def test_a_cut_off_file_leaves_nothing(tmp_path, cut):
    (tmp_path / "a.tar.gz").write_bytes(gzip.compress(PLAIN)[:cut])
    with pytest.raises(BadShard, match="ends inside the compressed data; download it again"):
        decompress(tmp_path / "a.tar.gz", tmp_path / "out")
    assert files(tmp_path / "out") == []


@pytest.mark.parametrize("place", [12, 2000, -6, -2])
def test_a_damaged_file_leaves_nothing(tmp_path, place):
    data = bytearray(gzip.compress(PLAIN))
    data[place] ^= 0x55
    (tmp_path / "a.tar.gz").write_bytes(data)
    with pytest.raises(BadShard, match=r"damaged gzip data|ends inside"):
        decompress(tmp_path / "a.tar.gz", tmp_path / "out")
    assert files(tmp_path / "out") == []


def test_a_bomb_is_stopped_and_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(compressed, "SMALL_BYTES", 1 << 20)
    (tmp_path / "a.tar.gz").write_bytes(gzip.compress(bytes(1 << 26)))
    with pytest.raises(BadShard, match="a bomb: grows to more than 100 times its size"):
        decompress(tmp_path / "a.tar.gz", tmp_path / "out")
    assert files(tmp_path / "out") == []


def test_what_is_there_stays_unless_it_may_be_replaced(tmp_path):
    (tmp_path / "a.tar.gz").write_bytes(gzip.compress(PLAIN))
    (tmp_path / "a.tar").write_bytes(b"old")
    with pytest.raises(FileExistsError, match=r"a\.tar is there already"):
        decompress(tmp_path / "a.tar.gz", tmp_path)
    assert (tmp_path / "a.tar").read_bytes() == b"old"
    decompress(tmp_path / "a.tar.gz", tmp_path, overwrite=True)
    assert (tmp_path / "a.tar").read_bytes() == PLAIN


def test_other_files_and_name_clashes_are_errors_in_words(tmp_path):
    (tmp_path / "a.tar").write_bytes(PLAIN)
    with pytest.raises(ValueError, match="not compressed with gzip or zstd; a plain tar is used as it is"):
        decompress(tmp_path / "a.tar", tmp_path / "out")
    for name in ("b.tgz", "b.tar.gz"):
        (tmp_path / name).write_bytes(gzip.compress(PLAIN))
    with pytest.raises(ValueError, match=r"two of the files would become b\.tar"):
        decompress([tmp_path / "b.tgz", tmp_path / "b.tar.gz"], tmp_path / "out")


def test_zstd_is_read_where_its_package_is_there_and_named_where_it_is_not(tmp_path, monkeypatch):
    (tmp_path / "a.tar.zst").write_bytes(b"\x28\xb5\x2f\xfdrest")
    monkeypatch.delitem(compressed.compr, "zstd", raising=False)
    with pytest.raises(ImportError, match="compressed with zstd: pip install zstandard, or unpack it with unzstd"):
        decompress(tmp_path / "a.tar.zst", tmp_path / "out")
    monkeypatch.setitem(compressed.compr, "zstd", lambda source, mode: io.BytesIO(PLAIN if source.read(8).endswith(b"rest") else b""))
    (path,) = decompress(tmp_path / "a.tar.zst", tmp_path / "out")
    assert len(list(read_shard(path))) == 5


def test_a_full_disk_is_no_damage(tmp_path, monkeypatch):
    (tmp_path / "a.tar.gz").write_bytes(gzip.compress(PLAIN))
    monkeypatch.setitem(compressed.compr, "gzip", lambda source, mode: _Full())
    with pytest.raises(OSError, match="No space left on device"):
        decompress(tmp_path / "a.tar.gz", tmp_path / "out")
    assert files(tmp_path / "out") == []


class _Full(io.BytesIO):
    def read(self, size=-1):
        raise OSError(28, "No space left on device")


def test_remote_files_are_read_too(tmp_path):
    fsspec.filesystem("memory").pipe("/compressed/a.tar.gz", gzip.compress(PLAIN))
    (path,) = decompress("memory://compressed/a.tar.gz", tmp_path / "out", progress=False)
    assert len(list(read_shard(path))) == 5


def test_files_behind_http_are_read_without_other_packages(tmp_path, monkeypatch):
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(ranges, "FIRST_BYTES", 1 << 10)
    monkeypatch.setattr(ranges, "WINDOW_BYTES", 1 << 12)
    monkeypatch.setattr(compressed, "CHUNK_BYTES", 1 << 11)
    with ScriptedServer() as server:
        url = server.put("a.tar.gz", gzip.compress(PLAIN)) + "?token=secret"
        server.script = [answer(503), cut(100)]
        (path,) = decompress(url, tmp_path / "out")
        assert len(list(read_shard(path))) == 5 and len(server.requests) > 5
        with pytest.raises(MissingShard, match=r"none\.tar\.gz: .*404"):
            decompress(url.replace("a.tar", "none.tar"), tmp_path / "out")
        server.always = whole
        with pytest.raises(UnreachableShard, match="the server ignores ranges; download the shard"):
            decompress(url, tmp_path / "out", overwrite=True)
        server.always = None
        plain = server.put("b.tar", PLAIN) + "?token=secret"
        with pytest.raises(ValueError, match=r"/b\.tar is not compressed"):
            decompress(plain, tmp_path / "out")
        http_ranges.close_connections()
    assert files(tmp_path / "out") == ["a.tar"]


def test_what_a_killed_run_left_stops_no_other(tmp_path):
    """In a container all runs have one process number."""
    (tmp_path / "a.tar.gz").write_bytes(gzip.compress(PLAIN))
    (tmp_path / f"a.tar.{os.getpid()}.partial").write_bytes(PLAIN[:700])
    (path,) = decompress(tmp_path / "a.tar.gz", tmp_path)
    assert len(list(read_shard(path))) == 5
