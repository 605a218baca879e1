"""A long run holds no more at its end than after its first minute: memory, files, threads, processes, shared memory."""

import numpy as np
import psutil
import pytest

from tests.scenes import jpeg, photo, write_tar
from tests.test_pool import shared_memory
from tests.test_stream import open_stream

WARM_UP = 0.25  # of the run: allocators and caches fill
MIB = 2**20


def held_by(process):
    return process.num_fds(), process.num_threads(), len(process.children(recursive=True))


def held(main):
    return held_by(main), len(shared_memory()), [held_by(child) for child in main.children()]


@pytest.mark.timeout(7200)
@pytest.mark.parametrize(
    ("samples", "most_slope_mib", "workers"),
    [(2_000, None, 1), pytest.param(200_000, 1.0, 2, marks=pytest.mark.slow), pytest.param(200_000, 1.0, 0, marks=pytest.mark.slow)],
)
def test_nothing_grows(tmp_path, samples, most_slope_mib, workers):
    good = {f"{i:03d}.jpg": jpeg(photo(i, 40, 48)) for i in range(50)}
    bad = {"bad.jpg": jpeg(photo(60, 40, 48))[:400]}
    stream = open_stream(write_tar(tmp_path / "photos.tar", {**good, **bad}), size=(32, 32), epoch_size=1_000)
    main, places, memory = psutil.Process(), [], []
    with stream.loader(10, num_workers=workers, rejected=tmp_path / "rejected.jsonl") as loader:
        seen = 0
        while seen < samples:
            for batch in loader:
                seen += len(batch)
                loader.state_dict(), loader.stats()
                if seen == 1_000:
                    before = held(main)
                if seen % max(100, samples // 200) == 0:
                    places.append(seen)
                    memory.append([process.memory_info().rss for process in (main, *main.children())])
        after = held(main)
    for now, then in zip(after, before, strict=True):  # less is no leak: what tests before this one left may go
        assert np.all(np.array(now) <= np.array(then)), f"files, threads, processes or shared memory grew: {before} to {after}"
    late = [i for i, place in enumerate(places) if place > WARM_UP * samples]
    for process in range(1 + workers):
        resident = np.array([memory[i][process] for i in late])
        slope = np.polyfit(np.array([places[i] for i in late]) / 100_000, resident / MIB, 1)[0]
        grown = (resident[-1] - resident[0]) / MIB
        if most_slope_mib is None:
            assert grown < 8, f"process {process} grew by {grown:.1f} MiB"
        else:
            assert slope <= most_slope_mib, f"process {process} grows by {slope:.2f} MiB per 100,000 samples"
