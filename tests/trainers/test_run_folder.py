"""Checkpoints belong to one run; killed at any step of writing one, a run goes on from the last whole one."""

from __future__ import annotations

import errno
import fcntl
import json
import multiprocessing
import os
import re
import resource
import shutil
import signal
import socket
import sys
import threading

import pytest
import torch
from safetensors.torch import load_file
from torch import nn

from trainers import run_folder
from trainers.termination import Terminated

TOUCHES = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.scandir", "os.listdir"}  # audit events of files and folders


def network(value):
    net = nn.Linear(3, 2)
    nn.init.constant_(net.weight, value)
    return net


def save(output, step, value):
    """A checkpoint whose every file says `value`."""
    return run_folder.save(output, step, network(value), {"value": value}, {"tensor": torch.full((5,), value)}, {"value": value})


def value_of(folder):
    """What all files of a checkpoint say; that they say the same is what makes it whole."""
    training, state = run_folder.load(folder)
    weights = load_file(folder / "model.safetensors")
    values = {
        training["tensor"][0].item(),
        state["value"],
        weights["weight"][0, 0].item(),
        json.loads((folder / "config.json").read_text())["value"],
    }
    assert len(values) == 1
    return values.pop()


@pytest.fixture(scope="module")
def before(tmp_path_factory):
    """A run with as many checkpoints as are kept, and a best one."""
    output = tmp_path_factory.mktemp("run")
    for step in range(1, run_folder.KEPT_CHECKPOINTS + 1):
        save(output, step, float(step))
    run_folder.keep_best(output / "checkpoints" / "step-00000001", output)
    return output


LAST = run_folder.KEPT_CHECKPOINTS
ACTIONS = {
    "a new one": lambda output: save(output, LAST + 1, 10.0),
    "the last one again": lambda output: save(output, LAST, 10.0),
    "a new best": lambda output: run_folder.keep_best(output / "checkpoints" / f"step-{LAST:08d}", output),
}


def killed_at(touch, action, output):
    """In a process of its own: whether it was killed, before its `touch`-th touch of a file or folder."""

    def work():
        touched = 0

        def watch(event, arguments):
            nonlocal touched
            if event in TOUCHES:
                touched += 1
                if touched > touch:
                    os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(watch)
        action(output)

    process = multiprocessing.get_context("fork").Process(target=work)
    process.start()
    process.join()
    assert process.exitcode in (0, -signal.SIGKILL)
    return process.exitcode != 0


@pytest.mark.parametrize("action", ACTIONS.values(), ids=ACTIONS)
def test_killed_at_any_touch_of_a_file_there_is_a_whole_checkpoint_and_the_next_one_is_written(before, tmp_path, action):
    outcomes = set()
    for touch in range(1_000):
        output = tmp_path / str(touch)
        shutil.copytree(before, output)
        killed = killed_at(touch, action, output)
        newest = run_folder.newest(output)
        outcomes.add((newest.name, value_of(newest)))
        assert all(value_of(folder) for folder in (output / "checkpoints").glob("step-*"))
        if (output / "best").exists():
            assert value_of(output / "best") in (1.0, LAST)
        action(output)  # by a process of the same number, as containers have them
        folders = sorted(path.name for path in (output / "checkpoints").iterdir())
        assert len(folders) == LAST and not any(name.startswith(".") for name in (*folders, *os.listdir(output)))
        if not killed:
            break
    assert touch > 10 and len(outcomes) <= 3


def test_killed_at_any_touch_of_a_file_an_amendment_is_there_or_is_not(before, tmp_path):
    for touch in range(100):
        output = tmp_path / str(touch)
        shutil.copytree(before, output)
        checkpoint = run_folder.folder_of(output, LAST)
        killed = killed_at(touch, lambda _: run_folder.amend(checkpoint, score=1), output)  # noqa: B023
        assert value_of(checkpoint) == LAST
        found = run_folder.load(checkpoint)[1]
        assert {**found, "score": 1} == {"step": LAST, "value": float(LAST), "score": 1}
        if not killed:
            break
    assert touch > 3 and found["score"] == 1 and not list(checkpoint.glob(".*"))


def test_a_new_run_is_refused_in_the_folder_of_another_and_told_the_way_out(tmp_path):
    run_folder.check_output(tmp_path / "new", None)
    for step in (100, 200):
        save(tmp_path / "old", step, 1.0)
    with pytest.raises(FileExistsError, match=rf"{tmp_path}/old holds .* up to step 200: --resume {tmp_path}/old .* another --output"):
        run_folder.check_output(tmp_path / "old", None)
    shutil.move(tmp_path / "old" / "checkpoints" / "step-00000100", tmp_path / "best" / "best")
    best = tmp_path / "best" / "best"
    for resume in (None, tmp_path / "best"):
        with pytest.raises(FileExistsError, match=rf"up to step 100: --resume {best} goes on"):
            run_folder.check_output(tmp_path / "best", resume)
    assert run_folder.check_output(tmp_path / "best", best) == best
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError, match=r"--output .*file is a file"):
        run_folder.check_output(tmp_path / "file", None)


def test_a_run_goes_on_in_its_own_folder_from_its_last_checkpoint_or_in_a_new_one_from_any(tmp_path):
    for run in ("run", "other"):
        for step in (100, 200):
            save(tmp_path / run, step, 1.0)
    run = tmp_path / "run"
    first, last = (run / "checkpoints" / f"step-{step:08d}" for step in (100, 200))
    for start in (run, last):
        run_folder.check_output(run, start)
    for start in (run, first, last):
        run_folder.check_output(tmp_path / "new", start)
    with pytest.raises(FileExistsError, match=rf"later checkpoint than {first}: {last}, of step 200. .*another --output, or move"):
        run_folder.check_output(run, first)
    with pytest.raises(FileExistsError, match=rf"{tmp_path}/other holds the checkpoints of another run than {last}"):
        run_folder.check_output(tmp_path / "other", run)
    with pytest.raises(FileNotFoundError, match="no checkpoint to resume from"):
        run_folder.check_output(tmp_path / "new", tmp_path / "nowhere")


def test_the_checkpoint_that_was_just_written_is_never_the_one_that_is_removed(tmp_path):
    for step in (100, 200, 300, 400, 50):
        written = save(tmp_path, step, float(step))
        assert value_of(written) == step and written == run_folder.folder_of(tmp_path, step)
    assert len(list((tmp_path / "checkpoints").iterdir())) == run_folder.KEPT_CHECKPOINTS


def test_the_best_comes_along_into_another_folder_when_its_checkpoint_is_gone(tmp_path):
    run, new = tmp_path / "run", tmp_path / "new"
    run_folder.keep_best(save(run, 1, 1.0), run)
    for step in range(2, 2 + run_folder.KEPT_CHECKPOINTS):
        last = save(run, step, float(step))
    assert not run_folder.folder_of(run, 1).exists()
    assert run_folder.restore_best(last, new, 1) and value_of(new / "best") == 1.0


@pytest.mark.parametrize(("begun", "now"), [({"loss": "zero"}, {}), ({}, {"loss": "zero"}), ({"loss": "zero"}, {"loss": "l1"})])
def test_an_option_that_one_run_alone_has_is_another_option(tmp_path, begun, now):
    state = {"options": {"model": "raft_stereo", **begun}}
    run_folder.require_options(tmp_path, state, {"model": "raft_stereo", **begun}, "--initial-weights W")
    with pytest.raises(
        ValueError, match=rf"with loss {begun.get('loss')}, this one has {now.get('loss')}; .*new run with --initial-weights W"
    ):
        run_folder.require_options(tmp_path, state, {"model": "raft_stereo", **now}, "--initial-weights W")


@pytest.mark.parametrize("file", ["training.pt", "state.json"])
@pytest.mark.parametrize("content", [b"", b"{", b"PK\x03\x04 cut off"])
def test_a_damaged_checkpoint_is_named_file_and_all(tmp_path, file, content):
    folder = save(tmp_path, 1, 1.0)
    (folder / file).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{folder}/{file} is damaged.*resume from another checkpoint"):
        run_folder.load(folder)


def hold(output, pipe):
    with run_folder.claimed(output):
        pipe.send("held")
        signal.pause()


def test_a_folder_that_a_run_is_at_work_in_is_refused_until_it_ends_however_that_is(tmp_path, monkeypatch):
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("fork").Process(target=hold, args=(tmp_path / "run", theirs))
    process.start()
    ours.recv()
    with monkeypatch.context() as patch:
        patch.setattr(run_folder, "LOCK_SECONDS", 0.2)
        message = rf"another run is at work in .*run, process {process.pid} on {re.escape(socket.gethostname())}: stop it first"
        with pytest.raises(BlockingIOError, match=message), run_folder.claimed(tmp_path / "run"):
            pass
    threading.Timer(0.3, process.kill).start()
    with run_folder.claimed(tmp_path / "run"):  # waits for it
        assert (tmp_path / "run" / ".lock").read_text().startswith(f"process {os.getpid()} on ")
    process.join()
    with run_folder.claimed(tmp_path / "run"):
        pass


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP])
def test_on_a_file_system_without_locks_a_run_begins_and_ends_as_elsewhere(tmp_path, monkeypatch, number):
    def none(descriptor, operation):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", none)
    with run_folder.claimed(tmp_path):
        pass
    with pytest.raises(Terminated), run_folder.claimed(tmp_path):
        raise Terminated


def test_one_rank_keeps_other_runs_out_for_all(tmp_path, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    with run_folder.claimed(tmp_path):
        monkeypatch.setenv("RANK", "1")
        with run_folder.claimed(tmp_path):
            pass


def test_a_run_that_resumes_from_its_own_folder_begins_there_where_there_is_nothing_yet(tmp_path):
    output = tmp_path / "run"
    assert run_folder.check_output(output, output) is None
    output.mkdir()
    assert run_folder.check_output(output, tmp_path / "other" / ".." / "run") is None
    with pytest.raises(FileNotFoundError, match="no checkpoint to resume from"):
        run_folder.check_output(output, tmp_path / "other")
    assert run_folder.check_output(output, None) is None
    saved = save(output, 3, 1.0)
    assert run_folder.check_output(output, output) == saved


@pytest.mark.parametrize(("weights", "optimizer"), [(10**6, 1), (1, 10**6)])
def test_a_disk_that_is_full_is_an_error_that_names_the_checkpoint_and_the_room_and_leaves_nothing(tmp_path, weights, optimizer):
    first = save(tmp_path, 1, 1.0)

    def fill_the_disk():
        torch.set_num_threads(1)  # a forked process has not the others
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (10**6, 10**6))
        with pytest.raises(OSError, match=r"step-00000002 could not be written, with [\d,]+ MB free on its disk: .*--resume"):
            run_folder.save(tmp_path, 2, nn.Linear(1, weights), {}, {"optimizer": torch.zeros(optimizer)}, {})

    process = multiprocessing.get_context("fork").Process(target=fill_the_disk)
    process.start()
    process.join()
    assert process.exitcode == 0
    assert list((tmp_path / "checkpoints").iterdir()) == [first] == [run_folder.newest(tmp_path)]
