"""Bars: a process that is killed while it draws one stops no other."""

import multiprocessing
import os
import signal

import pytest
from tqdm import tqdm

from tests.scenes import layered_depth, photo_tar
from tests.test_stream import open_stream
from zsdata.faults import WorkerLost
from zsdata.progress import Progress

fork = multiprocessing.get_context("fork")


class Deadly:
    """A terminal that kills whoever writes to it."""

    def write(self, text):
        os.kill(os.getpid(), signal.SIGKILL)

    def flush(self):
        pass


def draw(bars, file):
    for _ in bars(range(2), file=file):
        pass


def ending(target, *arguments):
    """The exit code of a forked process; None where it waits for good."""
    process = fork.Process(target=target, args=arguments)
    process.start()
    process.join(20)
    code = process.exitcode
    process.kill()
    process.join()
    return code


def test_a_process_that_is_killed_while_it_draws_stops_no_other(tmp_path):
    with open(tmp_path / "terminal", "w") as terminal:
        draw(Progress, terminal)
        assert ending(draw, Progress, Deadly()) == -signal.SIGKILL
        assert ending(draw, Progress, terminal) == 0
        draw(Progress, terminal)


def deadly_depth(photos):
    draw(tqdm, Deadly())
    return layered_depth(photos)


def test_a_worker_that_is_killed_while_a_network_draws_stops_no_other(tmp_path):
    tar = photo_tar(tmp_path / "photos.tar", 4)
    with open(tmp_path / "terminal", "w") as terminal:
        draw(tqdm, terminal)
        with open_stream(tar, depth=deadly_depth).loader(2, num_workers=2, multiprocessing_context="fork") as loader:
            with pytest.raises(WorkerLost, match="SIGKILL"):
                next(iter(loader))
        assert ending(draw, tqdm, terminal) == 0
