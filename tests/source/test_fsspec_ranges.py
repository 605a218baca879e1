"""Shards behind fsspec: whatever a file system raises, the right bytes or a clear error in our own words."""

import time

import fsspec
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from zsdata.faults import BadShard
from zsdata.source import fsspec_ranges, retry
from zsdata.source.ranges import ShardFile, read_range
from zsdata.source.retry import ChangedShard, MissingShard, RefusedShard, UnreachableShard

DATA = bytes(range(256)) * 12_000  # three pieces
URL = "faulty://bucket/s.tar"


class Faulty(MemoryFileSystem):
    """Memory whose reads first do what a script says."""

    protocol = "faulty"
    cachable = False
    script: list = []  # noqa: RUF012
    reads: list = []  # noqa: RUF012
    looks: list = []  # noqa: RUF012

    def cat_file(self, path, start=None, end=None, **more):
        self.reads.append((start, end))
        act = self.script.pop(0) if self.script else None
        if isinstance(act, BaseException):
            raise act
        data = super().cat_file(path, start=start, end=end)
        return data if act is None else act(data)

    def info(self, path, **more):
        self.looks.append(path)
        return super().info(path, **more)


class ClientError(Exception):
    """As botocore's."""

    def __init__(self, status, headers=None):
        super().__init__("An error occurred when calling the GetObject operation")
        self.response = {"ResponseMetadata": {"HTTPStatusCode": status, "HTTPHeaders": headers or {}}}


class ClientResponseError(Exception):
    """As aiohttp's."""

    def __init__(self, status):
        super().__init__(f"{status}, message='', url='https://storage.googleapis.com/b/s.tar?X-Signature=secret'")
        self.status, self.headers = status, None


class HttpError(Exception):
    """As gcsfs's."""

    def __init__(self, status):
        super().__init__("rate limit")
        self.code = status


class HTTPStatusError(Exception):
    """As httpx's and requests'."""

    def __init__(self, status):
        super().__init__("error")
        self.response = type("Response", (), {"status_code": status, "headers": {}})()


class NoCredentialsError(Exception):
    """As botocore's."""


def came_from(error, cause):
    error.__cause__ = cause
    return error


@pytest.fixture(autouse=True)
def bucket(monkeypatch):
    fsspec.register_implementation("faulty", Faulty, clobber=True)
    monkeypatch.setattr(retry, "FIRST_PAUSE_SECONDS", 0.001)
    monkeypatch.setattr(retry, "LONGEST_PAUSE_SECONDS", 0.01)
    monkeypatch.setattr(retry, "GIVE_UP_SECONDS", 0.1)
    fsspec_ranges._looked.clear()
    for seen in (Faulty.script, Faulty.reads, Faulty.looks):
        seen.clear()
    Faulty().pipe(URL, DATA)


def read(offset=1000, size=100_000, **more):
    return read_range(URL, offset, size, inside='"k"', **more)


PASSING = [
    ConnectionResetError(104, "Connection reset by peer"),
    TimeoutError(),
    OSError("Could not connect to the endpoint"),
    Exception("some library's own"),
    ClientError(503),
    ClientError(500),
    ClientResponseError(502),
    HttpError(429),
    HTTPStatusError(504),
    came_from(OSError(5, "SlowDown"), ClientError(503)),
    lambda data: data[:-1],
    lambda data: b"",
]


@pytest.mark.parametrize("fault", PASSING, ids=str)
def test_a_fault_that_passes_changes_no_byte(fault):
    Faulty.script += [fault, fault, fault]
    assert read() == DATA[1000:101_000]
    assert len(Faulty.reads) > 3


def test_a_read_of_many_pieces_goes_on_where_it_broke_off():
    Faulty.script += [None, None, ConnectionResetError()]
    assert read(0, len(DATA)) == DATA
    assert [start for start, _ in Faulty.reads] == [0, 1 << 20, 2 << 20, 2 << 20]


def test_a_piece_that_came_short_is_completed_before_the_next_one():
    Faulty.script += [None, lambda data: data[:-5]]
    assert read(0, len(DATA)) == DATA


LASTING = [
    (FileNotFoundError(2, "The specified key does not exist."), MissingShard, "not found; check the address"),
    (PermissionError("Access Denied"), RefusedShard, "access is refused; check the credentials"),
    (ClientError(403), RefusedShard, "403 Forbidden; check the credentials"),
    (ClientResponseError(404), MissingShard, "404 Not Found; check the address"),
    (HTTPStatusError(401), RefusedShard, "401 Unauthorized"),
    (NoCredentialsError("Unable to locate credentials"), RefusedShard, "NoCredentialsError: Unable to locate credentials; sign in"),
    (TypeError("cat_file() got an unexpected argument"), UnreachableShard, "TypeError: .*; check the url"),
    (lambda data: DATA, UnreachableShard, "the server ignores ranges; download"),
]


@pytest.mark.parametrize(("fault", "error", "says"), LASTING, ids=[says for *_, says in LASTING])
def test_a_lasting_fault_is_said_at_once(fault, error, says):
    Faulty.script += [fault] * 5
    with pytest.raises(error, match=f"{URL}: bytes 1,000 to 101,000 cannot be read: {says}") as caught:
        read()
    assert len(Faulty.reads) == 1 and "secret" not in str(caught.value) and caught.value.__suppress_context__


def test_a_fault_that_stays_is_a_clear_error_in_time():
    Faulty.script += [OSError("broken https://user:pw@host/s.tar?token=secret pipe")] * 1000
    with pytest.raises(
        UnreachableShard, match=r"tried \d+ times in 0 s: OSError: broken https://host/s.tar pipe \d+ times; run again"
    ) as caught:
        read()
    assert "secret" not in str(caught.value) and "pw" not in str(caught.value)


def test_a_call_that_never_returns_is_a_stall(monkeypatch):
    monkeypatch.setattr(retry, "STALL_SECONDS", 0.05)
    Faulty.script += [lambda data: time.sleep(5)]
    assert read() == DATA[1000:101_000]
    Faulty.script += [lambda data: time.sleep(5)] * 20
    start = time.monotonic()
    with pytest.raises(UnreachableShard, match=r"stalled \d+ times"):
        read()
    assert time.monotonic() - start < 2


def test_retry_after_is_heard_from_any_library(monkeypatch):
    pauses = []
    monkeypatch.setattr(retry, "GIVE_UP_SECONDS", 100.0)
    monkeypatch.setattr(retry, "pause", pauses.append)
    Faulty.script += [ClientError(429, {"retry-after": "7"})]
    read()
    assert 7 <= pauses[0] <= 10.5


def test_a_shard_that_changed_is_named():
    with ShardFile(URL) as file:
        assert file.size == len(DATA) and "created" in file.stamp
        Faulty().pipe(URL, bytes(len(DATA)))
        for reading in (lambda: file.read_at(2_000_000, 1_100_000), lambda: read(0, 2_000_000, stamp=file.stamp)):
            with pytest.raises(ChangedShard, match=r"changed since it was listed: created .* then, .* now"):
                reading()


def test_a_shard_is_looked_at_again_after_a_while(monkeypatch):
    with ShardFile(URL) as file:
        assert read(stamp=file.stamp) == read(stamp=file.stamp) == DATA[1000:101_000]
        assert len(Faulty.looks) == 1  # by the one that opened it
        Faulty().pipe(URL, bytes(len(DATA)))
        monkeypatch.setattr(fsspec_ranges, "RECHECK_SECONDS", 0.0)
        with pytest.raises(ChangedShard):
            read(stamp=file.stamp)


def test_a_shard_that_changes_while_it_is_read_is_never_put_together():
    def replaced(data):
        Faulty().pipe(URL, bytes(len(DATA)))
        return data

    Faulty.script += [None, replaced]
    with pytest.raises(ChangedShard):
        read(0, len(DATA))
    Faulty().pipe(URL, DATA)
    fsspec_ranges._looked.clear()
    Faulty.script += [lambda data: replaced(data)[:500]]
    with pytest.raises(ChangedShard):
        read()


def test_a_shard_that_ends_before_is_damage():
    with pytest.raises(BadShard, match=r'ends inside "k" \(72,000 of 100,000 bytes\)'):
        read(3_000_000)
