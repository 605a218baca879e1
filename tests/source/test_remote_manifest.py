"""Sources behind a web server: the same manifest, photos and pairs as from a local disk, whatever the server does in between."""

import threading
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from tests.scenes import photo_tar
from tests.source.http_server import ScriptedServer, answer, cut, garbage, parts_of, reset, serve, stall
from tests.test_stream import by_index, open_stream
from zsdata.faults import BadShard
from zsdata.source import http_ranges, ranges, retry
from zsdata.source.archive import read_shard
from zsdata.source.index import load_or_list, write_index
from zsdata.source.manifest import build_manifest
from zsdata.source.retry import MissingShard
from zsdata.source.shard_cache import ShardCache
from zsdata.source.verify import verify

TOKEN = "?X-Amz-Signature=secret"


@pytest.fixture
def server(monkeypatch, tmp_path):
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(retry, "FIRST_PAUSE_SECONDS", 0.001)
    monkeypatch.setattr(retry, "LONGEST_PAUSE_SECONDS", 0.02)
    monkeypatch.setattr(ranges, "WINDOW_BYTES", 1 << 13)
    monkeypatch.setattr(ranges, "FIRST_BYTES", 1 << 10)
    monkeypatch.setenv("ZSDATA_CACHE", str(tmp_path / "indexes"))
    with ScriptedServer() as server:
        yield server
        http_ranges.close_connections()


@pytest.fixture
def local(tmp_path):
    return [photo_tar(tmp_path / f"{number}.tar", count=5, first_seed=10 * number) for number in range(2)]


@pytest.fixture
def remote(server, local):
    return [server.put(Path(path).name, Path(path).read_bytes(), ETag=f'"{path}"') + TOKEN for path in local]


def unsteady(seed, count=60):
    """Good and bad answers, some of them cut at random points."""
    generator = np.random.default_rng(seed)
    faults = [answer(500), answer(503), answer(429), reset(), garbage, parts_of(700)]
    for point in generator.integers(0, 9000, 6):
        faults += [cut(int(point)), reset(int(point))]
    return [serve if generator.random() < 0.4 else faults[generator.integers(len(faults))] for _ in range(count)]


def test_a_source_is_the_same_behind_a_server_that_fails_all_the_time(server, local, remote):
    expected = build_manifest(local)
    for seed in range(5):
        server.script = unsteady(seed)
        manifest = build_manifest(remote)
        assert (manifest.digest, manifest.problems) == (expected.digest, ())
        assert [manifest.read(i) for i in range(len(manifest))] == [expected.read(i) for i in range(len(expected))]
        server.script = unsteady(seed + 100)
        assert list(read_shard(remote[0])) == list(read_shard(local[0]))
    assert sum(request.path.endswith(TOKEN) for request in server.requests) == len(server.requests) > 100


def test_pairs_are_the_same_behind_a_server_that_fails_all_the_time(server, local, remote, monkeypatch):
    expected = by_index(open_stream(local))
    monkeypatch.setattr(retry, "STALL_SECONDS", 0.3)
    server.script = unsteady(1)
    stream = open_stream(remote)
    server.script = [stall(500), *unsteady(2)]
    pairs = []
    for pair in stream:
        assert pair.meta["shard"].startswith("http://127.0.0.1:") and "secret" not in pair.meta["shard"]
        pair.meta["shard"] = local[int(pair.meta["shard"][-5])]
        pairs.append(pair)
    assert by_index(pairs) == expected and len(server.script) < 55


def test_an_index_of_a_remote_shard_is_used_until_the_shard_changes(server, remote):
    write_index(remote)
    server.requests.clear()
    manifest = build_manifest(remote)
    assert (manifest.checksums >= 0).all() and len(server.requests) == 2  # one look at each
    server.put("0.tar", server.files["0.tar"].data, ETag='"2"')
    assert (build_manifest(remote).checksums < 0).sum() == 5
    with pytest.raises(BadShard, match="changed since it was listed: ETag"):
        manifest.read(0)


def test_shards_that_differ_in_their_query_have_indexes_of_their_own(server, local, tmp_path):
    datas = [Path(path).read_bytes() for path in local]

    def by_query(handler, file):
        query = handler.path.partition("?")[2]
        serve(handler, file._replace(data=datas[int(query[3])]))

    server.always = by_query
    url = server.put("download", b"")
    urls = [f"{url}?id={number}&X-Amz-Signature=secret" for number in range(2)]
    report = write_index(urls)
    assert len(set(report.files)) == 2 and not any("secret" in Path(file).name + Path(file).read_text() for file in report.files)
    signed_anew = [f"{url}?id={number}&X-Amz-Signature=other" for number in range(2)]
    assert (write_index(signed_anew).unchanged, build_manifest(signed_anew).problems) == (2, ())
    expected = build_manifest(local)
    manifest = build_manifest(signed_anew)
    assert [manifest.read(i) for i in range(len(manifest))] == [expected.read(i) for i in range(len(expected))]
    assert (manifest.checksums >= 0).all()


@pytest.fixture
def long_walks(server, tmp_path, monkeypatch):
    """Shards that take many requests to list."""
    monkeypatch.setattr(ranges, "WINDOW_BYTES", 1 << 9)
    data = Path(photo_tar(tmp_path / "long.tar", count=30)).read_bytes()
    return [server.put(f"long-{number}.tar", data) for number in range(20)]


def most_requests_of_one(server):
    return max(Counter(request.path for request in server.requests).values())


def test_where_a_shard_is_missing_no_read_of_the_others_goes_on(server, long_walks):
    build_manifest(long_walks[0])
    assert most_requests_of_one(server) > 30
    server.requests.clear()
    told = threading.Event()

    def after_the_missing_one(handler, file):
        if "missing" in handler.path:
            answer(404)(handler, file)
            told.set()
        else:
            told.wait(60)
            handler.server.closing.wait(0.1)
            serve(handler, file)

    server.always = after_the_missing_one
    with pytest.raises(MissingShard, match=r"missing\.tar: .*404"):
        build_manifest([long_walks[0].replace("long-0", "missing"), *long_walks])
    assert most_requests_of_one(server) < 10 and len({request.path for request in server.requests}) <= 17


@pytest.mark.parametrize("retries", [False, True])
def test_who_stops_listing_does_not_wait_for_the_shards_being_listed(server, long_walks, retries, monkeypatch):
    monkeypatch.setattr(retry, "FIRST_PAUSE_SECONDS", 600.0)
    monkeypatch.setattr(retry, "LONGEST_PAUSE_SECONDS", 600.0)
    monkeypatch.setattr(retry, "GIVE_UP_SECONDS", 600.0)
    gate = threading.Event()

    def others_wait(handler, file):
        if "long-0" not in handler.path:
            gate.wait(60)
            handler.server.closing.wait(0.1)
            if retries:
                answer(503)(handler, file)
                return
        serve(handler, file)

    server.always = others_wait
    listings = load_or_list(long_walks, [])
    assert len(next(listings).keys) == 30
    server.requests.clear()
    gate.set()
    listings.close()
    assert not server.requests or most_requests_of_one(server) < 10


def test_with_a_cache_every_photo_is_read_once_from_the_server(server, remote, tmp_path):
    manifest = build_manifest(remote)
    server.requests.clear()
    cache = ShardCache(tmp_path / "cache", 10 << 20)
    epochs = [[manifest.read(i, cache) for i in range(len(manifest))] for _ in range(3)]
    assert epochs[0] == epochs[1] == epochs[2] and len(server.requests) == len(manifest)


def test_verify_names_what_cannot_be_read_and_goes_on(server, remote, tmp_path):
    before = server.files["0.tar"]

    def replaced(handler, file):
        server.put("0.tar", bytes(len(before.data)), ETag='"2"')
        serve(handler, file)

    server.script = [replaced]
    report = verify([*remote, remote[0].replace("0.tar", "2.tar")])
    assert report.photos == 5 + sum(problem.key is not None for problem in report.problems if problem.key)
    reasons = {problem.shard[-5:]: problem.reason for problem in report.problems}
    assert reasons["0.tar"].startswith("changed since it was listed") and "404 Not Found" in reasons["2.tar"]
    assert not any("secret" in str(problem) for problem in report.problems)
