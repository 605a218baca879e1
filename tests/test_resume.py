"""Resume anywhere: at any batch, with other workers, ranks and batch sizes, through Accelerate; the same bytes, in constant time."""

import json
import time
from collections import Counter
from itertools import islice

import pytest
import torch
from accelerate import Accelerator

from tests.scenes import jpeg, photo, write_tar
from tests.test_stream import fingerprint, open_stream

EPOCH = 24  # samples; with half of them seen, what is left divides among 1, 2, 3 or 4 ranks
SEEN = 12
WORLDS, WORKERS = (1, 2, 3, 4), (0, 1, 2, 3, 4)
CI_WORKERS = [(0, 0), (2, 1)]


@pytest.fixture(scope="module")
def tar(tmp_path_factory):
    """Photos of which some are none."""
    good = {f"{i:03d}.jpg": jpeg(photo(i)) for i in range(9)}
    bad = {"100.jpg": jpeg(photo(50))[:1500], "101.jpg": b"<html>" * 30, "102.jpg": b""}
    return write_tar(tmp_path_factory.mktemp("tar") / "photos.tar", {**good, **bad})


def pairs_of(batches):
    return [
        (pair.meta["epoch"], pair.meta["index"], fingerprint(pair)) for batch in batches for pair in (batch[i] for i in range(len(batch)))
    ]


def endless(loader):
    while True:
        yield from loader


@pytest.fixture(scope="module")
def stream(tar):
    return open_stream(tar, epoch_size=EPOCH)


@pytest.fixture(scope="module")
def unbroken(stream):
    with stream.loader(1) as loader:
        return pairs_of(islice(endless(loader), 2 * EPOCH))


def every_rank(stream, world, workers, steps, state=None):
    """What all ranks together see in so many steps each, in global order, and their states afterwards."""
    parts, states = [], []
    for rank in range(world):
        with stream.loader(1, num_workers=workers, rank=rank, world_size=world) as loader:
            if state is not None:
                loader.load_state_dict(state)
            parts.append(pairs_of(islice(endless(loader), steps)))
            states.append(loader.state_dict())
    assert all(other == states[0] for other in states)
    return [pair for step in zip(*parts, strict=True) for pair in step], states[0]


def check_all_pairs(stream, unbroken, worker_pairs):
    for world in WORLDS:
        for workers in sorted({before for before, _ in worker_pairs}):
            first, state = every_rank(stream, world, workers, SEEN // world)
            assert first == unbroken[:SEEN] and state["samples"] == SEEN
            for other_world in WORLDS:
                for other_workers in sorted({after for before, after in worker_pairs if before == workers}):
                    # To the end of the epoch and as far again into the next one: in global order, nothing lost, nothing doubled.
                    rest, _ = every_rank(stream, other_world, other_workers, 2 * SEEN // other_world, json.loads(json.dumps(state)))
                    assert Counter(rest) == Counter(unbroken[SEEN : 3 * SEEN]) and rest == unbroken[SEEN : 3 * SEEN]


def test_a_state_is_taken_on_by_any_number_of_ranks_and_workers(stream, unbroken):
    check_all_pairs(stream, unbroken, CI_WORKERS)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_state_is_taken_on_by_every_number_of_ranks_and_workers(stream, unbroken):
    check_all_pairs(stream, unbroken, [(before, after) for before in WORKERS for after in WORKERS])


@pytest.mark.filterwarnings("ignore::zsdata.synthesis.depth.builtin.BuiltinDepthWarning")
@pytest.mark.parametrize("kept", [True, False], ids=["one loader", "new loaders"])
@pytest.mark.parametrize("workers", [0, 2, *(pytest.param(workers, marks=pytest.mark.slow) for workers in (1, 4))])
def test_every_batch_is_a_place_to_resume_at_with_real_decoding_and_synthesis(tar, workers, kept):
    options = {"depth": "builtin", "inpaint": "builtin", "epoch_size": 8, "views_per_image": 2, "reuse": 2}
    stream = open_stream(tar, **options)
    with stream.loader(2) as loader:
        start, batches = loader.state_dict(), 2 * len(loader)
        expected = pairs_of(islice(endless(loader), batches))
    loader = stream.loader(2, num_workers=workers)
    for stop in range(1, batches):
        loader.load_state_dict(start)
        seen = pairs_of(islice(endless(loader), stop))
        state = json.loads(json.dumps(loader.state_dict()))
        if not kept:
            loader.close()
            loader = open_stream(tar, **options).loader(2, num_workers=workers)
        loader.load_state_dict(state)
        seen += pairs_of(islice(endless(loader), min(2, batches - stop)))  # across the epoch's edge, where that is near
        assert seen == expected[: len(seen)]
    loader.close()


def test_a_place_far_into_an_epoch_is_reached_at_once(tar):
    stream = open_stream(tar, epoch_size=10_000_000)
    with stream.loader(4, num_workers=2) as loader:
        first = next(iter(loader))
    start = time.monotonic()
    with stream.loader(4, num_workers=2) as loader:
        loader.load_state_dict({**stream.state_dict(), "epoch": 7, "samples": 100_000})
        batch = next(iter(loader))
        seconds = time.monotonic() - start
    assert [meta["index"] for meta in batch.meta] == [100_000, 100_001, 100_002, 100_003] and len(first) == 4
    assert seconds < 2


def test_a_state_beyond_its_epoch_is_refused(stream):
    with stream.loader(1) as loader, pytest.raises(ValueError, match="the state's samples is 25, but epoch 3 has only 24"):
        loader.load_state_dict({**stream.state_dict(), "epoch": 3, "samples": 25})


def test_accelerate_saves_and_loads_the_place(stream, unbroken, tmp_path):
    accelerator = Accelerator(cpu=True)
    model = accelerator.prepare(torch.nn.Linear(2, 1))
    with stream.loader(2, num_workers=1) as loader:
        accelerator.register_for_checkpointing(loader)
        seen = pairs_of(islice(loader, 5))
        accelerator.save_state(str(tmp_path / "checkpoint"))
        later = pairs_of(islice(loader, 2))
        accelerator.load_state(str(tmp_path / "checkpoint"))
        again = pairs_of(islice(loader, 2))
    assert seen + later == unbroken[:14] and again == later and model is not None
    # What Accelerate writes is a pickle; of ours there is nothing in it but numbers and strings, so that it can be read without running it.
    state = torch.load(tmp_path / "checkpoint" / "custom_checkpoint_0.pkl", weights_only=True)
    assert state == json.loads(json.dumps(state)) and state["samples"] == 10


def test_a_checkpoint_of_accelerate_is_taken_on_by_another_number_of_ranks(stream, unbroken, tmp_path):
    accelerator = Accelerator(cpu=True)
    with stream.loader(4) as loader:
        accelerator.register_for_checkpointing(loader)
        next(iter(loader))
        accelerator.save_state(str(tmp_path / "checkpoint"))
    rest = []
    for rank in range(2):
        other = Accelerator(cpu=True)
        other._custom_objects.clear()
        with stream.loader(1, rank=rank, world_size=2) as loader:
            other.register_for_checkpointing(loader)
            other.load_state(str(tmp_path / "checkpoint"))
            rest.append(pairs_of(loader))
    assert [pair for step in zip(*rest, strict=True) for pair in step] == unbroken[4:EPOCH]
