import json
import os
import signal
import time

import cv2
import numpy as np
import pytest
import torch
from accelerate import Accelerator
from accelerate.state import GradientState

from tests.scenes import grey_fill, layered_depth, photo_tar
from tests.test_stream import by_index, open_stream
from zsdata import StereoBatch
from zsdata.faults import WorkerLost


@pytest.fixture(scope="module")
def tar(tmp_path_factory):
    return photo_tar(tmp_path_factory.mktemp("tar") / "photos.tar", 13)


def indices(batches):
    return [(meta["epoch"], meta["index"]) for batch in batches for meta in batch.meta]


def test_an_epoch_leaves_out_what_does_not_fill_a_batch(tar):
    with open_stream(tar).loader(4) as loader:
        assert len(loader) == 3
        assert indices(loader) == [(0, i) for i in range(12)]
        assert indices(loader) == [(1, i) for i in range(12)]


@pytest.mark.parametrize("world_size", [2, 3])
def test_ranks_share_an_epoch_without_overlap_and_in_equal_steps(tar, world_size):
    parts = []
    for rank in range(world_size):
        with open_stream(tar).loader(2, rank=rank, world_size=world_size) as loader:
            parts.append(list(loader))
    assert len({len(part) for part in parts}) == 1
    seen = sorted(index for part in parts for index in indices(part))
    assert seen == [(0, i) for i in range(13 // (2 * world_size) * 2 * world_size)]
    # Global batch g is samples [g R B, (g + 1) R B), rank by rank.
    assert indices(parts[1][:1]) == [(0, 2), (0, 3)]


def test_a_loader_asks_the_launcher_which_rank_it_is(tar, monkeypatch):
    """`torchrun` and `accelerate launch` say it in the environment, before any process group is there."""
    expected = [list(open_stream(tar).loader(2, rank=rank, world_size=3)) for rank in range(3)]
    for rank in range(3):
        monkeypatch.setenv("RANK", str(rank))
        monkeypatch.setenv("WORLD_SIZE", "3")
        loader = open_stream(tar).loader(2)
        assert (loader.rank, loader.world_size) == (rank, 3) and indices(loader) == indices(expected[rank])
        assert open_stream(tar).loader(2, rank=0, world_size=1).world_size == 1
    monkeypatch.setenv("WORLD_SIZE", "")
    assert open_stream(tar).loader(2).world_size == 1
    with pytest.raises(ValueError, match="rank and world_size are given together or not at all; got rank=1, world_size=None"):
        open_stream(tar).loader(2, rank=1)


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("stop", range(1, 8))
def test_resume_gives_the_batches_that_the_unbroken_run_gives(tar, workers, stop):
    with open_stream(tar).loader(3, num_workers=2) as loader:
        unbroken = [*loader, *loader]
    with open_stream(tar).loader(3, num_workers=workers) as loader:
        first = []
        while len(first) < stop:
            for batch in loader:
                first.append(batch)
                if len(first) == stop:
                    break
        state = json.loads(json.dumps(loader.state_dict()))
    with open_stream(tar).loader(3, num_workers=workers) as loader:
        loader.load_state_dict(state)
        rest = list(loader)
        if stop < 4:
            rest += list(loader)
    both = [*first, *rest]
    assert indices(both) == indices(unbroken)
    assert by_index(batch[i] for batch in both for i in range(3)) == by_index(batch[i] for batch in unbroken for i in range(3))


def test_resume_on_other_ranks_and_batches_gives_every_sample_once(tar):
    with open_stream(tar).loader(2, rank=0, world_size=2) as loader:
        next(iter(loader))
        state = loader.state_dict()
    assert state["samples"] == 4
    rest = []
    for rank in range(3):
        with open_stream(tar).loader(1, rank=rank, world_size=3) as loader:
            loader.load_state_dict(state)
            rest += indices(loader)
    assert sorted(rest) == [(0, i) for i in range(4, 13)]


def test_a_rest_too_small_for_the_new_batch_is_left_out(tar):
    stream = open_stream(tar)
    with stream.loader(12) as loader:
        loader.load_state_dict({**stream.state_dict(), "samples": 6})
        assert indices([next(iter(loader))]) == [(1, i) for i in range(12)]


def test_prefetched_batches_do_not_count(tar):
    with open_stream(tar).loader(2, num_workers=2) as loader:
        for count, _ in enumerate(loader, 1):
            assert loader.state_dict()["samples"] == (2 * count if count < 6 else 0)
        assert loader.state_dict()["epoch"] == 1


def test_swapped_sources_reach_workers_that_have_prefetched(tmp_path):
    first, second = photo_tar(tmp_path / "a.tar", 4), photo_tar(tmp_path / "b.tar", 4, first_seed=50)
    stream = open_stream(first)
    with stream.loader(2, num_workers=2) as loader:
        for number, batch in enumerate(loader):
            if number == 0:
                stream.set_sources({"b": second}, epoch=1)
            assert {meta["source"] for meta in batch.meta} == {"photos"}
        assert {meta["source"] for batch in loader for meta in batch.meta} == {"b"}


@pytest.mark.parametrize("inside", [True, False])
def test_an_epoch_that_a_swap_leaves_nothing_of_is_over(tmp_path, inside):
    """A trainer that asks for epoch after epoch would otherwise be given nothing for ever."""
    stream = open_stream(photo_tar(tmp_path / "a.tar", 8))
    few = photo_tar(tmp_path / "b.tar", 4, first_seed=50)
    with stream.loader(2) as loader:
        list(loader)
        loop = iter(loader)
        for _ in range(3):
            next(loop)
        if not inside:
            loop.close()
        stream.set_sources(few, epoch=1)
        assert list(loop) == []
        if not inside:
            assert list(loader) == []
        assert loader.epoch == 2 and indices(loader) == [(2, 0), (2, 1), (2, 2), (2, 3)]


def test_accelerate_leaves_the_loader_alone_and_sees_the_end_of_the_epoch(tar):
    accelerator = Accelerator(cpu=True, gradient_accumulation_steps=3)
    with open_stream(tar).loader(3) as loader:
        assert accelerator.prepare(loader) is loader
        model = torch.nn.Linear(1, 1)
        synchronised = []
        for _ in loader:
            with accelerator.accumulate(model):
                synchronised.append(accelerator.sync_gradients)
        assert synchronised == [False, False, True, True]  # the fourth is the epoch's last
    assert not GradientState().in_dataloader


def test_accelerate_forgets_a_loop_that_was_broken_off(tar):
    with open_stream(tar).loader(3) as loader:
        for _ in loader:
            break
        assert not GradientState().in_dataloader


def test_a_failing_worker_is_an_error_and_the_loader_can_go_on(tar):
    class FailsOnce:
        def __init__(self):
            self.calls = 0

        def __call__(self, images):
            self.calls += 1
            if self.calls == 4:
                raise RuntimeError("flaky")
            return layered_depth(images)

    with open_stream(tar, depth=FailsOnce()).loader(1) as loader:
        seen = []
        with pytest.raises(RuntimeError, match="flaky"):
            for batch in loader:
                seen.append(batch)
        seen += list(loader)
    assert indices(seen) == [(0, i) for i in range(13)]


def test_an_error_in_a_worker_process_names_the_sample(tar):
    def broken(images):
        raise RuntimeError("out of luck")

    with open_stream(tar, depth=broken).loader(2, num_workers=1) as loader, pytest.raises(RuntimeError, match="sample 0 of epoch 0"):
        next(iter(loader))


def test_a_killed_worker_is_named_and_the_loader_can_go_on(tar):
    with open_stream(tar).loader(2, num_workers=2) as loader:
        batches = iter(loader)
        seen = [next(batches)]
        os.kill(loader._pipeline._pool._members[1].process.pid, signal.SIGKILL)
        with pytest.raises(WorkerLost, match=r"worker 1 of 2 \(process \d+\) was killed by SIGKILL; it was at sample \d+ of epoch 0"):
            for batch in batches:
                seen.append(batch)
        seen += list(loader)
    assert indices(seen) == [(0, i) for i in range(12)]


@pytest.mark.parametrize("context", ["spawn", "forkserver"])
def test_other_ways_to_start_processes_give_the_same_batches(tar, context):
    with open_stream(tar).loader(4) as loader:
        expected = by_index(batch[i] for batch in loader for i in range(4))
    with open_stream(tar).loader(4, num_workers=1, multiprocessing_context=context) as loader:
        assert by_index(batch[i] for batch in loader for i in range(4)) == expected


@pytest.mark.parametrize("options", [{"micro_batch": 1}, {"micro_batch": 3}])
def test_the_micro_batch_changes_nothing(tar, options):
    with open_stream(tar).loader(4) as loader:
        expected = by_index(batch[i] for batch in loader for i in range(4))
    with open_stream(tar).loader(4, **options) as loader:
        assert by_index(batch[i] for batch in loader for i in range(4)) == expected


def test_stats_count_batches_and_time(tar):
    with open_stream(tar).loader(4) as loader:
        list(loader)
        stats = loader.stats()
    assert stats["batches"] == 3 and stats["pairs"] == 12 and stats["rejected"] == {}
    assert stats["ready_batches"] == 0  # without workers nothing is made ahead
    assert {"read", "decode", "depth", "warp", "inpaint", "augment", "wait"} <= stats["seconds"].keys()


def test_stats_say_how_many_batches_lay_ready(tar):
    with open_stream(tar).loader(4, num_workers=2) as loader:
        batches = iter(loader)
        next(batches)
        deadline = time.monotonic() + 30
        while loader._pipeline.ready < 4 and time.monotonic() < deadline:  # two workers, two batches each
            time.sleep(0.01)
        next(batches)
        assert loader.stats()["ready_batches"] >= 2  # the mean of the first time, none or more, and of this one, four


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": 0}, "batch_size"),
        ({"batch_size": 14}, "less than one batch of 14"),
        ({"batch_size": 1, "num_workers": -1}, "num_workers"),
        ({"batch_size": 1, "rank": 2, "world_size": 2}, "rank 2 of 2"),
        ({"batch_size": 1, "micro_batch": 0}, "micro_batch"),
    ],
)
def test_arguments_that_cannot_work_are_refused_at_once(tar, options, message):
    with pytest.raises(ValueError, match=message):
        open_stream(tar).loader(**options)


def test_a_batch_is_what_the_table_says(tar):
    with open_stream(tar, inpaint=grey_fill).loader(2) as loader:
        batch = next(iter(loader))
    assert isinstance(batch, StereoBatch) and len(batch) == 2 and len(batch.meta) == 2
    left, right, disparity, confidence, masks = batch
    assert left.shape == right.shape == (2, 3, 64, 96)
    assert disparity.shape == confidence.shape == masks.inpaint.shape == (2, 1, 64, 96)


def test_workers_start_after_opencv_has_used_its_own_threads(tar):
    """A forked child inherits OpenCV's thread pool without the threads, and would wait for them for ever."""
    image = np.zeros((2000, 2000), np.float32)
    threads = cv2.getNumThreads()
    try:
        cv2.setNumThreads(2)
        for _ in range(3):
            cv2.resize(image, (3000, 3000), interpolation=cv2.INTER_CUBIC)
        time.sleep(0.5)  # the pool goes to sleep
        with open_stream(tar).loader(4, num_workers=2) as loader:
            assert len(list(loader)) == 3
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(threads)
