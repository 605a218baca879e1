"""Worker processes: requests out, what they make back in, in order; and an error within seconds when one of them dies or hangs."""

from __future__ import annotations

import ctypes
import json
import multiprocessing
import multiprocessing.util
import os
import pickle
import select
import signal
import socket
import threading
import time
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from typing import Any

from torch import Tensor

from zsdata.activity import Activity
from zsdata.faults import WorkerLost
from zsdata.meter import Meter
from zsdata.parcel import Inbox, Outbox
from zsdata.watch import Watch

LOOK_SECONDS = 1.0  # between two looks at the workers, and at the parent process
GRACE_SECONDS = 2.0  # for a worker to finish its sample when the pool is closed
REQUEST_BYTES = 200_000  # the longest message that the socket takes
_BEFORE_CHILDREN_ARE_AWAITED = 10  # a priority at Python's exit, where multiprocessing waits for processes that it has sent SIGTERM
_SET_PARENT_DEATH_SIGNAL = 1  # prctl
_starting = threading.Lock()  # one fork at a time: two would copy each other's half-made channels, and filelock refuses the second one


def _not_starting() -> None:
    global _starting
    _starting = threading.Lock()


os.register_at_fork(after_in_child=_not_starting)  # a worker is forked while it is held

Request = Sequence[tuple[int, int]]  # (epoch, index) of each sample of a batch


@dataclass(frozen=True)
class Job:
    """What the processes do; travels to them.

    Attributes:
        start: called once in each process.
        make: (epoch, index) to a sample.
        collate: the samples of a request to a batch.
    """

    start: Callable[[], None]
    make: Callable[[int, int], Any]
    collate: Callable[[list[Any]], Any]


@dataclass(frozen=True)
class _Member:
    number: int
    process: BaseProcess
    channel: socket.socket
    inbox: Inbox
    activity: Activity
    asked: deque[Request] = field(default_factory=deque)


class WorkerPool:
    """Batches in the order of the requests; process w makes the requests w, w + n, w + 2 n, ...

    Each process has a channel of its own, so that one that is killed leaves no lock behind for the others to wait for. Processes end with
    the pool and with the process that made it, even when that one is killed. Where that one handles SIGTERM, as a trainer does that saves
    its place when a cluster ends it, they leave the signal to it (but a "forkserver" ends by it, and they with that). Batches are handed
    over in memory without a name (see `zsdata.parcel`), so that it is of no account how small /dev/shm is.

    Args:
        requests: taken as far ahead as batches are made ahead.
        ahead: batches of each process that are ready or in the making.
        context: "fork", "forkserver" or "spawn"; None is Python's own choice.
        timeout_seconds: the most that a process may take over one sample.
        take: copies the tensors of a batch out of the memory that the processes share.
    """

    def __init__(
        self,
        job: Job,
        requests: Iterator[Request],
        *,
        processes: int,
        ahead: int,
        context: str | None,
        timeout_seconds: float,
        take: Callable[[Tensor], Tensor] = Tensor.clone,
    ) -> None:
        self._requests = requests
        self._timeout_seconds = timeout_seconds
        self._ahead = ahead
        self._take = take
        self._start_method = multiprocessing.get_context(context).get_start_method()
        self._taken = 0
        self._members: list[_Member] = []
        self.close = multiprocessing.util.Finalize(self, _end, (self._members,), exitpriority=_BEFORE_CHILDREN_ARE_AWAITED)
        # Ctrl-C while the processes start is for this one alone. They inherit the mask, and ignore the signal before they lift it.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            for number in range(processes):
                self._members.append(self._start(number, job, multiprocessing.get_context(context)))
        except BaseException:
            self.close()
            raise
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for _ in range(ahead):
            for member in self._members:
                self._ask(member)

    def __iter__(self) -> WorkerPool:
        return self

    def __next__(self) -> Any:
        """The next batch.

        Raises:
            WorkerLost: a process was killed, ended or hangs; it names the process and the sample.
            Exception: whatever `make` raised.
            StopIteration: there are no more requests.
        """
        member = self._members[self._taken % len(self._members)]
        if not member.asked:
            raise StopIteration
        self._wait_for(member)
        try:
            made, error = member.inbox.receive(self._take)
        except (EOFError, ConnectionError):
            raise self._lost(member) from None
        if error is not None:
            raise error
        self._taken += 1
        member.asked.popleft()
        self._ask(member)
        return made

    @property
    def ready(self) -> int:
        """Batches that wait to be taken."""
        return sum(member.inbox.waiting() for member in self._members)

    def _start(self, number: int, job: Job, context: Any) -> _Member:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        activity = Activity()
        # A forked child holds copies of the ends that are not its own; it must not keep them open.
        inherited = [member.channel for member in self._members] + [ours] if context.get_start_method() == "fork" else []
        dies_with_thread = threading.current_thread() is threading.main_thread()
        at_sigterm = signal.SIG_DFL if signal.getsignal(signal.SIGTERM) == signal.SIG_DFL else signal.SIG_IGN
        process = context.Process(
            target=_work,
            args=(job, theirs, self._ahead, activity, inherited, dies_with_thread, at_sigterm),
            name=f"zsdata worker {number}",
            daemon=True,
        )
        try:
            with _starting, warnings.catch_warnings():
                # Python 3.12 warns of forks beside threads; torch's DataLoader forks so too. OpenCV's threads, which hung, are put to rest.
                warnings.filterwarnings("ignore", "This process .* is multi-threaded", DeprecationWarning)
                process.start()
        except BaseException:
            ours.close()
            activity.close()
            raise
        finally:
            theirs.close()
        return _Member(number, process, ours, Inbox(ours), activity)

    def _ask(self, member: _Member) -> None:
        request = next(self._requests, None)
        if request is None:
            return
        message = json.dumps(request).encode()
        if len(message) > REQUEST_BYTES:
            raise ValueError(f"a batch of {len(request)} samples is more than a worker can be asked for at once; use a smaller batch_size")
        try:
            member.channel.send(message)
        except ConnectionError:
            raise self._lost(member) from None
        member.asked.append(request)

    def _wait_for(self, awaited: _Member) -> None:
        watches: dict[int, Watch] = {}
        looked = time.monotonic()
        while True:
            sentinels = {member.process.sentinel: member for member in self._members}
            ready = wait([awaited.channel, *sentinels], LOOK_SECONDS)
            if awaited.channel in ready:
                return
            now = time.monotonic()
            elapsed, looked = min(now - looked, 2 * LOOK_SECONDS), now  # more than that, and this process was stopped itself
            for member in self._members:
                if member.process.sentinel in ready or member.process.exitcode is not None:
                    raise self._lost(member)
                at_work = len(member.asked) > member.inbox.waiting()
                if at_work and not ready:
                    watch = watches.get(member.number)
                    if watch is None:
                        assert member.process.pid is not None
                        watch = watches[member.number] = Watch(member.process.pid, member.activity, self._timeout_seconds)
                    reason = watch.look(elapsed)
                    if reason is not None:
                        raise self._lost(member, reason)

    def _lost(self, member: _Member, reason: str | None = None) -> WorkerLost:
        member.process.join(LOOK_SECONDS)
        doing = member.activity.read()
        code = member.process.exitcode
        if reason is None:
            reason = "closed its channel" if code is None else _ending(code)
        if doing.begun:
            place = f"at sample {doing.index} of epoch {doing.epoch}" + (f', stage "{doing.stage}"' if doing.stage else "")
        elif member.asked:
            epoch, index = member.asked[0][0]
            place = f"before its first sample, {index} of epoch {epoch}"
        else:
            place = "at its start"
        hint = ""
        if code == -signal.SIGKILL:
            hint = "; the kernel kills processes so when memory runs out: fewer workers or a smaller batch need less"
        elif code == 1 and not doing.begun and self._start_method != "fork":
            hint = (
                f'; started by "{self._start_method}", it runs the script once more: put what the script does under '
                'if __name__ == "__main__":, or give the loader multiprocessing_context="fork"'
            )
        return WorkerLost(f"worker {member.number} of {len(self._members)} (process {member.process.pid}) {reason}; it was {place}{hint}")


def _ending(code: int) -> str:
    if code >= 0:
        return f"ended with exit code {code}"
    try:
        return f"was killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"was killed by signal {-code}"


def _end(members: list[_Member]) -> None:
    """Ends the processes: gently, then not."""
    for member in members:
        try:
            member.channel.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass
    deadline = time.monotonic() + GRACE_SECONDS
    for member in members:
        member.process.join(max(0.0, deadline - time.monotonic()))
    for member in members:
        member.process.kill()  # unlike SIGTERM, this ends a stopped process too
        member.process.join()
        member.process.close()
        member.channel.close()
        member.activity.close()
    members.clear()


def _work(
    job: Job,
    channel: socket.socket,
    ahead: int,
    activity: Activity,
    inherited: list[socket.socket],
    dies_with_thread: bool,
    at_sigterm: signal.Handlers,
) -> None:
    """What a process does: until the channel is closed or the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the training process, which ends this one
    signal.signal(signal.SIGTERM, at_sigterm)  # and its handlers are not for a forked child
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    parent = os.getppid()
    if dies_with_thread:
        ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)  # even where this process hangs or is stopped by then
    for end in inherited:
        end.close()
    poll = select.poll()
    poll.register(channel, select.POLLIN)

    def gone() -> bool:
        return os.getppid() != parent or any(event & (select.POLLHUP | select.POLLERR) for _, event in poll.poll(0))

    outbox = Outbox(channel, ahead)
    Meter.entered = activity.enter
    job.start()
    while not gone():
        if not poll.poll(1000 * LOOK_SECONDS):
            continue
        try:
            request = channel.recv(REQUEST_BYTES)
        except ConnectionError:
            return
        if not request:
            return
        try:
            samples = []
            for epoch, index in json.loads(request):
                if gone():
                    return
                activity.begin(epoch, index)
                samples.append(job.make(epoch, index))
            answer = job.collate(samples), None
        except Exception as error:
            answer = None, _Portable(error)
        try:
            outbox.send(answer)
        except ConnectionError:
            return
        del answer


class _Traceback(Exception):
    """What went wrong in a worker process, as it would have been printed there."""

    def __str__(self) -> str:
        return f"in a worker process\n{self.args[0]}"


class _Portable:
    """An exception on its way to another process: it arrives as itself, with the traceback as its cause."""

    def __init__(self, error: Exception) -> None:
        text = "".join(traceback.format_exception(type(error), error, error.__traceback__))
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:  # an exception may hold anything, and be made in any way
            error = RuntimeError(f"{type(error).__name__}: {error}")
        self._parts = error, text

    def __reduce__(self) -> Any:
        return _arrived, self._parts


def _arrived(error: Exception, text: str) -> Exception:
    error.__cause__ = _Traceback(text)
    return error
