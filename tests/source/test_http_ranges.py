"""Shards behind http: with any fault of the server the right bytes, or a clear error in time."""

import socket
import threading
import time
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest

from tests.source.http_server import (
    ScriptedServer,
    answer,
    cut,
    drip,
    drip_headers,
    elsewhere,
    garbage,
    hang_up_after,
    parts_of,
    reset,
    serve,
    stall,
    whole,
)
from zsdata.faults import BadShard
from zsdata.source import http_ranges, retry
from zsdata.source.ranges import ShardFile, read_range
from zsdata.source.retry import ChangedShard, MissingShard, RefusedShard, UnreachableShard

DATA = np.random.default_rng(0).bytes(300_000)
STALL = 0.1
TOKEN = "?X-Amz-Signature=secret"


@pytest.fixture
def server(monkeypatch):
    """A server, and short pauses."""
    for name in ("http_proxy", "https_proxy", "all_proxy"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)
    monkeypatch.setattr(retry, "FIRST_PAUSE_SECONDS", 0.001)
    monkeypatch.setattr(retry, "LONGEST_PAUSE_SECONDS", 0.02)
    with ScriptedServer() as server:
        yield server
        http_ranges.close_connections()


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(retry, "STALL_SECONDS", STALL)
    monkeypatch.setattr(retry, "GIVE_UP_SECONDS", 0.3)


@pytest.fixture
def url(server):
    return server.put("a/s.tar", DATA, ETag='"1"') + TOKEN


def read(url, offset=1000, size=100_000, **more):
    return read_range(url, offset, size, inside='"k"', **more)


def test_ranges_are_read_exactly_by_one_connection(server, url):
    for offset, size in ((0, 1), (0, len(DATA)), (7, 100), (299_999, 1), (1000, 200_000)):
        assert read(url, offset, size) == DATA[offset : offset + size]
    assert len({request.connection for request in server.requests}) == 1
    assert {request.path for request in server.requests} == {"/a/s.tar" + TOKEN}


def test_an_open_shard_reads_anywhere_and_ahead(server, url):
    with ShardFile(url) as file:
        assert (file.size, file.stamp) == (len(DATA), {"size": len(DATA), "ETag": '"1"'})
        for offset in range(0, 300_000, 1000):
            assert file.read_at(offset, 512) == DATA[offset : offset + 512]
        assert file.read_at(250_000, 1 << 30) == DATA[250_000:]
        assert file.read_at(5, 10) == DATA[5:15]
        assert file.read_at(300_000, 1) == file.read_at(1 << 40, 1) == b""
    assert len(server.requests) <= 5


def test_an_empty_shard_has_no_bytes(server):
    with ShardFile(server.put("empty.tar", b"")) as file:
        assert file.size == 0 and file.read_at(0, 10) == b""


@pytest.mark.parametrize("fault", [cut, reset, stall], ids=["cut", "reset", "stall"])
def test_an_answer_broken_off_anywhere_is_taken_up_where_it_broke(server, url, fault, monkeypatch):
    monkeypatch.setattr(retry, "STALL_SECONDS", 0.02)
    generator = np.random.default_rng(1)
    for point in [0, 1, 99_999, *generator.integers(0, 100_000, 50)]:
        server.script = [fault(int(point))]
        assert read(url) == DATA[1000:101_000], point
    assert sum(int(request.headers["Range"].split("-")[0][6:]) > 1000 for request in server.requests) >= 8


PASSING = {
    **{str(status): answer(status) for status in (408, 429, 500, 502, 503, 504, 520)},
    "reset before the headers": reset(),
    "garbage": garbage,
    "another range": elsewhere,
}


@pytest.mark.parametrize("fault", PASSING.values(), ids=PASSING.keys())
def test_a_fault_that_passes_changes_no_byte(server, url, fault):
    server.script = [fault]
    assert read(url) == DATA[1000:101_000]
    assert len(server.requests) == 2
    server.script = [serve, fault, fault, serve]
    with ShardFile(url) as file:
        assert file.read_at(70_000, 200_000) == DATA[70_000:270_000]


def test_every_fault_at_once_changes_no_byte(server, url, monkeypatch):
    monkeypatch.setattr(retry, "STALL_SECONDS", STALL)
    server.script = [answer(503), cut(10_000), reset(3), answer(500), reset(), stall(), stall(30_000), parts_of(77), cut(0), garbage]
    assert read(url) == DATA[1000:101_000]


LASTING = {401: RefusedShard, 403: RefusedShard, 404: MissingShard, 410: MissingShard, 400: UnreachableShard, 501: UnreachableShard}


@pytest.mark.parametrize(("status", "error"), LASTING.items())
def test_a_lasting_fault_is_said_at_once(server, url, status, error):
    server.always = answer(status)
    with pytest.raises(error, match=rf"http://127.0.0.1:\d+/a/s.tar: bytes 1,000 to 101,000 cannot be read: {status} .*; check") as caught:
        read(url)
    assert "secret" not in str(caught.value) and caught.value.__suppress_context__
    assert len(server.requests) == 1
    with pytest.raises({MissingShard: FileNotFoundError, RefusedShard: PermissionError}.get(error, OSError)):
        ShardFile(url)


HOPELESS = {
    "503": answer(503),
    "429 for an hour": answer(429, Retry_After="3600"),
    "reset": reset(),
    "reset after a byte": reset(1),
    "cut": cut(0),
    "stall": stall(),
    "stall in the body": stall(20_000),
    "drip": drip(0.002),
    "drip in the headers": drip_headers(0.02),
    "garbage": garbage,
}


@pytest.mark.parametrize("fault", HOPELESS.values(), ids=HOPELESS.keys())
def test_a_fault_that_stays_is_a_clear_error_in_time(server, url, fault, impatient):
    server.always = fault
    start = time.monotonic()
    with pytest.raises(
        UnreachableShard, match=r"s.tar: bytes 1,000 to 101,000 .*cannot be read: tried \d+ times in .*; run again"
    ) as caught:
        read(url)
    assert time.monotonic() - start < retry.GIVE_UP_SECONDS + 3 * STALL + 1
    assert "secret" not in str(caught.value) and len(server.requests) > 1


@pytest.mark.slow
@pytest.mark.parametrize("fault", [stall(), stall(2000), drip(1.0), drip_headers(1.0), answer(503), reset(1)])
def test_a_fault_that_stays_ends_within_a_minute(server, url, fault, monkeypatch):
    monkeypatch.undo()
    server.always = fault
    start = time.monotonic()
    with pytest.raises(UnreachableShard):
        read(url)
    assert 30 < time.monotonic() - start < 60


def test_a_server_that_is_not_there_is_a_clear_error(server, impatient):
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))  # and does not listen
        with pytest.raises(UnreachableShard, match=r"connection refused \d+ times; run again when the server answers"):
            read(f"http://127.0.0.1:{held.getsockname()[1]}/s.tar")
    with pytest.raises(UnreachableShard, match=r"its host is not known .*check the host"):
        read("http://no-such-host.invalid/s.tar")


def test_the_pauses_grow_differ_and_follow_the_server(server, url, monkeypatch):
    pauses, now = [], [0.0]
    clock = SimpleNamespace(monotonic=lambda: now[0], time=lambda: 1_000_000_000.0)
    monkeypatch.setattr(retry, "pause", lambda seconds: (pauses.append(seconds), now.__setitem__(0, now[0] + seconds)))
    monkeypatch.setattr(retry, "time", clock)
    monkeypatch.setattr(retry, "FIRST_PAUSE_SECONDS", 0.1)
    monkeypatch.setattr(retry, "LONGEST_PAUSE_SECONDS", 5.0)
    monkeypatch.setattr(retry, "GIVE_UP_SECONDS", 35.0)
    server.script = [answer(503)] * 8
    assert read(url) == DATA[1000:101_000]
    expected = [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0]
    assert all(base <= pause <= 1.5 * base for base, pause in zip(expected, pauses, strict=True))
    assert len({pause / base for base, pause in zip(expected, pauses, strict=True)}) > 1
    for header, asked in (("7", 7), ("Sun, 09 Sep 2001 01:46:50 GMT", 10), ("3600", 35), ("soon", 0.1), ("-5", 0.1)):
        pauses.clear()
        server.script = [answer(429, Retry_After=header)]
        assert read(url) == DATA[1000:101_000]
        assert asked - 1e-9 <= pauses[0] <= min(35, 1.5 * asked) + 1e-9, header  # the clock adds up what it is told, and rounds
    server.always = answer(503)
    pauses.clear()
    with pytest.raises(UnreachableShard, match=r"tried \d+ times in 35 s: 503 Service Unavailable \d+ times"):
        read(url)
    assert sum(pauses) == pytest.approx(35) and 10 <= len(pauses) <= 13


# What the server sends instead


def test_a_server_that_ignores_ranges_serves_the_start_and_is_refused_beyond(server, url):
    server.always = whole
    assert read(url, 0, 5000) == DATA[:5000] and read(url, 0, len(DATA)) == DATA
    before = len(server.requests)
    with pytest.raises(UnreachableShard, match="the server ignores ranges; download the shard or use another server"):
        read(url)
    assert len(server.requests) == before + 1
    with ShardFile(url) as file, pytest.raises(UnreachableShard, match="ignores ranges"):
        file.read_at(200_000, 10)


def test_a_whole_shard_is_not_taken_in_for_one_range(server):
    url = server.put("large.tar", bytes(200_000_000))
    server.always = whole
    start = time.monotonic()
    with pytest.raises(UnreachableShard, match="ignores ranges"):
        read(url)
    assert read(url, 0, 100) == bytes(100)
    assert time.monotonic() - start < 1


def test_a_body_that_is_compressed_or_without_a_size_is_refused(server, url):
    for act, says in (
        (answer(200, b"packed", Content_Encoding="gzip"), "compresses what it sends"),
        (answer(206, b"12345", Content_Range="bytes 1000-1004/*"), "does not say how large the file is"),
    ):
        server.script = [act]
        with pytest.raises(UnreachableShard, match=says):
            read(url)


def test_a_server_that_sends_less_at_a_time_is_asked_more_often(server, url):
    server.always = parts_of(9000)
    assert read(url) == DATA[1000:101_000] and len(server.requests) == 12


def test_a_shard_that_ends_before_is_damage(server, url):
    with pytest.raises(BadShard, match=r'ends inside "k" \(1,000 of 5,000 bytes\); download it again') as caught:
        read(url, 299_000, 5000)
    assert caught.value.offset == 300_000 and "secret" not in str(caught.value)
    with pytest.raises(BadShard, match=r"0 of 10 bytes"):
        read(url, 400_000, 10)


def test_redirects_are_followed_to_other_servers_but_not_without_end_nor_out_of_http(server, url):
    with ScriptedServer() as other:
        target = other.put("there.tar", DATA)
        server.always = answer(302, Location=target)
        assert read(url) == DATA[1000:101_000] == read(url)
        assert len({request.connection for request in server.requests}) == len({request.connection for request in other.requests}) == 1
        server.always = answer(301, Location="/a/s.tar")
        with pytest.raises(UnreachableShard, match="redirects more than 5 times"):
            read(url)
        for location in ("file:///etc/passwd", "ftp://127.0.0.1/s.tar", "http://[", "http://a..b/"):
            server.always = answer(302, Location=location)
            with pytest.raises(UnreachableShard, match=r"redirects to what is not http|an address that cannot be used"):
                read(url)


def test_credentials_in_an_address_are_sent_to_its_server_only_and_never_said(server, url):
    url = url.replace("http://", "http://user:p%40ss@")
    assert read(url) == DATA[1000:101_000]
    assert server.requests[0].headers["Authorization"] == "Basic dXNlcjpwQHNz"
    with ScriptedServer() as other:
        server.script = [answer(302, Location=other.put("there.tar", DATA))]
        assert read(url) == DATA[1000:101_000]
        assert "Authorization" not in other.requests[0].headers
    server.always = answer(404)
    with pytest.raises(MissingShard) as caught:
        read(url)
    assert "p%40ss" not in str(caught.value) and "user" not in str(caught.value)


def test_odd_letters_in_an_address_are_quoted(server):
    url = server.put("f%C3%BC%20r/a.tar", DATA).replace("%C3%BC", "ü").replace("%20", " ")
    assert read(url) == DATA[1000:101_000]


def test_a_proxy_is_used_where_the_environment_names_one(server, url, monkeypatch):
    monkeypatch.setenv("http_proxy", f"http://me:pw@127.0.0.1:{server.server_port}")
    monkeypatch.setenv("no_proxy", "localhost")
    server.put("a.tar", DATA)
    assert read("http://127.0.0.1/a.tar") == DATA[1000:101_000]
    assert server.requests[0].path == "http://127.0.0.1/a.tar"
    assert server.requests[0].headers["Proxy-Authorization"].startswith("Basic ")


def test_a_connection_that_the_server_closed_meanwhile_is_no_fault(server, url, monkeypatch):
    monkeypatch.setattr(retry, "GIVE_UP_SECONDS", -1.0)  # nothing is tried again
    server.always = hang_up_after
    for _ in range(5):
        assert read(url) == DATA[1000:101_000]
        time.sleep(0.01)


def test_threads_read_at_the_same_time(server, url):
    results = []

    def work(seed):
        generator = np.random.default_rng(seed)
        for offset in generator.integers(0, 200_000, 20):
            results.append(read(url, int(offset), 1000) == DATA[offset : offset + 1000])

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert results == [True] * 160
    assert len(http_ranges._idle) <= http_ranges.IDLE_CONNECTIONS


# Another shard in its place


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        ({"ETag": '"1"'}, {"ETag": '"2"'}, 'ETag "1" then, "2" now'),
        ({"Last_Modified": "Mon"}, {"Last_Modified": "Tue"}, "Last-Modified Mon then, Tue now"),
        ({}, {}, "size 300,000 then, 299,999 now"),
    ],
)
def test_a_shard_that_changed_is_named_and_none_of_it_is_read(server, before, after, says):
    other = bytes(300_000) if before else bytes(299_999)
    url = server.put("s.tar", DATA, **before)
    with ShardFile(url) as file:
        server.put("s.tar", other, **after)
        for reading in (
            lambda: file.read_at(200_000, 10),
            lambda: read(url, stamp=file.stamp),
            lambda: read(url, 500_000, 1, stamp=file.stamp),
        ):
            with pytest.raises(ChangedShard, match=f"changed since it was listed: {says}; start again") as caught:
                reading()
            assert caught.value.shard == url
    assert read(url) == other[1000:101_000]


def test_a_shard_that_changes_between_two_tries_is_never_put_together(server, url):
    def replaced(handler, file):
        server.put("a/s.tar", bytes(300_000), ETag='"2"')
        cut(5000)(handler, file)

    server.script = [replaced]
    with pytest.raises(ChangedShard, match="changed since it was listed"):
        read(url)


def test_a_stamp_is_held_only_against_what_a_server_says(server, url):
    stamp = {"size": len(DATA), "ETag": '"1"'}
    server.put("a/s.tar", DATA)  # no tag: a mirror
    assert read(url, stamp=stamp) == DATA[1000:101_000]
    assert Counter(request.path for request in server.requests).total() == 1
