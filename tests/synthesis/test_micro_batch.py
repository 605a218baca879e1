"""How many samples at once: as many as fit, found without failing, lowered where memory runs out after all."""

import logging
import weakref
from itertools import chain

import pytest
import torch

from zsdata.synthesis.micro_batch import GIB, MicroBatch, WarmUp, largest_micro_batch, measure, say_warm_up, to_device, weight_bytes

GPU = torch.device("meta")  # a device that is not the CPU and is everywhere


def limited(most, seen):
    def work(part):
        size = part.stop - part.start
        seen.append(size)
        if size > most:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return list(range(part.start, part.stop))

    return work


def joined(parts):
    return list(chain.from_iterable(parts))


def test_parts_cover_all_samples_in_order_and_are_of_one_size_or_nearly():
    batch, seen = MicroBatch("network", 3, GPU, "cure"), []
    assert joined(batch.run(limited(3, seen), 8)) == list(range(8)) and seen == [3, 3, 2]
    seen.clear()
    assert joined(batch.run(limited(3, seen), 4)) == list(range(4)) and seen == [2, 2]
    assert [batch.evenly(total) for total in (1, 3, 4, 7, 9)] == [1, 3, 2, 3, 3]
    assert batch.run(limited(3, seen), 0) == []


def test_on_the_cpu_it_is_one():
    assert MicroBatch("network", 8, torch.device("cpu"), "cure").size == 1


def test_what_does_not_fit_is_halved_for_the_rest_of_the_run_and_said_once(caplog):
    batch, seen = MicroBatch("network", 8, GPU, "cure"), []
    with caplog.at_level(logging.WARNING, "zsdata"):
        assert joined(batch.run(limited(3, seen), 15)) == list(range(15))
        assert seen == [8, 4, 2, 2, 2, 2, 2, 2, 2, 1] and (batch.size, batch.lowered) == (2, 2)
        seen.clear()
        batch.run(limited(3, seen), 4)
    assert seen == [2, 2] and len(caplog.records) == 2
    assert "with 8 samples at once; from now on it takes 4" in caplog.text and "set micro_batch=2" in caplog.text


def test_what_did_not_fit_once_is_not_chosen_again():
    batch = MicroBatch("network", 8, GPU, "cure")
    batch.run(limited(4, []), 8)
    for asked, used in ((16, 4), (2, 2), (8, 4)):
        batch.choose(asked)
        assert batch.size == used


def test_work_in_which_memory_ran_out_is_measured_once_more():
    batch, runs = MicroBatch("network", 8, GPU, "cure"), []

    def work():
        runs.append(batch.size)
        batch.run(limited(4, []), 8)

    batch.measure(work)
    assert runs == [8, 4]
    batch.measure(work)
    assert runs == [8, 4, 4]


def test_the_last_smaller_part_is_halved_by_its_own_size():
    batch = MicroBatch("network", 8, GPU, "cure")
    batch.run(limited(1, []), 3)
    assert batch.size == 1


def test_one_sample_that_does_not_fit_is_an_error_with_the_cure():
    with pytest.raises(MemoryError, match=r"not enough memory for one sample \(network\): take less") as raised:
        MicroBatch("network", 8, GPU, "take less").run(limited(0, []), 8)
    assert isinstance(raised.value.__cause__, torch.OutOfMemoryError)


@pytest.mark.parametrize("said", ["CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate`", "CUDA error: out of memory"])
def test_libraries_below_torch_say_it_otherwise(said):
    batch, tried = MicroBatch("network", 4, GPU, "cure"), []

    def work(part):
        tried.append(part.stop - part.start)
        if tried == [4]:
            raise RuntimeError(said)

    batch.run(work, 4)
    assert tried == [4, 2, 2] and batch.lowered == 1


def test_other_errors_are_not_taken_for_it():
    def work(part):
        raise RuntimeError("the size of tensor a must match the size of tensor b")

    with pytest.raises(RuntimeError, match="tensor a"):
        MicroBatch("network", 4, GPU, "cure").run(work, 4)


def test_what_failed_is_let_go_before_the_next_try():
    batch, alive = MicroBatch("network", 2, GPU, "cure"), []

    def work(part):
        if part.stop - part.start == 2:
            activations = torch.zeros(1)
            alive.append(weakref.ref(activations))
            raise torch.OutOfMemoryError("CUDA out of memory")
        assert alive[0]() is None

    batch.run(work, 2)


def test_networks_that_do_not_fit_say_what_to_lower():
    class TooLarge(torch.nn.Linear):
        def to(self, *_, **__):
            raise torch.OutOfMemoryError("CUDA out of memory")

    with pytest.raises(MemoryError, match=r"not enough memory for inpainting, whose weights take 0\.50 GiB: take less"):
        to_device([TooLarge(2**14, 2**13, bias=False, device="meta")], GPU, "inpainting", "take less")


@pytest.mark.parametrize(
    ("budget", "most", "expected"),
    [(0, 16, 1), (119, 16, 1), (239, 16, 1), (240, 16, 2), (419, 16, 2), (420, 16, 4), (10_000, 16, 16), (10_000, 6, 4)],
)
def test_the_largest_power_of_two_within_the_budget_is_found_without_exceeding_it(budget, most, expected):
    seen = []
    assert largest_micro_batch(lambda size: seen.append(size) or 20 + 100 * size, budget, most) == expected
    assert all(20 + 100 * size <= max(budget, 120) for size in seen)


def test_work_whose_need_levels_off_gets_the_largest():
    """An autoencoder that takes at most four images at once stops growing."""
    assert largest_micro_batch(lambda size: 100 * min(size, 4) + size, 1000) == 16


def test_work_that_needs_more_than_foretold_stays_where_it_fits():
    assert largest_micro_batch(lambda size: size**2, 40) == 4


def test_a_warm_up_can_be_read():
    unet = WarmUp("unet at 384x512", 8, 3 * GIB // 2, GIB, 2.34)
    assert str(unet) == "unet at 384x512: micro-batch 8, peak memory 1.50 GiB, warm after 2.3 s"
    depth = WarmUp("depth at 518x686", 8, 2 * GIB, GIB // 4, 1)
    assert say_warm_up([unet, depth], torch.device("cuda:1")).splitlines() == [
        "zsdata on cuda:1: unet at 384x512: micro-batch 8, peak memory 1.50 GiB, warm after 2.3 s",
        "zsdata on cuda:1: depth at 518x686: micro-batch 8, peak memory 2.00 GiB, warm after 1.0 s",
        "zsdata on cuda:1: the stream takes at most 3.00 GiB beside training",  # both weights, and depth's activations
    ]


def test_the_cpu_counts_no_memory():
    peak, seconds = measure(lambda: None, torch.device("cpu"))
    assert peak is None and seconds >= 0


def test_weights_are_counted_in_their_own_format():
    network = torch.nn.BatchNorm1d(10)
    assert weight_bytes(network) == 4 * 40 + 8
    assert weight_bytes(network.half(), torch.nn.Linear(3, 2, bias=False)) == 4 * 20 + 8 + 24
