"""Remote shards in worker processes, however they were started, from a parent that has read before."""

import hashlib
import multiprocessing
import os
import subprocess
import sys

import fsspec
import numpy as np
import pytest
from fsspec.asyn import AsyncFileSystem

from tests.source.http_server import ScriptedServer, answer, cut, reset, serve
from zsdata.source import http_ranges, retry
from zsdata.source.ranges import ShardFile, read_range
from zsdata.source.shard_cache import ShardCache

DATA = np.random.default_rng(0).bytes(400_000)
OFFSETS = [int(offset) for offset in np.random.default_rng(1).integers(0, 390_000, 20)]


class Asynchronous(AsyncFileSystem):
    """A file system with an event loop in a thread, as s3fs and gcsfs are."""

    protocol = "asynchronous"

    async def _info(self, path, **more):
        return {"name": path, "size": len(DATA), "type": "file", "ETag": "1"}

    async def _cat_file(self, path, start=None, end=None, **more):
        return DATA[start:end]


def digest(urls, stamps, cache):
    """What a process reads of the shards."""
    fsspec.register_implementation("asynchronous", Asynchronous, clobber=True)
    reads = [
        read_range(url, offset, 10_000, stamp=stamp, cache=cache) for url, stamp in zip(urls, stamps, strict=True) for offset in OFFSETS
    ]
    return hashlib.sha256(b"".join(reads)).hexdigest()


def report(urls, stamps, cache, queue):
    queue.put(digest(urls, stamps, cache))


@pytest.fixture
def server(monkeypatch):
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(retry, "FIRST_PAUSE_SECONDS", 0.001)
    with ScriptedServer() as server:
        yield server
        http_ranges.close_connections()


@pytest.mark.parametrize("method", ["fork", "forkserver", "spawn"])
def test_children_read_what_the_parent_reads(server, tmp_path, method):
    fsspec.register_implementation("asynchronous", Asynchronous, clobber=True)
    urls = [server.put("s.tar", DATA, ETag='"1"'), "asynchronous://bucket/s.tar"]
    expected = hashlib.sha256(b"".join(DATA[offset : offset + 10_000] for offset in OFFSETS) * 2).hexdigest()
    stamps = []
    for url in urls:
        with ShardFile(url) as file:
            stamps.append(file.stamp)
    assert digest(urls, stamps, None) == expected
    server.script = [act for _ in range(8) for act in (serve, cut(4000), answer(503), reset(10))]
    context = multiprocessing.get_context(method)
    queue = context.Queue()
    children = [context.Process(target=report, args=(urls, stamps, cache, queue)) for cache in (None, ShardCache(tmp_path, 1 << 20))]
    for child in children:
        child.start()
    assert digest(urls, stamps, None) == expected  # at the same time
    assert [queue.get(timeout=60) for _ in children] == [expected] * 2
    for child in children:
        child.join(60)
        assert child.exitcode == 0
    assert len({request.connection for request in server.requests}) >= 3  # nobody shares one


def test_a_connection_has_one_owner(server):
    url = server.put("s.tar", DATA)
    read_range(url, 0, 1000)
    (of_parent,) = {request.connection for request in server.requests}
    child = multiprocessing.get_context("fork").Process(target=read_range, args=(url, 0, 1000))
    child.start()
    child.join(60)
    read_range(url, 0, 1000)
    assert [request.connection == of_parent for request in server.requests] == [True, False, True]


def test_an_interpreter_ends_at_once_although_a_call_still_hangs(tmp_path):
    script = (
        "import time\nfrom zsdata.source.time_limit import within\n"
        "try:\n    within(0.1, lambda: time.sleep(60))\nexcept TimeoutError as error:\n    print(error)\n"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=30, cwd=os.getcwd())
    assert (result.returncode, result.stdout) == (0, "no answer for 0.1 s\n")
