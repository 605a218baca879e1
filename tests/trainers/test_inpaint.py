import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import psutil
import pytest
import torch
from accelerate import Accelerator, DistributedType
from accelerate.state import AcceleratorState
from huggingface_hub.utils import filter_repo_objects
from safetensors.torch import load_file
from skimage.metrics import structural_similarity

from tests.scenes import SHARED, layered_depth, photo, photo_tar, write_tar
from tests.small_pipeline import save_small_pipeline
from tests.trainers.test_inpaint_data import pfm, png
from tests.trainers.test_training import fork_server, launch
from trainers import inpaint, inpaint_loop, run_folder
from trainers.arguments import run as run_trainer
from trainers.hole_scores import hole_cases, score_holes
from trainers.inpaint_data.layouts import StereoFolder
from trainers.inpaint_data.sources import ExampleBatch, Examples, PhotoSource, StereoSource
from trainers.inpaint_loop import TuneConfig, tune
from trainers.noise_prediction import NoisePrediction
from trainers.pairs_on_disk import StereoPair
from trainers.pipeline_folder import frozen_digest, local_pipeline
from trainers.step_guard import MOST_SKIPPED_IN_A_ROW, TrainingDiverged
from trainers.weight_average import WeightAverage, weights_of
from zsdata import AdaptiveDisparity, ZeroStereoStream, load_inpainter
from zsdata.faults import FailureBudget, FaultLog, TooManyFaults
from zsdata.source.manifest import build_manifest
from zsdata.synthesis.inpaint.diffusion_parts import load_diffusion_parts
from zsdata.synthesis.inpaint.options import DiffusionNetwork

diffusers = pytest.importorskip("diffusers")
transformers = pytest.importorskip("transformers")

ROOT = Path(__file__).resolve().parents[2]
PUBLISHED = SHARED / "published" / "tiny_inpainting"
SIZE = (64, 64)
FROZEN = ("vae/diffusion_pytorch_model.safetensors", "text_encoder/model.safetensors", "scheduler/scheduler_config.json", "README.md")


@pytest.fixture(autouse=True)
def fresh_accelerator():
    yield
    AcceleratorState._reset_state(reset_partial_state=True)


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory):
    return save_small_pipeline(tmp_path_factory.mktemp("pipeline"))


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    return photo_tar(tmp_path_factory.mktemp("photos") / "photos.tar", 6, height=72, width=96)


@pytest.fixture(scope="module")
def things(tmp_path_factory):
    """FlyingThings3D as published, with photos in place of renderings."""
    root = tmp_path_factory.mktemp("things")
    for number in range(4):
        left, right, truth = stereo_images(number)
        frame = "TRAIN/A/0000/{}/" + f"{number:04d}"
        for name, data in {
            f"frames_cleanpass/{frame.format('left')}.png": png(left),
            f"frames_cleanpass/{frame.format('right')}.png": png(right),
            f"disparity/{frame.format('left')}.pfm": pfm(truth),
        }.items():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_bytes(data)
    return root


def stereo_images(number, height=72, width=96):
    """A wall of disparity 4 and a thing of disparity 14 before it."""
    wall = photo(number, height, width + 4)
    left, right, truth = wall[:, :width].copy(), wall[:, 4:].copy(), np.full((height, width), 4, np.float32)
    thing = photo(100 + number, 30, 24)
    left[20:50, 40:64], right[20:50, 26:50], truth[20:50, 40:64] = thing, thing, 14
    return left, right, truth


def real_pair(number=0):
    left, right, truth = stereo_images(number)
    return StereoPair(f"pair {number}", left, right, truth, np.ones(truth.shape, bool), None)


def examples_of(*, photos=None, things=None, batch_size=4, seed=0, size=SIZE):
    sources = {}
    if things is not None:
        sources["things"] = StereoSource(StereoFolder("sceneflow-clean", things))
    if photos is not None:
        sources["photos"] = PhotoSource(build_manifest(photos), layered_depth, AdaptiveDisparity())
    return Examples(sources, size, seed, batch_size)


def config(**changes):
    usual = {"steps": 4, "batch_size": 4, "micro_batch": 4, "save_every": 2, "workers": 0, "mixed_precision": "no", "validation_steps": 2}
    return TuneConfig(**(usual | changes))


def run(pipeline, examples, output, settings, **options):
    AcceleratorState._reset_state(reset_partial_state=True)
    return tune(pipeline, examples, settings, output=output, arguments={}, **({"tracker": None} | options))


def weights(folder):
    return load_file(folder / "unet" / "diffusion_pytorch_model.safetensors")


def loss_of(folder, examples, first_step=1000):
    """On examples, noise and timesteps that no training here has seen."""
    parts = load_diffusion_parts(DiffusionNetwork(str(folder)))
    batch = ExampleBatch.stack([examples[first_step, index] for index in range(32)])
    with torch.no_grad():
        return NoisePrediction(parts, torch.device("cpu"), seed=0).loss(parts.unet, batch).item()


@pytest.mark.parametrize("source", ["photos", "things"])
def test_the_loss_falls_and_the_saved_folder_works_in_the_stream(pipeline, photos, things, tmp_path, source):
    examples = examples_of(**{source: {"photos": photos, "things": things}[source]}, batch_size=8)
    settings = config(steps=30, batch_size=8, micro_batch=8, learning_rate=1e-2, save_every=30)
    saved = run(pipeline, examples, tmp_path / "run", settings)
    before, after = loss_of(pipeline, examples), loss_of(saved, examples)
    assert after < 0.8 * before, (before, after)
    for name in FROZEN:
        assert (saved / name).read_bytes() == (pipeline / name).read_bytes()
    stream = ZeroStereoStream(photos, size=SIZE, depth=layered_depth, inpaint=load_inpainter(saved, steps=2))
    pair, untuned = (
        next(iter(stream)),
        next(iter(ZeroStereoStream(photos, size=SIZE, depth=layered_depth, inpaint=load_inpainter(pipeline, steps=2)))),
    )
    hole = pair.masks.inpaint.expand(3, -1, -1)
    assert hole.any() and (pair.right_clean - untuned.right_clean)[hole].abs().mean() > 1
    assert torch.equal(pair.right_clean[~hole], untuned.right_clean[~hole])


def test_the_protocol_is_the_papers():
    paper = TuneConfig()
    assert (paper.steps, paper.batch_size, paper.learning_rate) == (50_000, 32, 2e-5)


def test_the_unet_is_asked_as_the_inpainter_asks_it(pipeline, photos, things):
    """At every place where the stream's inpainter and the trainer meet: order of channels, scaling, prompt, and cells that hold a hole."""
    seen = {}

    def unet(asked, timesteps, encoder_hidden_states):
        seen.update(asked=asked, prompt=encoder_hidden_states, timesteps=timesteps)
        return type("Out", (), {"sample": torch.zeros(len(asked), 4, *asked.shape[2:])})

    examples = examples_of(photos=photos, things=things)
    batch = ExampleBatch.stack([examples[0, index] for index in range(4)])
    assert not torch.equal(batch.warped, batch.right.masked_fill(batch.inpaint_mask, 0)), "what the left view shows is not the truth"
    parts = load_diffusion_parts(DiffusionNetwork(str(pipeline)))
    prediction = NoisePrediction(parts, torch.device("cpu"), seed=0)
    loss = prediction.loss(unet, batch)
    noise, timesteps = prediction._draw(batch)
    assert torch.isclose(loss, noise.square().mean())  # L2 against the noise itself
    assert torch.equal(seen["timesteps"], timesteps) and seen["prompt"].shape == (4, 2, 16)

    inpainter = load_inpainter(pipeline, steps=2)
    masked = (batch.warped.float() / 127.5 - 1).masked_fill(batch.inpaint_mask, 0)
    with torch.no_grad():
        assert torch.allclose(seen["asked"][:, 5:], inpainter._encode(masked), atol=1e-5)
        latents = inpainter._encode(batch.right.float() / 127.5 - 1)
    cells = seen["asked"][:, 4:5].repeat_interleave(8, 2).repeat_interleave(8, 3)
    assert cells[batch.inpaint_mask].min() == 1 and 0 < cells.mean() < 1
    kept = (
        torch.cumprod(1 - torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2, 0)[timesteps].view(-1, 1, 1, 1).float()
    )
    assert torch.allclose(seen["asked"][:, :4], kept.sqrt() * latents + (1 - kept).sqrt() * noise, atol=1e-4)


def test_noise_and_timesteps_belong_to_the_example(pipeline, photos):
    examples = examples_of(photos=photos)
    prediction = NoisePrediction(load_diffusion_parts(DiffusionNetwork(str(pipeline))), torch.device("cpu"), seed=0)
    noise, timesteps = prediction._draw(ExampleBatch.stack([examples[s, i] for s in range(10) for i in range(4)]))
    alone = prediction._draw(examples[2, 3])
    assert torch.equal(alone[0][0], noise[11]) and alone[1][0] == timesteps[11]
    prediction._seed = 1
    other_noise, other_timesteps = prediction._draw(examples[2, 3])
    assert not torch.equal(other_noise[0], noise[11]) and other_timesteps[0] != timesteps[11], "the seed changes nothing"
    assert len({row.sum().item() for row in noise}) == 40 and len(set(timesteps.tolist())) > 30
    assert 0 <= timesteps.min() < 200 and 800 < timesteps.max() < 1000 and abs(noise.std() - 1) < 0.05


@pytest.mark.parametrize(("workers", "micro_batch", "ema"), [(0, 4, None), (2, 2, 0.9)])
def test_a_resumed_run_equals_the_unbroken_one(pipeline, photos, things, tmp_path, monkeypatch, workers, micro_batch, ema):
    examples = examples_of(photos=photos, things=things)
    settings = config(steps=5, workers=workers, micro_batch=micro_batch, ema=ema, learning_rate=1e-3)
    unbroken = run(pipeline, examples, tmp_path / "unbroken", settings)
    asked = NoisePrediction.loss

    def fails_in_step_three(self, model, batch):
        if batch.requests[-1] == (3, 3):
            raise RuntimeError("power cut")
        return asked(self, model, batch)

    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="power cut"):
        patch.setattr(NoisePrediction, "loss", fails_in_step_three)
        run(pipeline, examples, tmp_path / "broken", settings)
    assert run_folder.newest(tmp_path / "broken").name == "step-00000002"
    resumed = run(pipeline, examples_of(photos=photos, things=things), tmp_path / "broken", settings, resume=tmp_path / "broken")
    assert resumed.parent.name == "step-00000005"
    before, expected, found = weights(pipeline), weights(unbroken), weights(resumed)
    assert any(not torch.equal(before[name], expected[name]) for name in expected)
    for name, weight in expected.items():
        assert torch.equal(found[name], weight), name


def test_a_run_that_is_asked_to_end_saves_the_step_it_is_at(pipeline, photos, tmp_path, monkeypatch, capsys):
    settings, asked = config(steps=5, workers=1, save_every=100), NoisePrediction.loss
    unbroken = run(pipeline, examples_of(photos=photos), tmp_path / "unbroken", settings)

    def ended_in_step_three(self, model, batch):
        if batch.requests[0] == (2, 0):
            for process in (psutil.Process(), *psutil.Process().children()):
                process.terminate()
        return asked(self, model, batch)

    with monkeypatch.context() as patch, pytest.raises(SystemExit) as end:
        patch.setattr(NoisePrediction, "loss", ended_in_step_three)
        run(pipeline, examples_of(photos=photos), tmp_path / "ended", settings, resume=tmp_path / "ended")
    assert end.value.code == 143
    assert f"step-00000003 is saved, and --resume {tmp_path / 'ended'} goes on from it" in capsys.readouterr().out
    resumed = run(pipeline, examples_of(photos=photos), tmp_path / "ended", settings, resume=tmp_path / "ended")
    expected, found = weights(unbroken), weights(resumed)
    assert all(torch.equal(found[name], weight) for name, weight in expected.items())


def test_workers_are_forked_by_the_trainer_itself(pipeline, photos, tmp_path, monkeypatch):
    asked = NoisePrediction.loss

    def loss(self, model, batch):
        workers = psutil.Process().children(recursive=True)
        assert len(workers) >= 2 and set(workers) == set(psutil.Process().children())
        return asked(self, model, batch)

    monkeypatch.setattr(NoisePrediction, "loss", loss)
    with fork_server():
        run(pipeline, examples_of(photos=photos), tmp_path, config(steps=1, workers=2))


def test_another_run_keeps_its_checkpoints_and_no_photo_is_read(pipeline, photos, tmp_path, monkeypatch):
    saved = run(pipeline, examples_of(photos=photos), tmp_path, config())
    before = {path.name for path in saved.parent.parent.iterdir()}
    with pytest.raises(FileExistsError, match=r"holds the checkpoints of an earlier run, up to step 4: --resume .* another --output"):
        run(pipeline, examples_of(photos=photos), tmp_path, config(steps=1))
    assert {path.name for path in saved.parent.parent.iterdir()} == before
    monkeypatch.setattr(sys, "argv", ["inpaint.py", *map(str, arguments_for(pipeline, tmp_path, "--photos", "nowhere.tar"))])
    with pytest.raises(SystemExit, match="checkpoints of an earlier run"):
        run_trainer(inpaint.main)


def test_what_is_refused_is_counted_by_reason_over_ranks_and_resumes(pipeline, things, tmp_path, capsys, monkeypatch):
    broken = shutil.copytree(things, tmp_path / "things")
    (broken / "frames_cleanpass" / "TRAIN" / "A" / "0000" / "right" / "0002.png").unlink()
    run(pipeline, examples_of(things=broken), tmp_path / "run", config(steps=4, save_every=2, workers=1))  # each pair comes once in a step
    assert "refused, and replaced by others: no file: 4" in capsys.readouterr().out
    (line,) = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert line["step"] == 4 and line["refused"] == {"no file": 4}
    half = tmp_path / "run" / "checkpoints" / "step-00000002"
    assert json.loads((half / "state.json").read_text())["refused"] == {"no file": 2}
    logs = []
    monkeypatch.setattr(inpaint_loop, "FaultLog", lambda budget, ranks, **more: logs.append(ranks) or FaultLog(budget, ranks, **more))
    saved = run(pipeline, examples_of(things=broken), tmp_path / "resumed", config(steps=4), resume=half)
    assert json.loads((saved.parent / "state.json").read_text())["refused"] == {"no file": 4} and logs == [1]


def test_pairs_of_sparse_truth_are_replaced_and_counted_and_stop_no_run(pipeline, things, tmp_path, monkeypatch, capsys):
    """As outdoor scenes of Falling Things have it; a missing file is another matter."""
    sparse, broken = (shutil.copytree(things, tmp_path / name) for name in ("sparse", "broken"))
    for number in (1, 2):
        truth = np.full((72, 96), np.inf, np.float32)
        truth[:20] = 4
        (sparse / "disparity" / "TRAIN" / "A" / "0000" / "left" / f"{number:04d}.pfm").write_bytes(pfm(truth))
        (broken / "frames_cleanpass" / "TRAIN" / "A" / "0000" / "right" / f"{number:04d}.png").unlink()
    monkeypatch.setattr(inpaint_loop, "FailureBudget", lambda: FailureBudget(count=0, rate=0.1))
    run(pipeline, examples_of(things=sparse), tmp_path / "run", config(steps=2, save_every=2))
    assert "refused, and replaced by others: sparse truth: " in capsys.readouterr().out
    with pytest.raises(TooManyFaults, match="no file"):
        run(pipeline, examples_of(things=broken), tmp_path / "stopped", config(steps=2, save_every=2))


def test_faults_in_the_tars_of_photos_are_told(photos, tmp_path, caplog):
    cut = tmp_path / "cut.tar"
    cut.write_bytes(Path(photos).read_bytes()[:-20_000])
    examples_of(photos=cut)
    assert "1 faults in the tars of photos, the first:" in caplog.text


def test_a_matchers_checkpoint_is_not_resumed(pipeline, photos, tmp_path):
    run_folder.save(tmp_path / "raft", 1, torch.nn.Linear(1, 1), {}, {}, {"options": {"model": "raft_stereo"}})
    with pytest.raises(ValueError, match=r"step-00000001 is of a run that trains raft_stereo; this one trains an inpainting U-Net"):
        run(pipeline, examples_of(photos=photos), tmp_path / "run", config(), resume=tmp_path / "raft")


def test_a_smaller_micro_batch_and_gradient_checkpointing_change_nothing_but_rounding(pipeline, photos, tmp_path):
    examples = examples_of(photos=photos)
    whole = weights(run(pipeline, examples, tmp_path / "whole", config(steps=2, learning_rate=1e-3)))
    changed = config(steps=2, learning_rate=1e-3, micro_batch=1, gradient_checkpointing=True)
    split = weights(run(pipeline, examples, tmp_path / "split", changed))
    for name, weight in whole.items():
        assert torch.allclose(split[name], weight, atol=2e-4), name  # a fifth of what Adam moves a weight by in one step


def test_a_run_of_another_seed_data_or_length_is_not_resumed(pipeline, photos, things, tmp_path):
    run(pipeline, examples_of(photos=photos), tmp_path, config(steps=4))
    shutil.rmtree(tmp_path / "checkpoints" / "step-00000004")
    cases = [
        ("state's seed", examples_of(photos=photos, seed=1), config(seed=1)),
        ("state's manifest", examples_of(photos=photos, things=things), config()),
        ("state's configuration", examples_of(photos=photos, batch_size=2), config(batch_size=2, micro_batch=2)),
        ("with steps 4, this one has 6; .* --pipeline .*step-00000002/pipeline", examples_of(photos=photos), config(steps=6)),
    ]
    for message, examples, settings in cases:
        with pytest.raises(ValueError, match=message):
            run(pipeline, examples, tmp_path, settings, resume=tmp_path)


def test_what_a_run_cannot_change_on_its_way_is_refused_on_resume(pipeline, photos, tmp_path):
    examples = examples_of(photos=photos)
    run(pipeline, examples, tmp_path / "run", config(steps=2, ema=0.5, save_every=1))
    first = tmp_path / "run" / "checkpoints" / "step-00000001"
    for change, message in {"learning_rate": 1e-3, "ema": 0.9}.items():
        with pytest.raises(ValueError, match=rf"with {change} .*, this one has {message}"):
            run(pipeline, examples, tmp_path / "new", config(steps=2, **({"ema": 0.5} | {change: message})), resume=first)
    with pytest.raises(ValueError, match=r"with ema 0.5, this one has None"):
        run(pipeline, examples, tmp_path / "new", config(steps=2), resume=first)
    other = shutil.copytree(pipeline, tmp_path / "other")
    weights = other / "vae" / "diffusion_pytorch_model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1] + b"\0")
    with pytest.raises(ValueError, match=r"with the pipeline's digest \w+, this one has \w+"):
        run(other, examples, tmp_path / "new", config(steps=2, ema=0.5), resume=first)
    run(first / "pipeline", examples, tmp_path / "new", config(steps=2, ema=0.5), resume=first)  # the same frozen parts
    with pytest.raises(ValueError, match="has all of the 2 steps already"):
        run(pipeline, examples, tmp_path / "run", config(steps=2, ema=0.5), resume=tmp_path / "run")


def test_the_digest_of_a_pipeline_is_that_of_all_that_is_not_tuned(pipeline, tmp_path):
    files = ("vae/config.json", "text_encoder/model.safetensors", "tokenizer/merges.txt", "scheduler/scheduler_config.json")
    digests = {frozen_digest(pipeline)}
    for number, file in enumerate((*files, "unet/config.json", "README.md")):
        changed = shutil.copytree(pipeline, tmp_path / str(number))
        (changed / file).write_bytes((changed / file).read_bytes()[:-1] + b" ")
        digests.add(frozen_digest(changed))
    assert len(digests) == 1 + len(files)


def test_the_average_is_saved_and_the_training_goes_on_with_the_weights_themselves(pipeline, photos, tmp_path, monkeypatch):
    steps, update = [], WeightAverage.update
    monkeypatch.setattr(WeightAverage, "update", lambda average, unet, step: steps.append(step) or update(average, unet, step))
    saved = run(pipeline, examples_of(photos=photos), tmp_path / "run", config(steps=2, ema=0.5, learning_rate=1e-3))
    training, _ = run_folder.load(saved.parent)
    mean, own, first = weights(saved), training["weights"], weights(pipeline)
    assert steps == [1, 2]  # the average warms up with them
    name = "conv_in.weight"
    assert not torch.equal(mean[name], own[name]) and not torch.equal(mean[name], first[name])
    network = torch.nn.Linear(1, 1)
    average = WeightAverage(network, 0.9)
    begin = network.weight.detach().clone()
    with torch.no_grad():
        network.weight += 1
    average.update(network, step=1)
    assert torch.allclose(average.weights[0], begin + 1 - 2 / 11)  # warming up
    average.update(network, step=10_000)
    assert torch.allclose(average.weights[0], begin + 1 - 0.9 * 2 / 11)


def test_the_average_stands_in_for_the_weights_and_goes_again():
    network = torch.nn.Linear(3, 2)
    average = WeightAverage(network, 0.9)
    begin = network.weight.detach().clone()
    with torch.no_grad():
        network.weight += 1
    with weights_of(average, network) as own:
        assert torch.equal(network.weight, begin) and torch.equal(own["weight"], begin + 1)
    assert torch.equal(network.weight, begin + 1)


def test_the_weights_wait_on_the_cpu_while_the_average_stands_in_for_them():
    """The meta device stands for a GPU here: a copy on it is made without a word, one to the CPU cannot be."""
    network = torch.nn.Linear(3, 2, device="meta")
    with pytest.raises(NotImplementedError, match="Cannot copy out of meta tensor"):
        with weights_of(WeightAverage(network, 0.9), network):
            pass


def test_real_pairs_are_judged_before_and_at_every_checkpoint(pipeline, photos, tmp_path, capsys, monkeypatch):
    pairs = [real_pair(0), real_pair(1)]
    sparse = real_pair(2)._replace(name="sparse", valid=np.arange(96) % 2 == np.zeros((72, 1)))
    sizes = []
    monkeypatch.setattr(
        inpaint_loop, "load_inpainter", lambda *a, **options: sizes.append(options["micro_batch"]) or load_inpainter(*a, **options)
    )
    run(pipeline, examples_of(photos=photos), tmp_path, config(steps=4), pairs=[*pairs, sparse])
    assert sizes == [1, 1, 1]  # no memory is measured for more: cases are judged one by one
    rows = [json.loads(line) for line in (tmp_path / "validation.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [0, 2, 4]
    for row in rows:
        assert [score["name"] for score in row["pairs"]] == ["pair 0", "pair 1"]
        assert row["mean"]["psnr"] == pytest.approx(np.mean([score["psnr"] for score in row["pairs"]]))
    assert rows[0]["mean"]["psnr"] != rows[1]["mean"]["psnr"]
    printed = capsys.readouterr().out
    assert "not judged, for want of dense ground truth or of holes: sparse" in printed and "step 4: holes of 2 pairs, PSNR" in printed
    logged = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert logged[-1]["step"] == 4 and {"loss", "learning_rate", "examples_per_second", "wait_share"} < logged[-1].keys()


def step_of(folder):
    return json.loads((folder / "state.json").read_text())["step"]


def judged_as(monkeypatch, psnr, cut_at=None):
    """The pipelines of steps 0, 1, ... are as good as `psnr` says. The power is cut while that of step `cut_at` is judged."""

    def score_holes(folder, case, number, seed):
        step = step_of(folder.parent) if folder.name == inpaint_loop.PIPELINE else 0
        if step == cut_at:
            raise RuntimeError("power cut")
        return {"name": case.name, "pixels": 1, "psnr": float(psnr[step]), "ssim": 0.5}

    monkeypatch.setattr(inpaint_loop, "load_inpainter", lambda folder, *arguments, **options: folder)
    monkeypatch.setattr(inpaint_loop, "score_holes", score_holes)


def best_of(output):
    """What the last checkpoint says of the best one."""
    return json.loads((run_folder.newest(output) / "state.json").read_text())["best"]


def test_the_best_checkpoint_outlives_those_that_are_removed(pipeline, photos, tmp_path, monkeypatch, capsys):
    judged_as(monkeypatch, [30, 12, 15, 14, 15, 13, 11])
    saved = run(pipeline, examples_of(photos=photos), tmp_path, config(steps=6, save_every=1), pairs=[real_pair()])
    assert [path.name[-1] for path in sorted(saved.parent.parent.iterdir())] == ["4", "5", "6"]
    assert step_of(tmp_path / "best") == 2, "the first of equals, and never the pipeline that the run began with"
    assert best_of(tmp_path) == {"step": 2, "psnr": 15.0, "by": {"pairs": ["pair 0"], "validation_steps": 2}}
    assert not all(torch.equal(weight, weights(saved)[name]) for name, weight in weights(tmp_path / "best" / "pipeline").items())
    assert load_inpainter(tmp_path / "best" / "pipeline", steps=1).steps == 1
    printed = capsys.readouterr().out
    assert "step 2: holes of 1 pairs, PSNR 15.00 dB, SSIM 0.500, the best so far" in printed and printed.count("the best so far") == 2
    assert f"the best pipeline is {tmp_path / 'best' / 'pipeline'}, of step 2: PSNR 15.00 dB" in printed


def test_without_pairs_to_judge_by_nothing_is_called_the_best(pipeline, photos, tmp_path, capsys):
    run(pipeline, examples_of(photos=photos), tmp_path, config(steps=1))
    assert not (tmp_path / "best").exists() and best_of(tmp_path) is None and "best" not in capsys.readouterr().out


@pytest.mark.parametrize("output", ["broken", "elsewhere"])
@pytest.mark.parametrize(("cut_at", "copying"), [(2, False), (3, False), (None, True)])
def test_a_resumed_run_knows_the_best(pipeline, photos, tmp_path, monkeypatch, output, cut_at, copying):
    """Also one that ended before its best checkpoint was judged, or before it was copied."""
    examples, settings, options = examples_of(photos=photos), config(steps=5, save_every=1), {"pairs": [real_pair()]}
    keep_best = run_folder.keep_best

    def keep_the_first(checkpoint, output):
        if copying and step_of(checkpoint) == 2:
            raise RuntimeError("power cut")
        return keep_best(checkpoint, output)

    psnr = [9, 12, 15, 14, 13, 14]
    judged_as(monkeypatch, psnr, cut_at)
    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="power cut"):
        patch.setattr(run_folder, "keep_best", keep_the_first)
        run(pipeline, examples, tmp_path / "broken", settings, **options)
    judged_as(monkeypatch, psnr)
    run(pipeline, examples, tmp_path / output, settings, resume=tmp_path / "broken", **options)
    assert step_of(tmp_path / output / "best") == best_of(tmp_path / output)["step"] == 2


@pytest.mark.parametrize("step", [2, 4])
def test_a_run_that_is_asked_to_end_while_a_checkpoint_is_judged_ends_at_once_and_judges_it_when_resumed(
    pipeline, photos, tmp_path, monkeypatch, capsys, step
):
    """The last one, too."""
    examples, settings, options = examples_of(photos=photos), config(steps=4), {"pairs": [real_pair(0), real_pair(1)]}
    judged_as(monkeypatch, [9, 9, 11, 10, 12])
    judged, score = [], inpaint_loop.score_holes

    def ended(folder, case, number, seed):
        judged.append(step_of(folder.parent) if folder.name == inpaint_loop.PIPELINE else 0)
        if judged[-1] == step:
            psutil.Process().terminate()
        return score(folder, case, number, seed)

    with monkeypatch.context() as patch, pytest.raises(SystemExit) as end:
        patch.setattr(inpaint_loop, "score_holes", ended)
        run(pipeline, examples, tmp_path, settings, resume=tmp_path, **options)
    assert end.value.code == 143 and judged.count(step) == 1
    assert f"step-0000000{step} is saved, and --resume {tmp_path} goes on from it" in capsys.readouterr().out
    run(pipeline, examples, tmp_path, settings, resume=tmp_path, **options)
    assert [json.loads(line)["step"] for line in (tmp_path / "validation.jsonl").read_text().splitlines()] == [0, 2, 4]
    assert step_of(tmp_path / "best") == 4
    with pytest.raises(ValueError, match="has all of the 4 steps already"):
        run(pipeline, examples, tmp_path / "another", settings, resume=tmp_path, **options)


def test_a_best_that_is_lost_or_was_told_by_other_pairs_is_forgotten(pipeline, photos, tmp_path, monkeypatch):
    examples, settings = examples_of(photos=photos), config(steps=4, save_every=1)
    judged_as(monkeypatch, [9, 15, 12, 10, 10], cut_at=4)
    with pytest.raises(RuntimeError, match="power cut"):
        run(pipeline, examples, tmp_path / "run", settings, pairs=[real_pair()])
    (half,) = (tmp_path / "run" / "checkpoints").glob("step-*3")
    assert step_of(tmp_path / "run" / "best") == 1
    judged_as(monkeypatch, [9, 15, 12, 11, 10])
    for name, others in {"other pairs": {"pairs": [real_pair(1)._replace(name="other")]}, "kept": {}}.items():
        run(pipeline, examples, tmp_path / name, settings, resume=half, **others)
    assert step_of(tmp_path / "other pairs" / "best") == best_of(tmp_path / "other pairs")["step"] == 3
    assert step_of(tmp_path / "kept" / "best") == best_of(tmp_path / "kept")["step"] == 1, "a run that judges nothing passes it on"
    shutil.move(tmp_path / "run" / "best", half.with_name("step-00000001"))
    run(pipeline, examples, tmp_path / "found", settings, resume=half, pairs=[real_pair()])
    assert step_of(tmp_path / "found" / "best") == 1, "it still lies among the checkpoints"
    shutil.rmtree(half.with_name("step-00000001"))
    run(pipeline, examples, tmp_path / "lost", settings, resume=half, pairs=[real_pair()])
    assert step_of(tmp_path / "lost" / "best") == best_of(tmp_path / "lost")["step"] == 3


def test_hole_scores_are_psnr_and_ssim_over_the_holes():
    pair = real_pair()
    (case,), left_out = hole_cases([pair], (72, 96))
    assert not left_out and torch.equal(case.truth[0].permute(1, 2, 0), torch.from_numpy(pair.right).float())
    hole = case.inpaint_mask[0, 0].numpy()
    assert np.array_equal(hole[30], [*[False] * 51, *[True] * 10, *[False] * 31, *[True] * 4]) and np.array_equal(
        case.scored[0, 0].numpy(), hole
    )

    def ten_too_bright(right, inpaint_mask, generators):
        return torch.where(inpaint_mask, case.truth + 10, right)

    score = score_holes(ten_too_bright, case._replace(truth=case.truth.clamp(0, 245)), 0)
    assert score["pixels"] == hole.sum() and score["name"] == "pair 0"
    made = np.where(hole[..., None], pair.right.astype(float).clip(0, 255) + 10, pair.right.clip(0, 245)).clip(0, 255)
    truth = pair.right.clip(0, 245).astype(float)
    assert score["psnr"] == pytest.approx(10 * np.log10(255**2 / ((made - truth)[hole] ** 2).mean()), abs=1e-3)
    similarity = structural_similarity(truth, made, channel_axis=-1, data_range=255, full=True, win_size=7, use_sample_covariance=False)[1]
    inner = hole.copy()
    assert score["ssim"] == pytest.approx(np.asarray(similarity)[inner].mean(), abs=0.02)  # the frame's edge is padded otherwise


@pytest.mark.parametrize("unknown", [slice(64, 65), slice(65, 70)])  # what lands at the left end of the hole, at its right end
def test_holes_beside_unknown_disparities_are_not_scored(unknown):
    pair = real_pair()
    valid = pair.valid.copy()
    valid[25, unknown] = False
    disparity = np.where(valid, pair.disparity, 0)
    (case,), _ = hole_cases([pair._replace(valid=valid, disparity=disparity)], (72, 96))
    scored = case.scored[0, 0].numpy()
    assert case.inpaint_mask[0, 0, 25, 51:61].all() and not scored[25, 51:61].any()
    assert scored[26, 51:61].all() and scored[25, 92:].all()


def test_large_pairs_are_cut_in_the_middle_after_the_warp():
    (whole,), _ = hole_cases([real_pair()], (200, 200))
    (part,), _ = hole_cases([real_pair()], (40, 50))
    for name in ("truth", "warped", "inpaint_mask", "scored"):
        assert torch.equal(getattr(part, name), getattr(whole, name)[..., 16:56, 23:73])


@pytest.mark.skipif(not PUBLISHED.is_dir(), reason="the published pipeline is not here")
@pytest.mark.skipif(int(__import__("transformers").__version__.split(".")[0]) < 5, reason="its text encoder was saved by transformers 5")
def test_a_pipeline_in_the_layout_of_the_papers_model_is_tuned(photos, tmp_path):
    saved = run(PUBLISHED, examples_of(photos=photos), tmp_path, config(steps=1, batch_size=1, micro_batch=1))
    assert json.loads((saved / "model_index.json").read_text())["_class_name"] == "StereoGen"
    assert load_inpainter(saved, steps=1).steps == 1


def test_a_pipeline_that_predicts_no_noise_is_refused(photos, tmp_path):
    velocity = save_small_pipeline(tmp_path / "velocity", prediction_type="v_prediction")
    with pytest.raises(ValueError, match="predicts v_prediction; this trainer teaches those that predict noise"):
        run(velocity, examples_of(photos=photos), tmp_path / "run", config())


def test_a_rank_with_other_photos_is_named_before_the_first_step(pipeline, photos, tmp_path, monkeypatch):
    others = examples_of(photos=photo_tar(tmp_path / "photos.tar", 3)).position(0).to_state()
    monkeypatch.setattr(inpaint_loop, "gather_object", lambda states: [*states, others])  # two ranks, as one of them sees it
    with pytest.raises(ValueError, match="rank 1 differs from rank 0: its manifest is"):
        run(pipeline, examples_of(photos=photos), tmp_path / "run", config())


def test_a_step_whose_loss_is_not_finite_changes_nothing_and_its_examples_are_written_down(pipeline, photos, tmp_path, monkeypatch):
    asked = NoisePrediction.loss

    def nan_in_step_two(self, model, batch):
        return asked(self, model, batch) * (float("nan") if batch.requests[-1][0] == 2 else 1)

    monkeypatch.setattr(NoisePrediction, "loss", nan_in_step_two)
    examples, settings = examples_of(photos=photos), config(steps=4, save_every=1, ema=0.5, micro_batch=2)
    saved = run(pipeline, examples, tmp_path / "run", settings)
    own = [run_folder.load(saved.parent.with_name(f"step-0000000{step}"))[0]["weights"] for step in (2, 3, 4)]
    assert all(torch.equal(own[0][name], weight) for name, weight in own[1].items())
    assert any(not torch.equal(own[1][name], weight) for name, weight in own[2].items())
    lines = [json.loads(line) for line in (tmp_path / "run" / "skipped.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [2, 2] and all(line["reason"].startswith("the loss is nan") for line in lines)
    listed = [(sample["epoch"], sample["index"]) for line in lines for sample in line["samples"]]
    assert listed == [examples.place(2, index) for index in range(4)] and lines[0]["samples"][0]["shard"] == str(photos)
    resumed = run(pipeline, examples, tmp_path / "again", settings, resume=saved.parent.with_name("step-00000003"))
    assert json.loads((tmp_path / "again" / "log.jsonl").read_text())["skipped_steps"] == 1
    assert all(torch.equal(weights(resumed)[name], weight) for name, weight in weights(saved).items())


def test_a_loss_that_stays_not_finite_is_an_error(pipeline, photos, tmp_path, monkeypatch):
    monkeypatch.setattr(NoisePrediction, "loss", lambda self, model, batch: model.conv_in.weight.sum() * float("nan"))
    with pytest.raises(
        TrainingDiverged, match=rf"the loss is nan at step {MOST_SKIPPED_IN_A_ROW - 1}, .*skipped.jsonl lists .*Lower the learning"
    ):
        run(pipeline, examples_of(photos=photos), tmp_path, config(steps=20))


def test_a_tracker_that_is_not_installed_is_an_error_and_so_is_a_network_in_shards(pipeline, photos, tmp_path, monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(ImportError, match="tracker wandb is not installed: pip install wandb"):
        patch.setattr("accelerate.tracking.get_available_trackers", lambda: [])
        run(pipeline, examples_of(photos=photos), tmp_path, config(steps=1), tracker="wandb")
    monkeypatch.setattr(Accelerator, "distributed_type", property(lambda accelerator: DistributedType.DEEPSPEED))
    with pytest.raises(ValueError, match="was told to use DEEPSPEED; these trainers keep the whole network"):
        run(pipeline, examples_of(photos=photos), tmp_path, config(steps=1))


@pytest.mark.filterwarnings("ignore:The built-in depth")
def test_a_device_that_is_too_small_is_one_line_that_says_what_to_lower(pipeline, photos, tmp_path, monkeypatch):
    def full(self, model, batch):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.\nmore lines")

    monkeypatch.setattr(NoisePrediction, "loss", full)
    data = ["--photos", photos, "--depth", "builtin", "--tracker", "none"]
    monkeypatch.setattr(sys, "argv", ["inpaint.py", *map(str, arguments_for(pipeline, tmp_path / "run", *data))])
    with pytest.raises(
        SystemExit, match=r"^inpaint.py: .* lower --micro-batch, add --gradient-checkpointing .*--size\. CUDA out of .* GiB\.$"
    ):
        run_trainer(inpaint.main)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": 0}, "steps is 1 or more; got 0"),
        ({"learning_rate": 0.0}, "learning_rate is above 0"),
        ({"workers": -1}, "workers is 0 or more"),
        ({"seed": -1}, "seed is 0 or more; got -1"),
        ({"ema": 1.0}, r"decay in \(0, 1\)"),
    ],
)
def test_bad_options_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        config(**change)


def test_the_batch_must_split_into_micro_batches(pipeline, photos, tmp_path):
    assert config(batch_size=32, micro_batch=4).accumulate(2) == 4
    with pytest.raises(ValueError, match="batch_size 4 is no multiple of micro_batch 3 times 1 ranks"):
        run(pipeline, examples_of(photos=photos), tmp_path, config(micro_batch=3))
    for size in ((60, 64), (0, 0), (-8, -8)):
        with pytest.raises(ValueError, match=rf"multiples of 8 px .*, 8 or more; got {re.escape(str(size))}"):
            run(pipeline, examples_of(photos=photos, size=size), tmp_path, config())


def test_a_pipeline_is_found_in_the_hubs_cache_without_network(pipeline, tmp_path):
    repository = tmp_path / "hub" / "models--somebody--pipelines"
    shutil.copytree(pipeline, repository / "snapshots" / ("0" * 40) / "StereoGen")
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text("0" * 40)
    program = (
        "from trainers.pipeline_folder import local_pipeline\n"
        'folder = local_pipeline("somebody/pipelines", "StereoGen")\n'
        'assert (folder / "StereoGen" / "unet" / "config.json").is_file(), folder\n'
    )
    offline = {**os.environ, "HF_HOME": str(tmp_path), "HF_HUB_CACHE": str(tmp_path / "hub"), "HF_HUB_OFFLINE": "1"}
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, env=offline, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    with pytest.raises(FileNotFoundError, match="neither a folder nor a Hub id"):
        local_pipeline("no/such/folder")
    with pytest.raises(FileNotFoundError, match=r'no folder "StereoJen" in'):
        local_pipeline(str(repository), "StereoJen")


def test_what_is_downloaded_is_what_is_needed(monkeypatch, tmp_path):
    """The card and the licence of the repository's root too, but no safety checker of a gigabyte, nor a piece of it."""
    files = ["README.md", "LICENSE.txt", "model_index.json", "unet/config.json", "img/teaser.json"]
    inner = ["README.md", "model_index.json", "feature_extractor/preprocessor_config.json", "safety_checker/config.json"]
    inner += ["safety_checker/model.safetensors", "image_encoder/config.json"]
    for part in ("unet", "vae", "text_encoder"):
        inner += [f"{part}/config.json", f"{part}/model.safetensors", f"{part}/model.fp16.safetensors", f"{part}/model.bin"]
    asked = {}

    def snapshot_download(name, revision, allow_patterns, ignore_patterns):
        every = [*files, *(f"StereoGen/{file}" for file in inner)]
        asked["files"] = list(filter_repo_objects(every, allow_patterns=allow_patterns, ignore_patterns=ignore_patterns))
        return tmp_path

    monkeypatch.setattr("huggingface_hub.snapshot_download", snapshot_download)
    local_pipeline("somebody/pipelines", "StereoGen")
    weighted = [f"StereoGen/{part}/{file}" for part in ("unet", "vae", "text_encoder") for file in ("config.json", "model.safetensors")]
    about = ["StereoGen/README.md", "StereoGen/model_index.json", "StereoGen/feature_extractor/preprocessor_config.json"]
    assert sorted(asked["files"]) == sorted(["README.md", "LICENSE.txt", *about, *weighted])


@pytest.mark.parametrize("safety_checker", ["whole", "without weights"])
def test_diffusers_itself_loads_what_is_written(pipeline, photos, tmp_path, safety_checker):
    """Whatever parts the index names: those that are there come along, the others are given up."""
    from diffusers.pipelines.stable_diffusion.safety_checker import StableDiffusionSafetyChecker

    source = shutil.copytree(pipeline, tmp_path / "source")
    unet = source / "unet" / "config.json"
    unet.write_text(json.dumps(json.loads(unet.read_text()) | {"sample_size": 64}))
    extractor, checker = source / "feature_extractor", source / "safety_checker"
    transformers.CLIPImageProcessor().save_pretrained(extractor)
    vision = {"hidden_size": 8, "intermediate_size": 8, "num_hidden_layers": 1, "num_attention_heads": 1}
    settings = transformers.CLIPConfig(projection_dim=8, vision_config=vision, text_config=vision | {"vocab_size": 4})
    StableDiffusionSafetyChecker(settings).save_pretrained(checker)
    if safety_checker == "without weights":
        (checker / "model.safetensors").rename(checker / "pytorch_model.bin")
    parts = {
        "feature_extractor": ["transformers", "CLIPImageProcessor"],
        "safety_checker": ["stable_diffusion", "StableDiffusionSafetyChecker"],
        "image_encoder": [None, None],
        "scheduler": ["diffusers", "PNDMScheduler"],
        "text_encoder": ["transformers", "CLIPTextModel"],
        "tokenizer": ["transformers", "CLIPTokenizer"],
        "unet": ["diffusers", "UNet2DConditionModel"],
        "vae": ["diffusers", "AutoencoderKL"],
    }
    index = {"_class_name": "StableDiffusionInpaintPipeline", "_diffusers_version": "0.8.0", "requires_safety_checker": False, **parts}
    (source / "model_index.json").write_text(json.dumps(index))
    saved = run(source, examples_of(photos=photos), tmp_path / "run", config(steps=1))
    loaded = diffusers.DiffusionPipeline.from_pretrained(saved)
    assert loaded.feature_extractor is not None and (loaded.safety_checker is not None) == (safety_checker == "whole")
    assert json.loads((saved / "model_index.json").read_text())["image_encoder"] == [None, None]


def test_a_pipeline_in_half_precision_alone_is_tuned_and_written_whole(pipeline, photos, tmp_path):
    source = shutil.copytree(pipeline, tmp_path / "source")
    for part in ("unet", "vae", "text_encoder"):
        path = next((source / part).glob("*.safetensors"))
        path.rename(path.with_name(path.name.replace(".safetensors", ".fp16.safetensors")))
    saved = run(source, examples_of(photos=photos), tmp_path / "run", config(steps=1))
    assert load_inpainter(saved, steps=2).steps == 2


def test_the_licence_of_a_repository_goes_with_what_was_tuned_from_a_part_of_it(pipeline, photos, tmp_path):
    shutil.copytree(pipeline, tmp_path / "source" / "StereoGen")
    (tmp_path / "source" / "README.md").write_text("---\nlicense: mit\n---\n")
    (tmp_path / "source" / "LICENSE").write_text("MIT")
    saved = run(tmp_path / "source", examples_of(photos=photos), tmp_path / "own", config(steps=1), subfolder="StereoGen")
    assert "openrail" in (saved / "README.md").read_text() and (saved / "LICENSE").read_text() == "MIT"
    (tmp_path / "source" / "StereoGen" / "README.md").unlink()
    saved = run(tmp_path / "source", examples_of(photos=photos), tmp_path / "roots", config(steps=1), subfolder="StereoGen")
    assert "license: mit" in (saved / "README.md").read_text()


def arguments_for(pipeline, output, *more):
    usual = ["--size", 64, 64, "--batch-size", 2, "--micro-batch", 1, "--workers", 1, "--validation-steps", 1]
    return ["--pipeline", pipeline, "--output", output, *usual, *more]


@pytest.mark.filterwarnings("ignore:The built-in depth")
def test_the_command_tunes_on_two_ranks_as_on_one(pipeline, photos, things, tmp_path, monkeypatch):
    members = {}
    for number in range(2):
        left, right, truth = stereo_images(number)
        members |= {f"{number}.left.png": png(left), f"{number}.right.png": png(right), f"{number}.disp.pfm": pfm(truth)}
    tars = write_tar(tmp_path / "pairs.tar", members)
    pair = tmp_path / "pairs" / "wall"
    pair.mkdir(parents=True)
    left, right, truth = stereo_images(9)
    for name, data in {"left.png": png(left), "right.png": png(right), "disp.pfm": pfm(truth)}.items():
        (pair / name).write_bytes(data)
    data = ["--photos", photos, "--datasets", f"sceneflow-clean={things}", f"tars={tars}", "--validate", pair.parent, "--steps", 2]
    data += ["--learning-rate", 1e-3, "--save-every", 2]
    monkeypatch.setattr(sys, "argv", ["inpaint.py", *map(str, arguments_for(pipeline, tmp_path / "one", *data))])
    inpaint.main()
    assert list((tmp_path / "one").glob("**/events.out.tfevents.*")), "no TensorBoard log"
    two = launch(arguments_for(pipeline, tmp_path / "two", *data), 2, script="trainers/inpaint.py")
    assert two.returncode == 0, two.stderr[-3000:]
    assert "step 2: holes of 1 pairs, PSNR" in two.stdout
    folders = [tmp_path / run / "checkpoints" / "step-00000002" for run in ("one", "two")]
    assert json.loads((folders[1] / "state.json").read_text())["world_size"] == 2
    first, second, before = (weights(folder) for folder in (*(folder / "pipeline" for folder in folders), pipeline))
    for name, weight in first.items():
        assert torch.allclose(second[name], weight, atol=2e-4), name
    assert max((first[name] - before[name]).abs().max() for name in first) > 1e-3
    rows = [[json.loads(line) for line in (tmp_path / run / "validation.jsonl").read_text().splitlines()] for run in ("one", "two")]
    assert [row["step"] for row in rows[0]] == [row["step"] for row in rows[1]] == [0, 2]
    assert rows[0][0]["mean"] == pytest.approx(rows[1][0]["mean"], rel=1e-4)
    assert re.search(r"the pipeline is .*two/checkpoints/step-00000002/pipeline", two.stdout)
    assert "the best pipeline is" in two.stdout and step_of(tmp_path / "two" / "best") == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--output", "README.md"], "--output README.md is a file; name a folder"),
        ([], "nothing to learn from: name --photos or --datasets"),
        (["--photos", "nowhere.tar"], "nowhere.tar"),
        (["--depth-cache", "depth"], "--depth-cache keeps the depth of photos; name --photos, or leave it out"),
        (["--datasets", "kitti=somewhere"], "takes KIND=FOLDER with one of sceneflow-clean"),
        (["--datasets", "tartanair=nowhere"], "no folder nowhere"),
        (["--datasets", "vkitti2=tests", "--pipeline", "nowhere"], "no pair of vkitti2 in tests"),
    ],
)
def test_a_wrong_argument_is_one_line_in_words(monkeypatch, capsys, tmp_path, change, message):
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "argv", ["inpaint.py", *map(str, arguments_for("nowhere", tmp_path / "run")), *change])
    with pytest.raises(SystemExit) as end:
        run_trainer(inpaint.main)
    assert message in str(end.value)


@pytest.mark.filterwarnings("ignore:The built-in depth")
def test_every_option_of_the_command_is_handed_on(pipeline, photos, things, tmp_path, monkeypatch):
    told = {}
    monkeypatch.setattr(inpaint, "tune", lambda pipeline, examples, config, **options: told.update(locals()))
    words = "--steps 11 --batch-size 12 --micro-batch 3 --learning-rate 0.14 --ema 0.15 --gradient-checkpointing --mixed-precision bf16"
    more = (
        "--workers 17 --save-every 18 --validation-steps 19 --seed 20 --size 32 48 --validate motorcycle --tracker none --subfolder inner"
    )
    folder = shutil.copytree(pipeline, tmp_path / "all" / "inner").parent
    given = ["--pipeline", folder, "--photos", photos, "--datasets", f"sceneflow-clean={things}", "--output", tmp_path / "run"]
    monkeypatch.setattr(sys, "argv", ["inpaint.py", *map(str, given), *words.split(), *more.split()])
    inpaint.main()
    assert told["config"] == TuneConfig(
        steps=11,
        batch_size=12,
        micro_batch=3,
        learning_rate=0.14,
        ema=0.15,
        gradient_checkpointing=True,
        mixed_precision="bf16",
        workers=17,
        save_every=18,
        validation_steps=19,
        seed=20,
    )
    options, examples = told["options"], told["examples"]
    assert told["pipeline"] == folder and options["subfolder"] == "inner" and options["output"] == tmp_path / "run"
    assert options["resume"] is None and options["tracker"] is None and [pair.name for pair in options["pairs"]] == ["motorcycle"]
    assert len(examples) == 6 + 4 and examples.size == (32, 48)
    both = {"photos": PhotoSource(build_manifest(photos), "builtin", AdaptiveDisparity())}
    both = {"sceneflow-clean": StereoSource(StereoFolder("sceneflow-clean", things)), **both}
    assert examples.position(5) == Examples(both, (32, 48), 20, 12).position(5)


def test_help_names_every_data_set_and_the_tar_layout(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["inpaint.py", "--help"])
    with pytest.raises(SystemExit):
        inpaint.main()
    text = capsys.readouterr().out
    for word in (
        "sceneflow-final=FOLDER",
        "tartanair=",
        "crestereo=",
        "vkitti2=",
        "fallingthings=",
        "KEY.disp.pfm",
        "sd2-community",
        "StereoGen",
        "RUN/best/pipeline",
    ):
        assert word in text
