"""The life and death of worker processes, with real processes and real signals."""

import faulthandler
import multiprocessing
import os
import re
import resource
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import psutil
import pytest
import torch

from zsdata.faults import BadPhoto, WorkerLost
from zsdata.meter import Meter
from zsdata.pool import Job, WorkerPool

TROUBLE_AT = 5  # the sample that goes wrong: the second of the first batch of worker 1
LIMIT_SECONDS = 10  # from trouble to the error


class OddError(Exception):
    """Cannot be made again from its arguments."""

    def __init__(self, a, b):
        super().__init__(f"{a} and {b}")


def burn(seconds):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pass


def deadlock():
    lock = threading.Lock()
    lock.acquire()
    lock.acquire()


def stage(name, action):
    with Meter().stage(name):
        action()


def raise_(error):
    raise error


TROUBLES = {
    "killed": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "crashed": lambda: (faulthandler.disable(), os.kill(os.getpid(), signal.SIGSEGV)),
    "exits": lambda: os._exit(7),
    "leaves": lambda: exit(0),
    "stopped": lambda: os.kill(os.getpid(), signal.SIGSTOP),
    "sleeps": lambda: time.sleep(10_000),
    "deadlocked": lambda: stage("warp", deadlock),
    "endless": lambda: burn(10_000),
    "works hard": lambda: burn(9),
    "reads slowly": lambda: stage("read", lambda: time.sleep(9)),
    "loads slowly": lambda: time.sleep(9),
    "raises": lambda: raise_(BadPhoto("truncated", "street-7")),
    "raises oddly": lambda: raise_(OddError(1, 2)),
    "opens workers": lambda: open_pool(),
    "nothing": lambda: None,
}


@dataclass(frozen=True)
class Make:
    trouble: str = "nothing"
    at: int = TROUBLE_AT

    def __call__(self, epoch, index):
        if index == self.at:
            TROUBLES[self.trouble]()
        return {"place": (epoch, index), "values": torch.full((3, index), index, dtype=torch.uint8), "pid": os.getpid()}


def open_pool(make=None, *, processes=2, batches=None, context=None, timeout_seconds=60.0, ahead=2):
    numbers = range(batches) if batches is not None else iter(int, 1)
    requests = ([(0, 4 * batch), (0, 4 * batch + 1)] for batch, _ in enumerate(numbers))
    return WorkerPool(
        Job(nothing, make or Make(), list), requests, processes=processes, ahead=ahead, context=context, timeout_seconds=timeout_seconds
    )


def nothing():
    pass


def places(batches):
    return [sample["place"] for batch in batches for sample in batch]


def processes_of(pool):
    return [member.process.pid for member in pool._members]


def gone(pids, seconds=5.0):
    """Whether all of these processes end in time; a zombie has ended."""
    deadline = time.monotonic() + seconds

    def alive(pid):
        try:
            return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
        except psutil.NoSuchProcess:
            return False

    while any(map(alive, pids)):
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


def trouble(kind, timeout_seconds=60.0):
    """Runs into it; the error, and how long it took."""
    at = 0 if kind == "loads slowly" else TROUBLE_AT  # a model is loaded, or downloaded, for the first sample of a process
    pool = open_pool(Make(kind, at), timeout_seconds=timeout_seconds)
    pids, start = processes_of(pool), time.monotonic()
    try:
        for _ in range(6):
            next(pool)
        return None, pids, time.monotonic() - start
    except Exception as error:
        return error, pids, time.monotonic() - start
    finally:
        pool.close()


@pytest.mark.parametrize(("context", "processes"), [("fork", 1), ("fork", 3), ("forkserver", 2), ("spawn", 2)])
def test_batches_come_in_the_order_of_the_requests(context, processes):
    pool = open_pool(processes=processes, batches=7, context=context)
    batches = list(pool)
    assert places(batches) == [(0, index) for batch in range(7) for index in (4 * batch, 4 * batch + 1)]
    for sample in (sample for batch in batches for sample in batch):
        index = sample["place"][1]
        assert torch.equal(sample["values"], torch.full((3, index), index, dtype=torch.uint8))
    assert len({sample["pid"] for batch in batches for sample in batch}) == processes
    pids = processes_of(pool)
    pool.close()
    assert gone(pids, 0)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("killed", r"worker 1 of 2 \(process \d+\) was killed by SIGKILL; it was at sample 5 of epoch 0; the kernel kills"),
        ("crashed", r"worker 1 of 2 \(process \d+\) was killed by SIGSEGV; it was at sample 5 of epoch 0$"),
        ("exits", r"worker 1 of 2 \(process \d+\) ended with exit code 7; it was at sample 5 of epoch 0$"),
        ("leaves", r"worker 1 of 2 \(process \d+\) ended with exit code 0; it was at sample 5 of epoch 0$"),
    ],
)
def test_a_worker_that_ends_is_an_error_that_names_it_and_the_sample(kind, message):
    error, pids, seconds = trouble(kind)
    assert isinstance(error, WorkerLost) and re.match(message, str(error))
    assert seconds < 3 and gone(pids, 0)


def test_a_hanging_worker_is_an_error_within_ten_seconds_and_a_slow_one_is_not():
    expected = {
        "stopped": "has been stopped for 5 s",
        "sleeps": "hangs: it has done nothing for 7 s; it was at sample 5 of epoch 0",
        "deadlocked": 'hangs: it has done nothing for 7 s; it was at sample 5 of epoch 0, stage "warp"',
        "works hard": None,
        "reads slowly": None,
        "loads slowly": None,
    }
    with ThreadPoolExecutor() as threads:  # they wait at the same time
        outcomes = dict(zip(expected, threads.map(trouble, expected), strict=True))
    for kind, (error, pids, seconds) in outcomes.items():
        if expected[kind] is None:
            assert error is None, kind
        else:
            assert isinstance(error, WorkerLost) and expected[kind] in str(error) and "worker 1 of 2" in str(error)
            assert seconds < LIMIT_SECONDS
        assert gone(pids, 0)


def test_an_endless_loop_is_an_error_once_the_time_for_one_sample_is_over():
    error, pids, seconds = trouble("endless", timeout_seconds=2)
    assert "hangs: it has been busy for" in str(error) and "sample 5 of epoch 0" in str(error)
    assert 2 < seconds < 6 and gone(pids, 0)


def test_an_exception_arrives_as_itself_with_its_traceback():
    error, _, _ = trouble("raises")
    assert isinstance(error, BadPhoto) and error.reason == "truncated" and error.key == "street-7"
    assert "in a worker process" in str(error.__cause__) and "raise_" in str(error.__cause__)


def test_an_exception_that_cannot_travel_arrives_by_name():
    error, _, _ = trouble("raises oddly")
    assert type(error) is RuntimeError and str(error) == "OddError: 1 and 2"


def test_workers_of_a_worker_are_refused():
    error, _, seconds = trouble("opens workers")
    assert "not allowed to have children" in str(error) and seconds < LIMIT_SECONDS


def keep_open(start, pipe):
    pool = start()
    pipe.send(processes_of(pool) + [child.pid for child in psutil.Process().children(recursive=True)])
    time.sleep(10_000)


def all_end_with_the_parent(start, context="fork", seconds=5.0):
    """Runs `start` in a process that is then killed: whether every process that it had started ends."""
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context(context).Process(target=keep_open, args=(start, theirs))
    process.start()
    theirs.close()
    pids = ours.recv()
    time.sleep(0.3)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    all_end = gone(pids, seconds)  # not yet waited for: the parent is a zombie
    process.join()
    return all_end


def in_a_thread(start):
    found = []
    thread = threading.Thread(target=lambda: found.append(start()))
    thread.start()
    thread.join()
    return found[0]


@pytest.mark.parametrize("kind", ["nothing", "sleeps", "stopped", "endless"])
def test_workers_end_when_the_training_process_is_killed(kind):
    assert all_end_with_the_parent(lambda: open_pool(Make(kind), batches=6))


def open_in_a_thread():
    pool = in_a_thread(lambda: open_pool(batches=6))
    time.sleep(0.3)
    assert len(list(pool)) == 6
    return pool


def test_workers_of_a_thread_outlive_it_but_not_the_process():
    assert all_end_with_the_parent(open_in_a_thread)


@pytest.mark.parametrize("context", ["spawn", pytest.param("forkserver", marks=pytest.mark.slow)])
def test_workers_started_otherwise_end_when_the_training_process_is_killed(context):
    # They are killed while they start, and see it once they have imported torch.
    assert all_end_with_the_parent(partial(open_pool, batches=6, context=context), "spawn", seconds=30)


def shared_memory():
    """What stands in /dev/shm but for locks, which other programs of the machine make and unlink at once."""
    return sorted(name for name in os.listdir("/dev/shm") if not name.startswith("sem."))


def test_a_pool_leaves_nothing_behind():
    def held():
        return shared_memory(), len(os.listdir("/proc/self/fd")), threading.active_count(), len(psutil.Process().children())

    open_pool(batches=1).close()
    before = held()
    for batches_taken in range(4):
        pool = open_pool()
        taken = [next(pool) for _ in range(batches_taken)]
        pool.close()
        del pool
        assert held() == before and len(taken) == batches_taken


def test_batches_that_are_kept_hold_no_files_open():
    pool = open_pool(batches=40)
    next(pool)
    before = len(os.listdir("/proc/self/fd"))
    kept = list(pool)
    assert len(os.listdir("/proc/self/fd")) == before and len(kept) == 39
    pool.close()


def test_too_few_files_are_said_to_be_too_few():
    pool = open_pool(processes=1)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    files = []
    try:
        while not pool.ready:
            time.sleep(0.01)
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(map(int, os.listdir("/proc/self/fd"))) + 4, hard))
        with pytest.raises(OSError):
            while True:
                files.append(os.open("/dev/null", os.O_RDONLY))
        with pytest.raises(OSError, match="too many open files: a worker's batch could not be received; raise the limit with `ulimit -n`"):
            next(pool)
    finally:
        for file in files:
            os.close(file)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        pool.close()


def test_a_pool_that_is_dropped_or_forked_ends_its_workers_once():
    pool = open_pool()
    next(pool)
    child = multiprocessing.get_context("fork").Process(target=pool.close)
    child.start()
    child.join()
    pids = processes_of(pool)
    assert child.exitcode == 0 and len(next(pool)) == 2
    del pool
    assert gone(pids, 0)


@pytest.mark.parametrize(("handled", "ends"), [(True, False), (False, True)])
def test_who_handles_sigterm_keeps_its_workers(handled, ends):
    """A cluster sends it to all processes at once, and a trainer has yet to save its place."""
    before = signal.signal(signal.SIGTERM, (lambda *_: None) if handled else signal.SIG_DFL)
    try:
        pool = open_pool(processes=1)
        next(pool)
        for pid in processes_of(pool):
            os.kill(pid, signal.SIGTERM)
        if ends:
            with pytest.raises(WorkerLost, match="was killed by SIGTERM"):
                list(pool)
        else:
            assert len([next(pool) for _ in range(5)]) == 5
        pids = processes_of(pool)
        pool.close()
        assert gone(pids, 0)
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_program_that_handles_sigterm_and_forgets_its_pool_ends():
    """At the exit Python sends SIGTERM to the processes that are left, and waits for them: before what was to be finalized, if that was
    asked for earlier, as by a temporary folder."""
    script = (
        "import signal, tempfile; folder = tempfile.TemporaryDirectory(); signal.signal(signal.SIGTERM, print); "
        "from tests.test_pool import open_pool; pool = open_pool(); next(pool)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_memory_without_a_name_is_found_where_python_does_not_offer_it(monkeypatch):
    monkeypatch.delattr(os, "memfd_create")
    pool = open_pool(batches=3, context="fork")
    assert len(list(pool)) == 3
    pool.close()


@pytest.mark.parametrize("method", ["spawn", "forkserver"])
def test_a_script_that_begins_anew_in_its_workers_is_told_what_it_lacks(tmp_path, method):
    """As "Ten lines" would where Python starts processes so by itself, which it does on Linux from 3.14 on."""
    script = tmp_path / "script.py"
    script.write_text(f"from tests.test_pool import open_pool\nnext(open_pool(batches=1, processes=1, context={method!r}))\n")
    done = subprocess.run(
        [sys.executable, script], env={**os.environ, "PYTHONPATH": os.getcwd()}, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 1
    assert re.search(rf"WorkerLost: .* exit code 1; .*{method}.*if __name__ == \"__main__\"", done.stderr)
