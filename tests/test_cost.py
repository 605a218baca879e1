"""What safety costs, as a share of the time that a sample takes, in one run."""

import socket
import time

import pytest
import torch

from tests.scenes import photo_tar
from zsdata import ZeroStereoStream
from zsdata.activity import Activity
from zsdata.faults import FailureBudget, FaultLog
from zsdata.meter import Meter
from zsdata.parcel import Inbox, Outbox
from zsdata.prepared import stack
from zsdata.quality import QualityGate
from zsdata.rejected import RejectedFile

BATCH = 8
MOST = 0.03


def cpu_seconds(action, repetitions=5):
    """The least of a few: what it takes on a machine that does nothing else."""
    times = []
    for _ in range(repetitions):
        start = time.process_time()
        action()
        times.append(time.process_time() - start)
    return min(times)


@pytest.mark.filterwarnings("ignore::zsdata.synthesis.depth.builtin.BuiltinDepthWarning")
def test_safety_costs_less_than_three_percent_of_a_sample(tmp_path, monkeypatch):
    stream = ZeroStereoStream(photo_tar(tmp_path / "photos.tar", 8, height=480, width=640))
    worker = stream._worker
    samples = [worker.prepare(0, index) for index in range(BATCH)]
    batch = stack(samples)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    outbox, inbox = Outbox(theirs, ahead=1), Inbox(ours)
    activity, faults, gate = Activity(), FaultLog(FailureBudget()), QualityGate()
    rejected = RejectedFile(tmp_path / "rejected.jsonl")
    loader = stream.loader(BATCH)

    def make():
        worker.prepare(0, 0)

    def hand_over():
        outbox.send((batch, None))
        inbox.receive(torch.Tensor.clone)

    def keep_account():
        monkeypatch.setattr(Meter, "entered", activity.enter)
        for sample in samples:
            activity.begin(0, sample.meta["index"])
            for stage in range(10):
                with Meter().stage(f"stage {stage}"):
                    pass
            gate.refuses(
                hole_share=sample.meta["hole_share"],
                visible_share=float(sample.nonocclusion.float().mean()),
                disparity_range_px=float(sample.disparity.max() - sample.disparity.min()),
                drawn_px=sample.meta["disparity_scale"] * 640,
                flip_consistency=sample.meta["flip_consistency"],
            )
        monkeypatch.setattr(Meter, "entered", None)
        faults.add(BATCH, [])
        rejected.add(batch.meta)
        loader.state_dict()

    per_batch = BATCH * cpu_seconds(make)
    costs = {"hand over": cpu_seconds(hand_over), "keep account": cpu_seconds(keep_account)}
    activity.close()
    ours.close()
    theirs.close()
    shares = {name: seconds / per_batch for name, seconds in costs.items()}
    assert sum(shares.values()) < MOST, shares
