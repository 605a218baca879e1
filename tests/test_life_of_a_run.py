"""A run that is killed, interrupted, resumed and started again: nothing lost, nothing doubled, nothing left behind."""

import json
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
import torch

from tests.scenes import jpeg, layered_depth, photo, photo_tar, write_tar
from tests.test_pool import gone, shared_memory
from tests.test_stream import fingerprint, open_stream

ROOT = Path(__file__).resolve().parents[1]
RUN_LIMIT_SECONDS = 60  # of one run, between two kills; a run that takes longer hangs
PHOTOS = 13
BATCH = 2


@pytest.fixture(scope="module")
def tar(tmp_path_factory):
    return photo_tar(tmp_path_factory.mktemp("tar") / "photos.tar", PHOTOS)


def seen_in(batch):
    return [[batch[i].meta["epoch"], batch[i].meta["index"], fingerprint(batch[i])] for i in range(len(batch))]


def train(tar, checkpoint, workers, target):
    """Goes on from the checkpoint until `target` samples have been seen; writes one after every batch, by rename."""
    saved = json.loads(checkpoint.read_text()) if checkpoint.exists() else {"state": None, "seen": []}
    with open_stream(tar).loader(BATCH, num_workers=workers) as loader:
        if saved["state"] is not None:
            loader.load_state_dict(saved["state"])
        seen = saved["seen"]
        while len(seen) < target:
            for batch in loader:
                seen += seen_in(batch)
                unfinished = checkpoint.with_suffix(".new")
                unfinished.write_text(json.dumps({"state": loader.state_dict(), "seen": seen}))
                os.replace(unfinished, checkpoint)
                if len(seen) >= target:
                    break


def processes_below(pid):
    try:
        return [child.pid for child in psutil.Process(pid).children(recursive=True)]
    except psutil.NoSuchProcess:
        return []


def survive(tar, folder, kills, seed):
    """Kills a worker or the training process `kills` times, starts again each time, and lets the last run end; what was seen in all."""
    chance, checkpoint = random.Random(seed), folder / "checkpoint.json"
    context, counts = multiprocessing.get_context("fork"), {"main": 0, "worker": 0}
    while sum(counts.values()) < kills:
        run = context.Process(target=train, args=(tar, checkpoint, chance.choice([1, 2, 3]), 10**9))
        run.start()
        assert run.pid is not None
        time.sleep(chance.uniform(0, 0.6))
        below = processes_below(run.pid)
        if below and chance.random() < 0.5:
            victim = "worker"
            psutil.Process(chance.choice(below)).kill()
        else:
            victim = "main"
            os.kill(run.pid, signal.SIGKILL)
        run.join(RUN_LIMIT_SECONDS)
        assert run.exitcode is not None, f"hangs after kill {sum(counts.values())} ({victim})"
        assert run.exitcode == (-signal.SIGKILL if victim == "main" else 1)
        assert gone(below), f"orphans after kill {sum(counts.values())} ({victim})"
        counts[victim] += 1
    so_far = len(json.loads(checkpoint.read_text())["seen"]) if checkpoint.exists() else 0
    last = context.Process(target=train, args=(tar, checkpoint, 2, so_far + 3 * BATCH))
    last.start()
    last.join(RUN_LIMIT_SECONDS)
    assert last.exitcode == 0 and min(counts.values()) > 0
    return json.loads(checkpoint.read_text())["seen"]


@pytest.mark.parametrize("kills", [20, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.timeout(1800)
def test_a_run_that_is_killed_again_and_again_equals_the_unbroken_one(tar, tmp_path, kills, capfd):
    before = shared_memory()
    seen = survive(tar, tmp_path, kills, seed=kills)
    unbroken = []
    with open_stream(tar).loader(BATCH) as loader:
        while len(unbroken) < len(seen):
            for batch in loader:
                unbroken += seen_in(batch)
                if len(unbroken) == len(seen):
                    break
    assert seen == unbroken and len(seen) > PHOTOS
    assert shared_memory() == before
    errors = capfd.readouterr().err  # what the runs said whose worker was killed
    assert "was killed by SIGKILL; it was" in errors and "Process zsdata worker" not in errors  # and the workers themselves said nothing


INTERRUPTED = """
import signal, sys, time
sys.path.insert(0, {root!r})
from tests.test_stream import open_stream

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell starts what runs in its background with Ctrl-C ignored
    with open_stream({tar!r}).loader(2, num_workers=2, multiprocessing_context={context!r}) as loader:
        next(iter(loader))
        print("going", flush=True)
        while True:
            for batch in loader:
                time.sleep(0.001)
"""


@pytest.mark.parametrize(
    "context", ["fork", pytest.param("spawn", marks=pytest.mark.slow), pytest.param("forkserver", marks=pytest.mark.slow)]
)
def test_ctrl_c_is_one_keyboard_interrupt_and_the_processes_are_gone(tar, tmp_path, context):
    script = tmp_path / "script.py"
    script.write_text(INTERRUPTED.format(root=str(ROOT), tar=tar, context=context))
    run = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
    assert run.stdout is not None and run.stdout.readline() == "going\n"
    time.sleep(0.3)
    below = processes_below(run.pid)
    assert len(below) >= 2
    os.killpg(run.pid, signal.SIGINT)  # as a terminal does it: to every process of the group
    try:
        _, errors = run.communicate(timeout=30)
    finally:
        run.kill()
    assert run.returncode == -signal.SIGINT
    assert errors.count("Traceback") == errors.count("KeyboardInterrupt") == 1, errors
    assert gone(below)


DIGESTS = """
import hashlib, sys
sys.path.insert(0, {root!r})
from tests.test_stream import fingerprint, open_stream

if __name__ == "__main__":
    with open_stream({tar!r}, depth="builtin", inpaint="builtin").loader(2, num_workers=2, multiprocessing_context=sys.argv[1]) as loader:
        prints = [fingerprint(batch[i]) for batch in loader for i in range(2)]
    print(len(prints), hashlib.sha256("".join(prints).encode()).hexdigest())
"""


def test_the_bytes_are_the_same_for_every_way_to_start_processes_and_every_hash_seed(tar, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(DIGESTS.format(root=str(ROOT), tar=tar))
    runs = []
    for context, seed in (("fork", "0"), ("forkserver", "1"), ("spawn", "4242")):
        environment = {**os.environ, "PYTHONHASHSEED": seed, "PYTHONWARNINGS": "ignore"}
        runs.append(subprocess.Popen([sys.executable, str(script), context], stdout=subprocess.PIPE, text=True, env=environment))
    outputs = {run.communicate(timeout=120)[0] for run in runs}
    assert [run.returncode for run in runs] == [0, 0, 0]
    assert len(outputs) == 1 and outputs.pop().startswith("12 ")


WITH_ONE_PAGE = 'mount -t tmpfs -o size=4096 none /dev/shm && exec "$@"'


@pytest.mark.parametrize("context", ["fork", *(pytest.param(context, marks=pytest.mark.slow) for context in ("spawn", "forkserver"))])
def test_a_dev_shm_of_one_page_is_enough(tar, tmp_path, context):
    """As containers are given 64 MiB, where loaders that hand over batches in it die of a bus error."""
    own_mounts = ["unshare", "--mount", *([] if os.geteuid() == 0 else ["--user", "--map-root-user"]), "sh", "-c", WITH_ONE_PAGE, "sh"]
    if shutil.which("unshare") is None or subprocess.run([*own_mounts, "true"], capture_output=True).returncode:
        pytest.skip("no mounts of one's own here")
    script = tmp_path / "script.py"
    script.write_text(DIGESTS.format(root=str(ROOT), tar=tar))
    environment = {**os.environ, "PYTHONWARNINGS": "ignore"}
    run = subprocess.run([*own_mounts, sys.executable, str(script), context], capture_output=True, text=True, env=environment, timeout=120)
    assert run.stdout.startswith("12 "), run.stderr


class NamedDepth:
    cache_name = "layers"
    __call__ = staticmethod(layered_depth)


def run_beside(tar, folder, results):
    torch.set_num_threads(1)  # OpenMP's threads of a parent that has used them do not come along
    stream = open_stream(tar, depth=NamedDepth(), depth_cache=folder / "depth")
    with stream.loader(BATCH, num_workers=2, rejected=folder / "rejected.jsonl") as loader:
        seen = [seen for batch in loader for seen in seen_in(batch)]
    results.send(seen)


def test_two_runs_on_one_machine_do_not_meet(tmp_path):
    """Though they start at once, fill one depth cache, write one list of refusals, and one of them is killed."""
    tar = write_tar(tmp_path / "photos.tar", {f"{i}.jpg": jpeg(photo(i)) for i in range(12)} | {"bad.jpg": b"<html>"})
    context, runs, ends = multiprocessing.get_context("fork"), [], []
    for _ in range(3):
        ours, theirs = context.Pipe(duplex=False)
        runs.append(context.Process(target=run_beside, args=(tar, tmp_path, theirs)))
        runs[-1].start()
        ends.append(ours)
    try:
        runs[2].kill()
        first, second = (end.recv() for end in ends[:2])
        for run in runs:
            run.join(RUN_LIMIT_SECONDS)
        exits = [run.exitcode for run in runs]
    finally:
        for run in runs:
            run.kill()
    assert exits == [0, 0, -signal.SIGKILL]
    with open_stream(tar, depth=NamedDepth()).loader(BATCH) as loader:
        alone = [seen for batch in loader for seen in seen_in(batch)]
        refused = sum(loader.stats()["rejected"].values())
    assert first == second == alone and len(first) == 12
    rows = [json.loads(line) for line in (tmp_path / "rejected.jsonl").read_text().splitlines()]
    assert {row["key"] for row in rows} == {"bad"} and len(rows) >= 2 * refused > 0
