"""Several ranks (gloo): whatever goes wrong on one of them, all end, and it is named."""

import json
import logging
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import time
import traceback
from contextlib import redirect_stderr, redirect_stdout
from datetime import timedelta
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from accelerate import Accelerator
from accelerate.state import AcceleratorState

from tests.scenes import grey_fill, layered_depth, photo_tar
from tests.test_stream import fingerprint, open_stream
from tests.trainers.test_training import TORCHRUN, arguments_for, config, run_training
from tests.trainers.test_training import launch as launch_trainer
from trainers import loop
from zsdata.faults import FailureBudget
from zsdata.position import require_one_place

LIMIT_SECONDS = 60
TROUBLED = 1  # the rank


def nan_fill(right, inpaint_mask, generators):
    return right * float("nan")


def killed_in(images):
    """A depth estimator that is killed at the worker's third photo."""
    CALLS.append(1)
    if len(CALLS) > 2 * PASSES:
        os.kill(os.getpid(), signal.SIGKILL)
    return layered_depth(images)


def asleep_in(images):
    CALLS.append(1)
    if len(CALLS) > 2 * PASSES:
        time.sleep(1_000)
    return layered_depth(images)


DEPTHS = {"worker killed": killed_in, "worker hangs": asleep_in}
PASSES = 2  # of the depth estimator over a photo: as it is, and mirrored
CALLS: list[int] = []


def train(rank, world, store, tar, case, workers):
    """One rank: a step is a batch and a gradient that all ranks share, as in distributed training."""
    options, troubled = {"epoch_size": 8 * world}, rank == TROUBLED
    if case == "nan":
        options["inpaint"] = nan_fill if troubled else grey_fill
    if case == "bad shard, budget spent":
        options |= {"budget": FailureBudget(count=10, rate=0.1), "epoch_size": 32 * world}
    if case.startswith("bad shard") and troubled:
        damage(tar)
    if case == "cut shard" and troubled:
        data = Path(tar).read_bytes()
        Path(tar).write_bytes(data[: len(data) // 2])
    if case in DEPTHS and troubled:
        options["depth"] = DEPTHS[case]
    stream = open_stream(tar, **options)
    dist.init_process_group("gloo", init_method=f"file://{store}", rank=rank, world_size=world, timeout=timedelta(seconds=LIMIT_SECONDS))
    if case == "cut shard":
        states: list = [None] * world
        dist.all_gather_object(states, stream.state_dict())
        require_one_place(states)
    steps = 0
    with stream.loader(2, num_workers=workers, rank=rank, world_size=world) as loader:
        for batch in loader:
            gradient = batch.left.mean()
            dist.all_reduce(gradient)
            steps += 1
            if case == "killed" and troubled and steps == 2:
                os.kill(os.getpid(), signal.SIGKILL)
        sys.stdout.write(f"rank {rank}: {steps} steps, {loader.stats()['rejected']}\n")
    dist.destroy_process_group()


def damage(tar):
    """Half of the photos of this rank's copy are none any more; the tar around them is whole."""
    path = Path(tar)
    data = bytearray(path.read_bytes())
    start = 0
    for number in range(4):
        start = data.index(b"\xff\xd8\xff", start + 1)
        if number % 2:
            data[start : start + 40] = bytes(40)
    path.write_bytes(data)


def run_rank(rank, log, do, *arguments):
    """Into a file of its own and on one thread, as a launcher does it; OpenMP's threads, which earlier tests used, outlive no fork."""
    torch.set_num_threads(1)
    with open(log, "w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        with redirect_stdout(file), redirect_stderr(file):
            logging.basicConfig(force=True)
            try:
                do(rank, *arguments)
            except Exception:
                traceback.print_exc()
                raise SystemExit(1) from None


def launch(folder, world, case, workers):
    """The exit code and the output of every rank; each has its own copy of the only shard."""
    tars = []
    for rank in range(world):
        (folder / str(rank)).mkdir()
        tars.append(photo_tar(folder / str(rank) / "photos.tar", 4))
    return run_ranks(folder, [(train, world, folder / "store", tar, case, workers) for tar in tars])


def run_ranks(folder, work):
    """What each rank does, and its arguments after the rank; the exit codes and outputs."""
    context, world, ranks = multiprocessing.get_context("fork"), len(work), []
    for rank, arguments in enumerate(work):
        ranks.append(context.Process(target=run_rank, args=(rank, folder / f"{rank}.log", *arguments)))
    start = time.monotonic()
    for process in ranks:
        process.start()
    for process in ranks:
        process.join(max(0.0, start + LIMIT_SECONDS - time.monotonic()))
    hung = [rank for rank, process in enumerate(ranks) if process.exitcode is None]
    for process in ranks:
        process.kill()
    assert not hung, f"ranks {hung} hang"
    return [process.exitcode for process in ranks], [(folder / f"{rank}.log").read_text() for rank in range(world)]


WORLDS = [2, pytest.param(3, marks=pytest.mark.slow), pytest.param(4, marks=pytest.mark.slow)]


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("workers", [0, 1])
def test_more_ranks_than_shards_take_equal_steps_and_end(tmp_path, world, workers):
    codes, outputs = launch(tmp_path, world, "few shards", workers)
    assert codes == [0] * world and outputs == [f"rank {rank}: 4 steps, {{}}\n" for rank in range(world)]


@pytest.mark.parametrize("world", WORLDS)
def test_a_bad_shard_on_one_rank_is_counted_there_and_the_steps_stay_equal(tmp_path, world):
    codes, outputs = launch(tmp_path, world, "bad shard", 1)
    assert codes == [0] * world
    for rank, output in enumerate(outputs):
        assert f"rank {rank}: 4 steps" in output and ("not a JPEG" in output) == (rank == TROUBLED)


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("bad shard, budget spent", f"rank {TROUBLED} of {{world}} stops: TooManyFaults: "),
        ("nan", f"rank {TROUBLED} of {{world}} stops: ValueError: the inpainter"),
        ("worker killed", f"rank {TROUBLED} of {{world}} stops: WorkerLost: worker 0 of 1 (process "),
        pytest.param("worker hangs", f"rank {TROUBLED} of {{world}} stops: WorkerLost: worker 0 of 1 (process ", marks=pytest.mark.slow),
    ],
)
def test_a_rank_that_fails_ends_the_others_and_is_named(tmp_path, world, case, message):
    codes, outputs = launch(tmp_path, world, case, 1)
    assert all(code != 0 for code in codes)
    assert message.format(world=world) in outputs[TROUBLED]
    assert not any(
        message.format(world=world).rpartition(" stops: ")[2] in output for rank, output in enumerate(outputs) if rank != TROUBLED
    )


@pytest.mark.parametrize("world", WORLDS)
def test_a_shard_that_is_cut_on_one_rank_is_noticed_before_the_first_step(tmp_path, world):
    codes, outputs = launch(tmp_path, world, "cut shard", 1)
    assert codes == [1] * world
    assert all(f"ValueError: rank {TROUBLED} differs from rank 0: its manifest is" in output for output in outputs)


@pytest.mark.parametrize("world", WORLDS)
def test_a_killed_rank_ends_the_others(tmp_path, world):
    codes, _ = launch(tmp_path, world, "killed", 1)
    assert codes[TROUBLED] == -signal.SIGKILL and all(code != 0 for code in codes)


@pytest.mark.slow
def test_the_launcher_names_a_killed_rank(tmp_path):
    tar = photo_tar(tmp_path / "photos.tar", 4)
    script = tmp_path / "script.py"
    script.write_text(
        f"import os, sys\nsys.path.insert(0, {str(Path(__file__).resolve().parents[1])!r})\nfrom tests.test_ranks import train\n"
        f"if __name__ == '__main__':\n    train(int(os.environ['RANK']), 2, {str(tmp_path / 'store')!r}, {tar!r}, 'killed', 1)\n"
    )
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2", str(script)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_SECONDS)
    assert run.returncode != 0 and "Signal 9 (SIGKILL)" in run.stderr
    assert f"rank      : {TROUBLED}" in run.stderr


def train_under_accelerate(rank, world, port, tar, folder, load, save_after, workers):
    """Goes on from the checkpoint `load`, saves one after some batches, goes on to the end of the epoch; what it saw of each."""
    os.environ |= {
        "RANK": str(rank),
        "LOCAL_RANK": str(rank),
        "WORLD_SIZE": str(world),
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
        "OMP_NUM_THREADS": "1",  # or Accelerate sets it, with a warning
    }
    AcceleratorState._reset_state(reset_partial_state=True)  # the parent's, a single process's, came along with the fork
    accelerator = Accelerator(cpu=True)
    assert (accelerator.process_index, accelerator.num_processes) == (rank, world)
    place = {"rank": accelerator.process_index, "world_size": accelerator.num_processes}
    with open_stream(tar, epoch_size=24).loader(1, num_workers=workers, **place) as loader:
        loader = accelerator.prepare(loader)
        accelerator.register_for_checkpointing(loader)
        if load is not None:
            accelerator.load_state(str(folder / load))
        seen: list[list] = [[], []]
        for batch in loader:
            accelerator.reduce(batch.left.mean())  # as gradients are
            seen[len(seen[0]) >= save_after].append([batch.meta[0]["index"], fingerprint(batch[0])])
            if save_after and len(seen[0]) == save_after and not seen[1]:
                accelerator.save_state(str(folder / "checkpoint"))
    (folder / f"seen-{rank}.json").write_text(json.dumps(seen))
    accelerator.end_training()


def in_order(folder, world, part):
    ranks = [json.loads((folder / f"seen-{rank}.json").read_text())[part] for rank in range(world)]
    return [pair for step in zip(*ranks, strict=True) for pair in step]


def free_port():
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        return held.getsockname()[1]


@pytest.mark.parametrize(("before", "after"), [(2, 3), *(pytest.param(*pair, marks=pytest.mark.slow) for pair in ((4, 1), (1, 4), (3, 2)))])
def test_accelerate_saves_on_some_ranks_and_goes_on_with_others(tmp_path, before, after):
    tar = photo_tar(tmp_path / "photos.tar", 5)
    with open_stream(tar, epoch_size=24).loader(1) as loader:
        unbroken = [[batch.meta[0]["index"], fingerprint(batch[0])] for batch in loader]
    codes, outputs = run_ranks(tmp_path, [(train_under_accelerate, before, free_port(), tar, tmp_path, None, 12 // before, 1)] * before)
    assert codes == [0] * before, outputs
    assert in_order(tmp_path, before, 0) == unbroken[:12] and in_order(tmp_path, before, 1) == unbroken[12:]
    codes, outputs = run_ranks(tmp_path, [(train_under_accelerate, after, free_port(), tar, tmp_path, "checkpoint", 0, 2)] * after)
    assert codes == [0] * after, outputs
    assert in_order(tmp_path, after, 1) == unbroken[12:]


TRAINER = """
import os, sys
sys.path.insert(0, {root!r})
from trainers import raft

sys.argv[sys.argv.index("--sources") + 1] += os.environ["RANK"] + ".tar"
raft.run(raft.main)
"""


@pytest.mark.slow
def test_a_training_whose_shard_is_cut_on_one_node_names_the_rank_and_ends(tmp_path):
    script, sources = tmp_path / "script.py", tmp_path / "photos-"
    script.write_text(TRAINER.format(root=str(Path(__file__).resolve().parents[1])))
    for rank, count in enumerate((8, 7)):
        photo_tar(Path(f"{sources}{rank}.tar"), count)
    arguments = arguments_for(sources, tmp_path / "run", "--steps", 2, "--tracker", "none")
    start = time.monotonic()
    run = launch_trainer(arguments, 2, script, TORCHRUN)
    assert run.returncode != 0 and time.monotonic() - start < LIMIT_SECONDS
    assert "rank 1 differs from rank 0: its manifest is" in run.stderr


def test_a_training_asks_all_ranks_for_their_place_before_its_first_step(tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "gather_object", lambda own: [*own, {**own[0], "manifest": "other"}])
    with pytest.raises(ValueError, match="rank 1 differs from rank 0: its manifest is 'other'"):
        run_training(photo_tar(tmp_path / "photos.tar", 4), tmp_path / "run", config(steps=1))
    assert not list((tmp_path / "run").glob("*"))
    AcceleratorState._reset_state(reset_partial_state=True)
