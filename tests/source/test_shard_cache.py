"""The shard cache: what a server gave, or a miss; bounded, and shared by processes."""

import logging
import multiprocessing
import os
import pickle
from contextlib import suppress

import numpy as np
import pytest

from zsdata import folder_ledger
from zsdata.source.ranges import read_range
from zsdata.source.shard_cache import ShardCache

STAMP = {"size": 500_000, "ETag": '"1"'}
URL = "https://host/s.tar?token=1"
PLENTY = 100 << 20


def photo(number, size=5000):
    return np.random.default_rng(number).bytes(size)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr(folder_ledger, "RECOUNT_PAUSE", 0.0)
    return ShardCache(tmp_path / "cache", PLENTY)


def entries(folder):
    return [os.path.join(place, name) for place, _, names in os.walk(folder) for name in names if name.endswith(".shard")]


def test_what_is_stored_comes_back_for_the_same_range_of_the_same_shard(cache):
    assert cache.store(URL, STAMP, 1000, photo(1)) is True
    assert pickle.loads(pickle.dumps(cache)).load(URL, dict(reversed(STAMP.items())), 1000, 5000) == photo(1)
    for other in (
        (URL + "2", STAMP, 1000, 5000),
        (URL, {**STAMP, "ETag": '"2"'}, 1000, 5000),
        (URL, STAMP, 1001, 5000),
        (URL, STAMP, 1000, 4999),
    ):
        assert cache.load(*other) is None
    assert cache.store(URL, STAMP, 0, b"") and cache.load(URL, STAMP, 0, 0) == b""


def test_a_damaged_entry_is_a_miss_and_stored_anew(cache):
    cache.store(URL, STAMP, 0, photo(1, 300))
    (path,) = entries(cache.folder)
    with open(path, "rb") as file:
        data = file.read()
    for damaged in [
        *(data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :] for at in range(len(data))),
        *(data[:length] for length in range(0, len(data), 7)),
        data + b"\0",
        bytes(len(data)),
    ]:
        with open(path, "wb") as file:
            file.write(damaged)
        assert cache.load(URL, STAMP, 0, 300) is None and not os.path.exists(path)
    assert cache.store(URL, STAMP, 0, photo(1, 300)) and cache.load(URL, STAMP, 0, 300) == photo(1, 300)


def test_an_entry_in_anothers_place_is_a_miss(cache):
    cache.store(URL, STAMP, 0, photo(1))
    (first,) = entries(cache.folder)
    cache.store(URL, STAMP, 5000, photo(2))
    (second,) = set(entries(cache.folder)) - {first}
    os.replace(second, first)
    assert cache.load(URL, STAMP, 0, 5000) is None


def test_a_full_cache_keeps_what_it_has_and_says_so_once(tmp_path, caplog):
    caplog.set_level(logging.WARNING, "zsdata")
    cache = ShardCache(tmp_path, 1 << 20)
    kept = [cache.store(URL, STAMP, number, photo(number, 50_000)) for number in range(30)]
    assert 10 < kept.count(True) < 21 and not any(kept[kept.count(True) :])
    assert all((cache.load(URL, STAMP, number, 50_000) == photo(number, 50_000)) == kept[number] for number in range(30))
    assert sum(os.path.getsize(path) for path in entries(tmp_path)) <= 1 << 20
    (said,) = [record.getMessage() for record in caplog.records]
    assert "the shard cache" in said and "Give a larger shard_cache_bytes" in said


def test_remote_ranges_are_read_once_and_local_ones_are_not_kept(cache, monkeypatch, tmp_path):
    from zsdata.source import ranges

    reads = []

    def fetch(url, offset, size, data, check):
        reads.append(offset)
        check(STAMP)
        data += photo(0, 500_000)[offset : offset + size]
        return offset + size >= 500_000

    monkeypatch.setattr(ranges, "fetch_http", fetch)
    for _ in range(3):
        assert read_range(URL, 100, 5000, stamp=STAMP, cache=cache) == photo(0, 500_000)[100:5100]
    assert reads == [100]
    (path,) = entries(cache.folder)
    os.truncate(path, 100)
    assert read_range(URL, 100, 5000, stamp=STAMP, cache=cache) == photo(0, 500_000)[100:5100]
    assert reads == [100, 100]
    read_range(URL, 100, 5000, cache=cache)  # of which shard nobody knows
    (tmp_path / "s.tar").write_bytes(bytes(100))
    read_range(str(tmp_path / "s.tar"), 0, 50, stamp={"size": 100}, cache=cache)
    assert len(entries(cache.folder)) == 1


def work(cache, seed):
    generator = np.random.default_rng(seed)
    for number in generator.integers(0, 40, 200):
        found = cache.load(URL, STAMP, int(number), 40_000)
        if found is None:
            cache.store(URL, STAMP, int(number), photo(number, 40_000))
        elif found != photo(number, 40_000):
            raise AssertionError(number)
        if generator.random() < 0.015:  # 10 times in all four; each costs the folder the room of one of 25 entries
            with suppress(FileNotFoundError, IndexError):  # another process has removed it
                os.truncate(entries(cache.folder)[0], 100)


def test_processes_share_a_cache_and_its_bound(tmp_path):
    cache = ShardCache(tmp_path, 1 << 20)
    context = multiprocessing.get_context("fork")
    children = [context.Process(target=work, args=(cache, seed)) for seed in range(4)]
    for child in children:
        child.start()
    while any(child.is_alive() for child in children):
        with folder_ledger.open_ledger(str(tmp_path), "shard") as ledger:
            assert ledger.held_bytes <= 1 << 20
        children[0].join(0.01)
    assert [child.exitcode for child in children] == [0] * 4
    assert len(entries(tmp_path)) > 10
