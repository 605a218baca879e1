from __future__ import annotations

import json

import pytest
import torch
from accelerate import Accelerator
from accelerate.state import AcceleratorState
from torch import nn

from trainers.step_guard import EXPLOSION, FEWEST_STEPS, StepGuard, TrainingDiverged
from zsdata import Masks, StereoBatch

NORM = torch.tensor(1.0)


@pytest.fixture(autouse=True)
def fresh_accelerator():
    yield
    AcceleratorState._reset_state(reset_partial_state=True)


def batch(index: int) -> StereoBatch:
    nothing = torch.zeros(0)
    meta = {"epoch": 0, "index": index, "source": "photos", "shard": "photos.tar", "key": f"{index:06d}", "window": [0, 0, 1, 1]}
    return StereoBatch(nothing, nothing, nothing, nothing, Masks(nothing, nothing, nothing), nothing, nothing, [meta])


def take(guard: StepGuard, step: int, loss: float, norm: torch.Tensor = NORM) -> bool:
    guard.watch(torch.tensor(loss), batch(step))
    return guard.refuses(step, norm)


def test_a_loss_far_beyond_the_usual_is_an_explosion_and_a_hard_batch_is_none(tmp_path):
    guard = StepGuard(Accelerator(cpu=True), nn.Linear(1, 1), tmp_path / "skipped.jsonl")
    assert not take(guard, 0, 1e6), "at first nobody knows what is usual"
    for step in range(1, FEWEST_STEPS):
        assert not take(guard, step, 2.0)
    assert not take(guard, FEWEST_STEPS, 2.0 * EXPLOSION * 0.99)
    assert take(guard, FEWEST_STEPS + 1, 2.0 * EXPLOSION * 1.01)
    (line,) = [json.loads(line) for line in (tmp_path / "skipped.jsonl").read_text().splitlines()]
    assert line["samples"] == [{"epoch": 0, "index": 21, "source": "photos", "shard": "photos.tar", "key": "000021"}]
    assert line["reason"] == "the loss is 202, usual is 2"


def test_a_gradient_that_is_not_finite_blames_every_batch_of_the_step(tmp_path):
    guard = StepGuard(Accelerator(cpu=True), nn.Linear(1, 1), tmp_path / "skipped.jsonl")
    guard.watch(torch.tensor(1.0), batch(0))
    guard.watch(torch.tensor(1.0), batch(1))
    assert guard.refuses(0, torch.tensor(float("inf")))
    lines = [json.loads(line) for line in (tmp_path / "skipped.jsonl").read_text().splitlines()]
    assert [line["samples"][0]["index"] for line in lines] == [0, 1] and lines[0]["reason"] == "the gradient's norm is inf"


def test_only_the_batch_with_the_bad_loss_is_blamed(tmp_path):
    guard = StepGuard(Accelerator(cpu=True), nn.Linear(1, 1), tmp_path / "skipped.jsonl")
    guard.watch(torch.tensor(1.0), batch(0))
    guard.watch(torch.tensor(float("nan")), batch(1))
    assert guard.refuses(0, torch.tensor(float("nan")))
    (line,) = [json.loads(line) for line in (tmp_path / "skipped.jsonl").read_text().splitlines()]
    assert line["samples"][0]["index"] == 1


def test_eight_skipped_steps_are_an_error_if_they_are_in_a_row_across_a_resume_too(tmp_path):
    accelerator = Accelerator(cpu=True)
    guard = StepGuard(accelerator, nn.Linear(1, 1), tmp_path / "skipped.jsonl")
    for step in range(7):
        assert take(guard, step, float("nan"))
    assert not take(guard, 7, 1.0)
    for step in range(8, 15):
        assert take(guard, step, float("nan"))
    resumed = StepGuard(accelerator, nn.Linear(1, 1), tmp_path / "skipped.jsonl")
    resumed.load_state_dict(json.loads(json.dumps(guard.state_dict())))
    with pytest.raises(TrainingDiverged, match="in each of the last 8 steps"):
        take(resumed, 15, float("nan"))
    assert resumed.skipped == 15


def test_the_statistics_of_batch_norms_are_set_back(tmp_path):
    network = nn.Sequential(nn.BatchNorm1d(3), nn.BatchNorm1d(3)).train()
    network[1].eval()
    guard = StepGuard(Accelerator(cpu=True), network, tmp_path / "skipped.jsonl")
    network(torch.rand(4, 3))
    assert not take(guard, 0, 1.0)
    before = {name: value.clone() for name, value in network.named_buffers()}
    network(torch.full((4, 3), float("nan")))
    assert network[0].running_mean.isnan().all()
    assert take(guard, 1, float("nan"))
    assert all(torch.equal(value, before[name]) for name, value in network.named_buffers())


def test_what_the_gradient_scaler_can_mend_is_left_to_it(tmp_path):
    class Scaler:
        scale = 65536.0

        def get_scale(self):
            return self.scale

    accelerator = Accelerator(cpu=True)
    accelerator.scaler = Scaler()
    guard = StepGuard(accelerator, nn.Linear(1, 1), tmp_path / "skipped.jsonl")
    assert not take(guard, 0, 1.0, torch.tensor(float("inf")))
    Scaler.scale = 1.0
    assert take(guard, 1, 1.0, torch.tensor(float("inf")))
