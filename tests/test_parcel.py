import gc
import os
import socket
from pathlib import Path

import pytest
import torch

from zsdata.parcel import Inbox, Outbox


@pytest.fixture
def boxes():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    yield Outbox(theirs, ahead=2), Inbox(ours)
    ours.close()
    theirs.close()


def everything(seed, size):
    generator = torch.Generator().manual_seed(seed)
    values = torch.rand(3, size, 5, generator=generator)
    return {
        "float": values,
        "bytes": (values * 255).to(torch.uint8),
        "bool": values > 0.5,
        "double": values.double(),
        "depth": (values * 65_535).int().to(torch.uint16),
        "odd": values.transpose(0, 2)[:, ::2],
        "scalar": torch.tensor(4.5),
        "nothing": torch.zeros(0, 3),
        "meta": [{"key": "caf\udce9", "values": [1, 2.5, None]}],
    }


def same(first, second):
    assert first.keys() == second.keys()
    return all(
        torch.equal(value, second[name]) and value.dtype == second[name].dtype if isinstance(value, torch.Tensor) else value == second[name]
        for name, value in first.items()
    )


def test_what_is_sent_arrives_whatever_the_sizes_are(boxes):
    outbox, inbox = boxes
    sent = [everything(seed, size) for seed, size in enumerate([3, 50_000, 1, 0, 120_000, 7])]  # up to 10 MB, growing and shrinking
    received = []
    for first, second in zip(sent[::2], sent[1::2], strict=True):
        outbox.send(first)
        outbox.send(second)
        assert inbox.waiting() == 2
        received += [inbox.receive(torch.Tensor.clone), inbox.receive(torch.Tensor.clone)]
    assert all(map(same, sent, received)) and inbox.waiting() == 0


def test_a_received_tensor_is_the_receivers_own(boxes):
    outbox, inbox = boxes
    outbox.send(everything(1, 4))
    first = inbox.receive(torch.Tensor.clone)
    first["float"] += 1
    for seed in (2, 3, 4, 5):
        outbox.send(everything(seed, 4))
        inbox.receive(torch.Tensor.clone)
    assert torch.equal(first["float"], everything(1, 4)["float"] + 1)
    assert first["bytes"].untyped_storage().nbytes() == first["bytes"].nbytes  # saving one field saves no other


def test_memory_is_taken_once_and_used_again(boxes):
    outbox, inbox = boxes
    gc.collect()  # of other tests
    for _ in range(3):
        outbox.send(everything(1, 100))
        inbox.receive(torch.Tensor.clone)
    files = len(os.listdir("/proc/self/fd"))
    for seed in range(100):
        outbox.send(everything(seed, 100))
        inbox.receive(torch.Tensor.clone)
    assert len(os.listdir("/proc/self/fd")) == files
    mapped = [line for line in Path("/proc/self/maps").read_text().splitlines() if "memfd:zsdata" in line]
    assert len(mapped) == 2


def test_what_cannot_be_sent_leaves_the_outbox_usable(boxes):
    outbox, inbox = boxes
    with pytest.raises(Exception, match=r"pickle|local"):
        outbox.send({"tensor": torch.ones(3), "lambda": lambda: 1})
    outbox.send(everything(1, 4))
    assert same(inbox.receive(torch.Tensor.clone), everything(1, 4))


def test_a_closed_channel_is_the_end(boxes):
    outbox, inbox = boxes
    outbox._channel.shutdown(socket.SHUT_RDWR)
    with pytest.raises(EOFError):
        inbox.receive(torch.Tensor.clone)
