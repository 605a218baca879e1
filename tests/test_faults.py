import json
import logging
import multiprocessing
import os

import numpy as np
import pytest

from tests.scenes import jpeg, photo, write_tar
from tests.test_stream import open_stream
from zsdata.faults import MOST_REASONS, OTHER_REASONS, RECENT_PHOTOS, FailureBudget, FaultLog, TooManyFaults
from zsdata.rejected import RejectedFile


def reject(number, reason="truncated"):
    return ("photos", "a.tar", f"{number:06d}", reason)


def batches_until_spent(log, refused_per_batch, made_per_batch, most=2_000):
    for batch in range(most):
        try:
            log.add(made_per_batch, [reject(batch)] * refused_per_batch)
        except TooManyFaults:
            return batch + 1
    return None


def test_both_the_count_and_the_rate_must_be_exceeded():
    budget = FailureBudget(count=5, rate=0.5)
    assert batches_until_spent(FaultLog(budget), 1, 2) is None  # a third of all is within the rate
    assert batches_until_spent(FaultLog(budget), 2, 1) == 3  # 6 of 9
    assert batches_until_spent(FaultLog(FailureBudget(count=0, rate=0)), 1, 100) == 1


def test_what_is_forgiven_is_counted_and_spends_nothing():
    log = FaultLog(FailureBudget(count=0, rate=0), forgiven=["sparse truth"])
    log.add(1, [reject(0, "sparse truth: 24 %"), reject(1, "sparse truth: 3 %")])
    assert log.by_reason == {"sparse truth": 2}
    with pytest.raises(TooManyFaults, match="1 of the last 5 photos were refused"):
        log.add(1, [reject(2)])


def test_a_bucket_that_breaks_after_a_good_week_is_noticed_soon():
    fresh, old = (FaultLog(FailureBudget(count=100, rate=0.1)) for _ in range(2))
    for _ in range(10 * RECENT_PHOTOS // 8):
        old.add(8, [])
    assert batches_until_spent(fresh, 8, 8) == 13
    assert batches_until_spent(old, 8, 8) == 126  # 1,008 of the last 10,000


def test_a_rate_below_the_budget_runs_for_ever():
    log = FaultLog(FailureBudget(count=10, rate=0.1))
    assert batches_until_spent(log, 1, 12, most=20_000) is None and log.by_reason == {"truncated": 20_000}


def test_ranks_share_the_count():
    assert batches_until_spent(FaultLog(FailureBudget(count=100), ranks=4), 1, 1) == 26
    assert batches_until_spent(FaultLog(FailureBudget(count=100), ranks=4), 1, 12) is None
    assert batches_until_spent(FaultLog(FailureBudget(count=0, rate=0), ranks=4), 1, 7) == 1


def ranks_until_spent(share, ranks, seed, most=2_000):
    """Photos that all ranks together have tried when the first of them stops, each photo being bad with this chance; None: none stops."""
    generator = np.random.default_rng([seed, ranks])
    logs = [FaultLog(FailureBudget(count=100, rate=0.1), ranks) for _ in range(ranks)]
    for _ in range(most // 8):
        for log in logs:
            try:
                log.add(8, [reject(0)] * int(generator.negative_binomial(8, 1 - share)))
            except TooManyFaults:
                return sum(log.made + log.by_reason.total() for log in logs)
    return None


@pytest.mark.parametrize("ranks", [1, 8, 64])
def test_however_many_ranks_there_are_the_rate_is_that_of_all_of_them(ranks):
    """A few bad photos on one of many ranks, which is chance, are not taken for a rate; a rate is."""
    assert [ranks_until_spent(0.05, ranks, seed) for seed in range(4)] == [None] * 4
    assert all((ranks_until_spent(0.2, ranks, seed) or 10**9) < 3_000 for seed in range(4))


def test_the_error_is_a_summary():
    log = FaultLog(FailureBudget(count=3, rate=0.1), ranks=2)
    with pytest.raises(TooManyFaults) as error:
        log.add(1, [reject(1), reject(2, "not an image: HTML or XML"), *[reject(3)] * 4])
    assert str(error.value) == (
        "6 of the last 7 photos were refused, more than the failure budget allows (3 over all 2 ranks, and 10%). "
        "Refused since the start: truncated: 5, not an image: 1; the first: 000001 in a.tar: truncated; "
        "000002 in a.tar: not an image: HTML or XML; 000003 in a.tar: truncated. `zsdata verify` lists what is wrong with the shards"
    )


def test_the_log_and_the_counts_stay_short_whatever_the_reasons_are(caplog):
    log = FaultLog(FailureBudget(rate=1))
    with caplog.at_level(logging.WARNING, logger="zsdata"):
        for number in range(1_000):
            log.add(1, [reject(number, f"ends at byte {number}")] * 2)
    assert len(caplog.records) == FaultLog.LOG_LINES and len(log.examples) == FaultLog.EXAMPLES
    assert len(log.by_reason) == MOST_REASONS + 1 and log.by_reason[OTHER_REASONS] == 2 * (1_000 - MOST_REASONS)
    assert log.by_reason.total() == 2_000


def mixed_tar(path, good=6):
    photos = {f"{i}.jpg": jpeg(photo(i)) for i in range(good)}
    return write_tar(path, {**photos, "cut.jpg": jpeg(photo(9))[:2000], "page.jpg": b"<html>not found</html>" * 20, "caf\udce9.jpg": b"?"})


def lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("reuse", [1, 3])
def test_every_refusal_is_counted_and_listed_once(tmp_path, workers, reuse):
    stream = open_stream(mixed_tar(tmp_path / "mixed.tar"), reuse=reuse)
    listed = tmp_path / "rejected.jsonl"
    with stream.loader(1, num_workers=workers, rejected=listed) as loader:
        batches = list(loader)
        stats = loader.stats()
    rows = lines(listed)
    expected = [
        ({"source": source, "shard": shard, "key": key, "reason": reason, "epoch": 0, "index": meta["index"]})
        for batch in batches
        for meta in batch.meta
        if meta["index"] % reuse == 0
        for source, shard, key, reason in meta["replaced"]
    ]
    assert rows == expected and {row["key"] for row in rows} == {"cut", "page", "caf\udce9"}
    assert sum(stats["rejected"].values()) == len(rows)
    assert [tuple(row[name] for name in ("source", "shard", "key", "reason")) for row in rows][:20] == stats["examples"]


def test_the_budget_ends_a_run_at_the_same_sample_for_any_number_of_workers(tmp_path):
    tar = mixed_tar(tmp_path / "mixed.tar", good=12)
    ends = set()
    for workers in (0, 1, 2):
        stream = open_stream(tar, budget=FailureBudget(count=2, rate=0.1))
        with stream.loader(1, num_workers=workers) as loader, pytest.raises(TooManyFaults, match="photos were refused"):
            for _ in loader:
                pass
        ends.add(loader.state_dict()["samples"])
    assert len(ends) == 1


def append(path, key):
    file = RejectedFile(path)
    for index in range(500):
        file.add([{"epoch": 0, "index": index, "replaced": [("photos", "a.tar", key * 300, "truncated")]}])


def test_ranks_append_whole_lines(tmp_path):
    path = tmp_path / "rejected.jsonl"
    writers = [multiprocessing.get_context("fork").Process(target=append, args=(path, key)) for key in "abc"]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    rows = lines(path)
    assert len(rows) == 1_500
    for key in "abc":
        assert [row["index"] for row in rows if row["key"] == key * 300] == list(range(500))


def test_a_list_that_cannot_be_written_is_an_error_at_once(tmp_path):
    stream = open_stream(mixed_tar(tmp_path / "mixed.tar"))
    with pytest.raises(FileNotFoundError, match="nowhere"):
        stream.loader(1, rejected=tmp_path / "nowhere" / "rejected.jsonl")
    with pytest.raises(IsADirectoryError, match=os.path.basename(tmp_path)):
        stream.loader(1, rejected=tmp_path)


@pytest.mark.parametrize("options", [{"count": -1}, {"rate": 1.1}, {"rate": -0.1}])
def test_budgets_that_make_no_sense_are_refused(options):
    with pytest.raises(ValueError, match="a budget is"):
        FailureBudget(**options)
