"""The depth cache: right values or none, never more bytes than allowed, whatever happens to its files and processes."""

import errno
import logging
import multiprocessing
import os
import pickle
import signal
import time
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsdata import folder_ledger
from zsdata.bounded_folder import SMALLEST_BOUND_BYTES as SMALLEST_CACHE_BYTES
from zsdata.folder_ledger import ledger_name, open_ledger
from zsdata.synthesis.depth import cache as cache_module
from zsdata.synthesis.depth.cache import DepthCache, photo_digest
from zsdata.synthesis.depth.cache_entry import BAND_ROWS

PLENTY = 100 << 20


def maps(number, height=40, width=30):
    """What the estimator of these tests says of photo `number`."""
    generator = np.random.default_rng(number)
    inverse_depth = generator.integers(0, 1 << 16, (height, width), dtype=np.uint16)
    return inverse_depth, generator.integers(0, 256, (height, width), dtype=np.uint8), float(generator.random())


def key(number):
    return photo_digest(b"photo %d" % number)


def loaded(cache, number, rows=None):
    found = cache.load(key(number), rows)
    assert found is not None
    return found


def is_stored(found, number, height=40, width=30):
    inverse_depth, confidence, consistency = maps(number, height, width)
    return (
        (found.inverse_depth.dtype, found.confidence.dtype) == (np.uint16, np.uint8)
        and np.array_equal(found.inverse_depth, inverse_depth)
        and np.array_equal(found.confidence, confidence)
        and (found.consistency, found.first_row, found.size) == (consistency, 0, (height, width))
    )


def files(folder, ending=""):
    return [os.path.join(place, name) for place, _, names in os.walk(folder) for name in names if name.endswith(ending)]


def sizes(folder):
    found = []
    for path in files(folder):
        with suppress(FileNotFoundError):  # a damaged entry is removed at any time
            found.append(os.path.getsize(path))
    return found


def bytes_in(folder):
    return sum(sizes(folder))


def entry_path(cache, number):
    (path,) = files(cache.folder, f"{key(number)}.depth")
    return path


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr(folder_ledger, "RECOUNT_PAUSE", 0.0)
    return DepthCache(tmp_path / "depth", PLENTY, "estimator 1")


@pytest.fixture
def warnings_said(caplog):
    caplog.set_level(logging.WARNING, "zsdata")
    return lambda: [record.getMessage() for record in caplog.records]


def test_what_is_stored_comes_back_to_the_bit(cache):
    assert cache.load(key(1)) is None
    assert cache.store(key(1), *maps(1)) is True
    assert is_stored(cache.load(key(1)), 1)
    assert cache.load(key(2)) is None
    assert cache.store(key(1), *maps(7, 33, 65)) is True  # in its place
    assert is_stored(cache.load(key(1)), 7, 33, 65)


def test_an_entry_that_is_removed_while_it_is_replaced_stops_nothing(cache, monkeypatch, warnings_said):
    assert cache.store(key(1), *maps(1))
    path, real = entry_path(cache, 1), os.lstat

    def removed_before(place):
        if place == path:
            os.unlink(path)
            monkeypatch.undo()
        return real(place)

    monkeypatch.setattr(os, "lstat", removed_before)
    assert cache.store(key(1), *maps(2)) and is_stored(cache.load(key(1)), 2)
    assert cache.store(key(3), *maps(3)) and not warnings_said()


@given(height=st.integers(1, 70), width=st.integers(1, 9), data=st.data())
def test_rows_are_widened_to_whole_bands(tmp_path_factory, height, width, data):
    first = data.draw(st.integers(0, height - 1))
    stop = data.draw(st.integers(first + 1, height))
    cache = DepthCache(tmp_path_factory.mktemp("rows"), PLENTY, "estimator 1")
    assert cache.store(key(0), *maps(0, height, width))
    found = loaded(cache, 0, (first, stop))
    inverse_depth, confidence, consistency = maps(0, height, width)
    rows = slice(found.first_row, found.first_row + len(found.inverse_depth))
    assert rows.start <= first < stop <= rows.stop <= height
    assert rows.start > first - BAND_ROWS and rows.stop < stop + BAND_ROWS
    assert np.array_equal(found.inverse_depth, inverse_depth[rows]) and np.array_equal(found.confidence, confidence[rows])
    assert (found.consistency, found.size) == (consistency, (height, width))


def test_a_header_longer_than_the_first_read(cache):
    assert cache.store(key(0), *maps(0, 9000, 2))
    found = loaded(cache, 0, (8500, 8600))
    assert np.array_equal(found.inverse_depth[8500 - found.first_row :][:100], maps(0, 9000, 2)[0][8500:8600])


def test_views_that_are_not_contiguous_are_stored_as_they_look(cache):
    inverse_depth, confidence, consistency = maps(3)
    cache.store(key(3), inverse_depth.T[::-1], confidence.T[::-1], consistency)
    found = loaded(cache, 3)
    assert np.array_equal(found.inverse_depth, inverse_depth.T[::-1]) and np.array_equal(found.confidence, confidence.T[::-1])


def test_rows_that_the_map_does_not_have_are_a_miss_and_keep_the_entry(cache):
    cache.store(key(1), *maps(1))
    assert cache.load(key(1), (30, 41)) is None
    assert is_stored(cache.load(key(1)), 1)


def test_the_digest_of_a_photo_is_its_sha256():
    assert photo_digest(b"abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


# Damage


def stored_small(cache):
    assert cache.store(key(1), *maps(1, 20, 6))
    path = entry_path(cache, 1)
    with open(path, "rb") as file:
        return path, file.read()


def write(path, data):
    with open(path, "wb") as file:
        file.write(data)


def test_a_flip_of_any_byte_is_a_miss_and_removes_the_entry(cache):
    path, data = stored_small(cache)
    for position in range(len(data)):
        for flip in (1 << position % 8, 0xFF):
            write(path, data[:position] + bytes([data[position] ^ flip]) + data[position + 1 :])
            assert cache.load(key(1)) is None, position
            assert not os.path.exists(path)
    assert cache.store(key(1), *maps(1, 20, 6)) and is_stored(cache.load(key(1)), 1, 20, 6)


def test_a_cut_at_any_length_is_a_miss_and_removes_the_entry(cache):
    path, data = stored_small(cache)
    for length in [*range(len(data)), len(data) + 1]:
        write(path, (data + b"\0")[:length])
        assert cache.load(key(1)) is None, length
        assert not os.path.exists(path)
    assert cache.store(key(1), *maps(1, 20, 6)) and is_stored(cache.load(key(1)), 1, 20, 6)


def test_damage_in_rows_that_are_not_asked_for_leaves_the_others_right(cache):
    path, data = stored_small(cache)
    write(path, data[:-1] + bytes([data[-1] ^ 1]))  # confidence of the last row
    found = loaded(cache, 1, (0, BAND_ROWS))
    assert np.array_equal(found.confidence, maps(1, 20, 6)[1][:BAND_ROWS])
    assert cache.load(key(1), (BAND_ROWS, 20)) is None


def test_an_entry_in_the_wrong_place_is_not_believed(cache):
    path, data = stored_small(cache)
    write(path.replace(key(1), key(2)), data)
    assert cache.load(key(2)) is None  # another photo
    other = DepthCache(cache.folder, PLENTY, "estimator 2")
    assert other.load(key(1)) is None and other.store(key(1), *maps(5))
    (other_path,) = (name for name in files(cache.folder, f"{key(1)}.depth") if name != path)
    os.replace(other_path, path)
    assert cache.load(key(1)) is None  # another estimator


@pytest.mark.parametrize("make", [os.mkdir, os.mkfifo, lambda path: os.symlink("/etc/hostname", path)])
def test_something_else_in_an_entrys_place_is_a_miss_and_replaced(cache, make):
    path, _ = stored_small(cache)
    os.unlink(path)
    make(path)
    assert cache.load(key(1)) is None and not os.path.lexists(path)
    assert cache.store(key(1), *maps(1)) and is_stored(cache.load(key(1)), 1)


def test_a_full_folder_in_an_entrys_place_is_a_miss_and_stays(cache, warnings_said):
    path, _ = stored_small(cache)
    os.unlink(path)
    os.makedirs(os.path.join(path, "mine"))
    assert cache.load(key(1)) is None and cache.store(key(1), *maps(1)) is False
    assert os.path.isdir(os.path.join(path, "mine"))
    assert files(cache.folder, ".tmp") == []


def test_too_many_open_files_cost_no_entry(cache, monkeypatch):
    stored_small(cache)

    def fail(*args):
        raise OSError(errno.EMFILE, "Too many open files")

    with monkeypatch.context() as patch:
        patch.setattr(os, "open", fail)
        assert cache.load(key(1)) is None
    assert is_stored(cache.load(key(1)), 1, 20, 6)


def test_damage_is_said_once(cache, warnings_said):
    for number in (1, 2):
        cache.store(key(number), *maps(number))
        write(entry_path(cache, number), b"short")
        assert cache.load(key(number)) is None
    (said,) = warnings_said()
    assert cache.folder in said and key(1) in said and "ends inside the header" in said


# Bytes


def test_a_full_cache_keeps_what_it_has_and_says_so_once(tmp_path, warnings_said):
    cache = DepthCache(tmp_path, SMALLEST_CACHE_BYTES, "estimator 1")
    DepthCache(tmp_path, SMALLEST_CACHE_BYTES, "another estimator").store(key(0), *maps(0, 200, 200))
    kept = [cache.store(key(number), *maps(number, 100, 120)) for number in range(40)]
    assert kept.count(True) > 15 and not any(kept[kept.count(True) :])
    assert all((cache.load(key(number)) is not None) == kept[number] for number in range(40))
    assert bytes_in(tmp_path) <= SMALLEST_CACHE_BYTES < bytes_in(tmp_path) + 3 * 100 * 120 + 4096 * 60
    (said,) = warnings_said()
    assert str(tmp_path) in said and "1.05 MB" in said and "depth_cache_bytes" in said and "(another estimator, 0.13 MB)" in said
    worker = pickle.loads(pickle.dumps(DepthCache(tmp_path, SMALLEST_CACHE_BYTES, "estimator 1")))
    assert worker.store(key(50), *maps(50, 100, 120)) is False
    assert len(warnings_said()) == 2  # another run


def test_all_workers_together_say_once_that_the_cache_is_full(tmp_path, warnings_said):
    cache = DepthCache(tmp_path, SMALLEST_CACHE_BYTES, "estimator 1")
    workers = [pickle.loads(pickle.dumps(cache)) for _ in range(3)]
    assert not any(worker.store(key(0), *maps(0, 1000, 1000)) for worker in workers)
    assert len(warnings_said()) == 1


def test_room_that_another_estimator_gives_back_is_used(tmp_path, monkeypatch):
    monkeypatch.setattr(folder_ledger, "RECOUNT_PAUSE", 0.0)
    cache, other = (DepthCache(tmp_path, SMALLEST_CACHE_BYTES, name) for name in ("estimator 1", "estimator 2"))
    assert other.store(key(0), *maps(0, 500, 500)) and not cache.store(key(0), *maps(0, 500, 500))
    path = entry_path(other, 0)
    for name in os.listdir(os.path.dirname(path)):
        os.unlink(os.path.join(os.path.dirname(path), name))
    os.rmdir(os.path.dirname(path))
    assert cache.store(key(0), *maps(0, 500, 500))
    assert other.load(key(0)) is None and not other.store(key(0), *maps(0, 500, 500))  # its folder is gone, and that is no fault


def test_a_full_folder_is_not_counted_for_every_photo(tmp_path, monkeypatch):
    monkeypatch.setattr(folder_ledger, "RECOUNT_PAUSE", 1e9)
    counts, count = [], folder_ledger.count_shelf
    monkeypatch.setattr(folder_ledger, "count_shelf", lambda shelf, kind: counts.append(shelf) or count(shelf, kind))
    cache = DepthCache(tmp_path, SMALLEST_CACHE_BYTES, "estimator 1")
    with open_ledger(cache.folder, "depth") as ledger:
        ledger.count_if_due()
    assert not any(cache.store(key(number), *maps(number, 1000, 1000)) for number in range(20))
    assert counts == []


def test_storing_anew_takes_no_more_room(cache):
    held = set()
    for _ in range(5):
        assert cache.store(key(1), *maps(1))
        with open_ledger(cache.folder, "depth") as ledger:
            held.add(ledger.held_bytes)
    assert len(held) == 1


def counted(folder):
    """The cache's bytes as the ledger should have them: every file of ours and every folder, in blocks, with its name."""
    folders = sum(len(names) for _, names, _ in os.walk(folder)) + 1
    return sum(max(4096, (size + 4095) // 4096 * 4096) + 256 for size in [*sizes(folder), *[0] * folders])


def held_bytes(folder):
    with open_ledger(str(folder), "depth") as ledger:
        return ledger.held_bytes


def test_the_ledger_holds_what_lies_in_the_folder(cache):
    assert held_bytes(cache.folder) == counted(cache.folder)
    for number in range(5):
        cache.store(key(number), *maps(number, 30 * number + 1, 50))
        assert held_bytes(cache.folder) == counted(cache.folder)


@pytest.mark.parametrize("damage", ["missing", "empty", "cut", "long", "flipped", "foreign"])
def test_a_ledger_that_cannot_be_believed_is_counted_anew(cache, damage):
    cache.store(key(1), *maps(1))
    path = os.path.join(cache.folder, ledger_name("depth"))
    with open(path, "rb") as file:
        data = file.read()
    if damage == "missing":
        os.unlink(path)
    else:
        flipped = data[:16] + bytes([data[16] ^ 1]) + data[17:]
        write(path, {"empty": b"", "cut": data[:-1], "long": data + b"1", "flipped": flipped, "foreign": b"foreign\n" * 900}[damage])
    assert held_bytes(cache.folder) == counted(cache.folder)
    assert cache.store(key(2), *maps(2)) and is_stored(cache.load(key(1)), 1)


def test_files_of_others_are_neither_counted_nor_removed(cache):
    cache.store(key(1), *maps(1))
    held, shelf = held_bytes(cache.folder), os.path.dirname(entry_path(cache, 1))
    foreign = [os.path.join(place, name) for place in (cache.folder, shelf) for name in ("notes.txt", "x.tmp", f"{key(1)}.tmp", "a.depth")]
    for path in foreign:
        write(path, b"mine" * 5000)
    os.mkdir(os.path.join(cache.folder, "depth-of-field"))
    cache = DepthCache(cache.folder, PLENTY, "estimator 1")
    assert held_bytes(cache.folder) == held
    assert all(os.path.getsize(path) == 20000 for path in foreign) and os.path.isdir(os.path.join(cache.folder, "depth-of-field"))


def test_a_smaller_bound_removes_nothing(cache):
    for number in range(10):
        cache.store(key(number), *maps(number, 300, 300))
    smaller = DepthCache(cache.folder, SMALLEST_CACHE_BYTES, "estimator 1")
    assert smaller.store(key(10), *maps(10)) is False
    assert all(is_stored(smaller.load(key(number)), number, 300, 300) for number in range(10))


# Faults while storing


def test_a_full_disk_is_said_once_and_the_rest_goes_on(cache, monkeypatch, warnings_said):
    cache.store(key(1), *maps(1))
    pack_entry, tried = cache_module.pack_entry, []

    def full_disk(*args):
        tried.append(args)
        yield next(pack_entry(*args))
        raise OSError(errno.ENOSPC, "No space left on device")

    held = held_bytes(cache.folder)
    with monkeypatch.context() as patch:
        patch.setattr(cache_module, "pack_entry", full_disk)
        assert [cache.store(key(number), *maps(number)) for number in (2, 3)] == [False, False]
    assert len(tried) == 1  # not again for every photo
    (said,) = warnings_said()
    assert cache.folder in said and "No space left on device" in said and "free space" in said
    assert files(cache.folder, ".tmp") == [] and held_bytes(cache.folder) == held == counted(cache.folder)
    assert is_stored(cache.load(key(1)), 1)
    monkeypatch.setattr(cache._kept, "_retry_at", time.monotonic())  # a minute later
    assert cache.store(key(2), *maps(2)) and len(warnings_said()) == 1


def test_a_folder_that_became_read_only_is_said_once(cache, monkeypatch, warnings_said):
    cache.store(key(1), *maps(1))
    real_open = os.open

    def read_only(path, flags, *mode):
        if flags & (os.O_WRONLY | os.O_RDWR):
            raise OSError(errno.EROFS, "Read-only file system", path)
        return real_open(path, flags, *mode)

    monkeypatch.setattr(os, "open", read_only)
    assert [cache.store(key(number), *maps(number)) for number in (2, 3)] == [False, False]
    (said,) = warnings_said()
    assert cache.folder in said and "Read-only file system" in said and "writable" in said
    assert is_stored(cache.load(key(1)), 1)


def test_a_process_that_never_lets_go_of_the_lock_stops_nobody(cache, monkeypatch, warnings_said):
    monkeypatch.setattr(folder_ledger, "LOCK_SECONDS", 0.05)
    cache.store(key(1), *maps(1))
    with open_ledger(cache.folder, "depth"):
        assert cache.store(key(2), *maps(2)) is False
        assert is_stored(cache.load(key(1)), 1)
        assert is_stored(DepthCache(cache.folder, PLENTY, "estimator 1").load(key(1)), 1)
    assert "another process has held" in warnings_said()[0]


def test_the_lock_does_not_stay_with_a_process_that_is_forked_meanwhile(cache, monkeypatch):
    monkeypatch.setattr("zsdata.folder_ledger.LOCK_SECONDS", 0.1)
    with open_ledger(cache.folder, "depth") as ledger:
        of_the_child = os.dup(ledger._descriptor)  # what it has of the ledger's file, for as long as it lives
    try:
        with open_ledger(cache.folder, "depth"):
            pass
    finally:
        os.close(of_the_child)


def test_an_interrupted_store_leaves_nothing_behind(cache, monkeypatch):
    held = held_bytes(cache.folder)

    def interrupted(*args):
        yield b"begun"
        raise KeyboardInterrupt

    monkeypatch.setattr(cache_module, "pack_entry", interrupted)
    with pytest.raises(KeyboardInterrupt):
        cache.store(key(1), *maps(1))
    assert files(cache.folder, ".tmp") == [] and held_bytes(cache.folder) == held == counted(cache.folder)


def test_the_file_of_a_writer_that_lives_is_left_to_it(cache, monkeypatch):
    pack_entry, seen, before = cache_module.pack_entry, [], held_bytes(cache.folder)

    def interleaved(*args):
        for part in pack_entry(*args):
            DepthCache(cache.folder, PLENTY, "estimator 1")  # counts, and removes what nobody writes any more
            seen.append((len(files(cache.folder, ".tmp")), held_bytes(cache.folder) - before))
            yield part

    monkeypatch.setattr(cache_module, "pack_entry", interleaved)
    assert cache.store(key(1), *maps(1, *SIZE))
    assert seen == [(1, 9 * 4096 + 256)] * 4 and is_stored(cache.load(key(1)), 1, *SIZE)


# Arguments


@pytest.mark.parametrize(("max_bytes", "error"), [(0, ValueError), (-1, ValueError), (20, ValueError), (1e9, TypeError), (True, TypeError)])
def test_a_bound_that_cannot_work_is_said(tmp_path, max_bytes, error):
    with pytest.raises(error, match=r"max_bytes is .*got"):
        DepthCache(tmp_path, max_bytes, "estimator 1")


def test_a_folder_that_cannot_be_made_or_written_is_named(tmp_path):
    (tmp_path / "file").write_text("mine")
    for folder in (tmp_path / "file", tmp_path / "file" / "depth", "/proc/depth"):
        with pytest.raises(OSError, match=f"folder {folder} cannot be used"):
            DepthCache(folder, PLENTY, "estimator 1")
    shelf = DepthCache(tmp_path / "a", PLENTY, "estimator 1")._kept._shelf
    (tmp_path / "b").mkdir()
    write(os.path.join(tmp_path / "b", os.path.basename(shelf)), b"a file where a folder should be")
    with pytest.raises(OSError, match="b cannot be used"):
        DepthCache(tmp_path / "b", PLENTY, "estimator 1")


def test_wrong_arguments_are_said(cache):
    inverse_depth, confidence, consistency = maps(1)
    for wrong in ((inverse_depth.astype(np.float32), confidence), (inverse_depth, confidence[1:]), (inverse_depth[:0], confidence[:0])):
        with pytest.raises(ValueError, match="inverse depth is uint16 and confidence uint8"):
            cache.store(key(1), *wrong, consistency)
    for photo in ("../../etc/passwd", key(1).upper(), ""):
        with pytest.raises(ValueError, match="64 hexadecimal digits"):
            cache.load(photo)
    for rows in ((-1, 3), (3, 3)):
        with pytest.raises(ValueError, match="rows are"):
            cache.load(key(1), rows)
    with pytest.raises(ValueError, match="identity"):
        DepthCache(cache.folder, PLENTY, "")


def test_the_folder_of_an_estimator_says_whose_it_is(cache):
    cache.store(key(1), *maps(1))
    with open(os.path.join(os.path.dirname(entry_path(cache, 1)), "identity.txt")) as file:
        assert file.read() == "estimator 1\n"


# Processes. The children come from a server that has imported the package already.

processes = multiprocessing.get_context("forkserver")
processes.set_forkserver_preload(["zsdata.synthesis.depth.cache", "tests.synthesis.test_depth_cache"])
SIZE = (100, 120)
PHOTOS = 40  # do not fit into the smallest cache


def store_and_load(cache, seed, rounds):
    generator = np.random.default_rng(seed)
    for number in generator.integers(0, PHOTOS, rounds):
        found = cache.load(key(number))
        assert found is None or is_stored(found, estimated(cache, number), *SIZE)
        if found is None or generator.random() < 0.3:
            cache.store(key(number), *maps(estimated(cache, number), *SIZE))
        if generator.random() < 0.2:
            with suppress(FileNotFoundError):  # damage, so that room is found again and again
                os.truncate(cache._kept.path(key(number)), 5000)


def estimated(cache, number):
    """Which of `maps` the estimator of a cache gives for a photo."""
    return number + 1000 * int(cache.identity[-1])


def store_until_killed(cache):
    number = 0
    while True:
        cache.store(key(number % 10), *maps(number % 10, 200, 100))
        number += 1


def store_and_die(cache, name, before):
    """Stores, and is killed before or after the first call of `os.name` on a file of the cache's own estimator."""
    real = getattr(os, name)

    def deadly(*args):
        ours = name != "open" or str(args[0]).endswith(".tmp")
        if ours and before:
            os.kill(os.getpid(), signal.SIGKILL)
        result = real(*args)
        if ours:
            os.kill(os.getpid(), signal.SIGKILL)
        return result

    setattr(os, name, deadly)
    cache.store(key(1), *maps(1))


def test_many_processes_never_exceed_the_bound_and_never_read_wrong_values(tmp_path, monkeypatch):
    caches = [DepthCache(tmp_path, SMALLEST_CACHE_BYTES, f"estimator {number}") for number in (1, 2)]
    for cache in caches:
        assert all(cache.store(key(number), *maps(estimated(cache, number), *SIZE)) for number in range(100, 105))
    children = [processes.Process(target=store_and_load, args=(caches[seed // 3], seed, 150)) for seed in range(4)]
    for child in children:
        child.start()
    while any(child.is_alive() for child in children):
        with open_ledger(str(tmp_path), "depth") as ledger:  # nothing appears, grows or is renamed meanwhile
            assert counted(tmp_path) <= ledger.held_bytes <= SMALLEST_CACHE_BYTES
        time.sleep(0.005)
    for child in children:
        child.join()
    assert [child.exitcode for child in children] == [0] * 4
    assert files(tmp_path, ".tmp") == [] and counted(tmp_path) <= held_bytes(tmp_path) <= SMALLEST_CACHE_BYTES
    monkeypatch.setattr(folder_ledger, "RECOUNT_PAUSE", 0.0)
    for number in range(PHOTOS):  # the cache has not lost count of its room
        DepthCache(tmp_path, SMALLEST_CACHE_BYTES, "estimator 1").store(key(number), *maps(estimated(caches[0], number), *SIZE))
    assert SMALLEST_CACHE_BYTES * 0.8 < counted(tmp_path) <= SMALLEST_CACHE_BYTES
    for cache in caches:
        found = {number: entry for number in range(105) if (entry := cache.load(key(number))) is not None}
        assert len(found) >= 5 and all(is_stored(entry, estimated(cache, number), *SIZE) for number, entry in found.items())


@pytest.mark.parametrize(("name", "before"), [("open", True), ("open", False), ("ftruncate", False), ("replace", True), ("replace", False)])
def test_a_writer_killed_at_any_step_leaves_a_cache_that_works(cache, name, before):
    child = processes.Process(target=store_and_die, args=(cache, name, before))
    child.start()
    child.join()
    assert child.exitcode == -signal.SIGKILL
    assert counted(cache.folder) <= held_bytes(cache.folder)
    again = DepthCache(cache.folder, PLENTY, "estimator 1")
    assert files(cache.folder, ".tmp") == [] and held_bytes(cache.folder) == counted(cache.folder)
    found = again.load(key(1))
    assert is_stored(found, 1) if (name, before) == ("replace", False) else found is None
    assert again.store(key(1), *maps(1)) and is_stored(again.load(key(1)), 1)


def test_writers_killed_in_the_middle_leave_a_cache_that_works(tmp_path, monkeypatch):
    cache = DepthCache(tmp_path, SMALLEST_CACHE_BYTES, "estimator 1")
    generator = np.random.default_rng(0)
    for _ in range(8):
        children = [processes.Process(target=store_until_killed, args=(cache,)) for _ in range(2)]
        for child in children:
            child.start()
        deadline = time.monotonic() + 20
        while not files(tmp_path, ".depth") and time.monotonic() < deadline:
            time.sleep(0.005)
        time.sleep(generator.uniform(0.02, 0.1))
        for child in children:
            child.kill()
        for child in children:
            child.join()
        assert counted(tmp_path) <= held_bytes(tmp_path) <= SMALLEST_CACHE_BYTES
    monkeypatch.setattr(folder_ledger, "RECOUNT_PAUSE", 0.0)
    again = DepthCache(tmp_path, SMALLEST_CACHE_BYTES, "estimator 1")
    assert files(tmp_path, ".tmp") == [] and held_bytes(tmp_path) == counted(tmp_path)
    for number in range(10):
        assert again.store(key(number), *maps(number, 200, 100)) and is_stored(again.load(key(number)), number, 200, 100)
