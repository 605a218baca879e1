from __future__ import annotations

import json
import sys

import pytest
import torch
from accelerate.state import AcceleratorState
from safetensors.torch import save_file

import trainers.igev as igev
from tests.scenes import grey_fill, layered_depth, photo_tar
from trainers import run_folder
from trainers.models import load_trained
from trainers.models.mobilenet import TIMM_STAGES, MobileNetV2
from trainers.training_loss import TrainingLoss
from zsdata import Masks, StereoBatch, ZeroStereoStream

SMALL = "--hidden-dims 16 16 16 --corr-radius 2 --max-disp 32 --n-gru-layers 2 --slow-fast-gru".split()


@pytest.fixture(autouse=True)
def fresh_accelerator():
    yield
    AcceleratorState._reset_state(reset_partial_state=True)


@pytest.fixture
def command(tmp_path, monkeypatch):
    """Runs trainers/igev.py on small scenes with the given arguments, and returns the run's folder."""

    def open_stream(arguments):
        return ZeroStereoStream(arguments.sources, size=tuple(arguments.size), depth=layered_depth, inpaint=grey_fill)

    def run(*arguments):
        given = ["--sources", tar, "--output", tmp_path / "run", "--size", 64, 96, "--batch-size", 2, "--iterations", 2, "--workers", 0]
        monkeypatch.setattr(sys, "argv", [str(argument) for argument in ("igev.py", *given, "--tracker", "none", *SMALL, *arguments)])
        igev.main()
        return tmp_path / "run"

    tar = photo_tar(tmp_path / "photos.tar", 4)
    monkeypatch.setattr("trainers.arguments.open_stream", open_stream)
    return run


def test_the_command_trains_and_its_checkpoint_knows_its_options(command):
    folder = command("--steps", 2)
    (line,) = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    assert line["step"] == 2 and line["initial_term"] > 0
    matcher = load_trained(run_folder.newest(folder), "igev_stereo")
    statistics = dict(matcher.named_buffers())
    assert statistics["feature.bn1.num_batches_tracked"] == 0 and statistics["corr_stem.bn.num_batches_tracked"] == 2
    assert matcher.n_gru_layers == 2 and matcher.slow_fast_gru and matcher.disparities == 8


def test_the_backbone_starts_from_the_given_weights(command, tmp_path):
    timm = {}
    for name, tensor in MobileNetV2().state_dict().items():
        stage = next((i for i, prefix in enumerate(TIMM_STAGES) if name.startswith(f"{prefix}.")), None)
        timm[name if stage is None else f"blocks.{stage}{name.removeprefix(TIMM_STAGES[stage])}"] = torch.full_like(tensor, 0.5)
    save_file(timm, tmp_path / "mobilenet.safetensors")
    folder = command("--steps", 1, "--learning-rate", 1e-9, "--backbone-weights", tmp_path / "mobilenet.safetensors")
    state = load_trained(run_folder.newest(folder), "igev_stereo").state_dict()
    for name in ("feature.conv_stem.weight", "feature.block4.0.2.conv_pwl.weight", "feature.block0.0.0.bn2.running_var"):
        torch.testing.assert_close(state[name], torch.full_like(state[name], 0.5))


@pytest.mark.parametrize(("words", "limit"), [((), 192), (("--max-supervised-disparity", 700), 700)])
def test_the_limit_of_the_labels_reaches_the_loss(command, monkeypatch, words, limit):
    told = []
    monkeypatch.setattr(igev, "train_as_told", lambda arguments, matcher, loss, name, options: told.append(loss))
    command(*words)
    assert told == [TrainingLoss(max_disparity=limit)]


@pytest.mark.parametrize(("max_disparity", "supervised"), [(192, 0.5), (700, 1.0)])
def test_labels_beyond_the_limit_supervise_neither_the_initial_nor_the_updated_prediction(max_disparity, supervised):
    label = torch.full((1, 1, 8, 8), 100.0)
    label[..., 4:] = 300
    yes, no = torch.ones_like(label, dtype=torch.bool), torch.zeros_like(label, dtype=torch.bool)
    image = torch.zeros(1, 3, 8, 8)
    batch = StereoBatch(
        left=image,
        right=image,
        disparity=label,
        confidence=torch.ones_like(label),
        masks=Masks(nonocclusion=yes, inpaint=no, valid=yes),
        left_clean=image,
        right_clean=image,
        meta=[{}],
    )
    initial, update = (torch.zeros_like(label, requires_grad=True) for _ in range(2))
    loss, _ = TrainingLoss(max_disparity=max_disparity)(initial, [update], batch)
    loss.backward()
    for prediction in (initial, update):
        assert (prediction.grad != 0).float().mean() == supervised
