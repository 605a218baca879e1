from __future__ import annotations

from datetime import timedelta

import pytest
import torch
import torch.distributed as distributed
import torch.multiprocessing as multiprocessing
from torch import nn

from trainers.models.rank_norm import RankBatchNorm3d

RANKS = 2
WAYS = ("eager", "compiled")
STEPS = 3


def volumes():
    """[steps, B, C, D, H, W], far from mean 0 and variance 1, and other ones in each half of the batch."""
    generator = torch.Generator().manual_seed(0)
    halves = [(5 * half + torch.randn(STEPS, 2, 3, 4, 5, 6, generator=generator) * (1 + half)) for half in range(RANKS)]
    return torch.cat(halves, dim=1)


def train(norm, batches):
    """Outputs, gradients of the inputs and of the parameters, and buffers after a few steps; the loss is a mean over the batch."""
    outputs, gradients = [], []
    for batch in batches:
        batch = batch.clone().requires_grad_()
        output = norm(batch)
        (output * output.detach().sin()).mean().backward()
        outputs.append(output.detach())
        gradients.append(batch.grad)
    return {
        "outputs": torch.stack(outputs),
        "input_gradients": torch.stack(gradients),
        "parameter_gradients": [parameter.grad for parameter in norm.parameters()],
        "buffers": dict(norm.named_buffers()),
    }


def norm_with_weights(kind):
    norm = kind(3)
    with torch.no_grad():
        norm.weight.copy_(torch.tensor([0.5, 1.0, 2.0]))
        norm.bias.copy_(torch.tensor([1.0, 0.0, -1.0]))
    return norm


def work(rank, folder):
    torch.set_num_threads(1)
    store = f"file://{folder}/store"
    distributed.init_process_group("gloo", init_method=store, rank=rank, world_size=RANKS, timeout=timedelta(seconds=60))
    for way in WAYS:
        norm = norm_with_weights(RankBatchNorm3d)
        if way == "compiled":
            norm.forward = torch.compile(norm.forward, backend="aot_eager", fullgraph=True, dynamic=False)
        found = train(norm, volumes().chunk(RANKS, dim=1)[rank])
        norm.eval()
        found["alone"] = norm(volumes()[0]) if rank == 0 else None  # if it asked the other rank, it would wait for it forever
        torch.save(found, f"{folder}/{way}-{rank}.pt")
    distributed.destroy_process_group()


@pytest.fixture(scope="module")
def found_by_ranks(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ranks")
    multiprocessing.start_processes(work, (str(folder),), nprocs=RANKS, start_method="spawn")
    return {way: [torch.load(folder / f"{way}-{rank}.pt") for rank in range(RANKS)] for way in WAYS}


@pytest.mark.parametrize("way", WAYS)
def test_two_ranks_normalise_as_one_with_the_pairs_of_both(found_by_ranks, way):
    plain = norm_with_weights(nn.BatchNorm3d)
    expected, ranks = train(plain, volumes()), found_by_ranks[way]
    torch.testing.assert_close(torch.cat([found["outputs"] for found in ranks], dim=1), expected["outputs"])
    # A mean over half the batch weighs each of its pairs twice.
    together = torch.cat([found["input_gradients"] for found in ranks], dim=1) / RANKS
    torch.testing.assert_close(together, expected["input_gradients"])
    for one, other, whole in zip(*(found["parameter_gradients"] for found in ranks), expected["parameter_gradients"], strict=True):
        torch.testing.assert_close((one + other) / RANKS, whole)
    for name, value in expected["buffers"].items():
        for found in ranks:
            torch.testing.assert_close(found["buffers"][name], value, msg=name)
    torch.testing.assert_close(ranks[0]["alone"], plain.eval()(volumes()[0]))


def test_one_rank_has_torchs_own_batch_norm():
    found, expected = (train(norm_with_weights(kind), volumes()) for kind in (RankBatchNorm3d, nn.BatchNorm3d))
    assert torch.equal(found["outputs"], expected["outputs"]) and torch.equal(found["input_gradients"], expected["input_gradients"])
    assert all(torch.equal(found["buffers"][name], value) for name, value in expected["buffers"].items())
