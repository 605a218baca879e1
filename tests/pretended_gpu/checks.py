"""What runs where there is a GPU, run on a pretended one; `tests/test_on_a_pretended_gpu.py` starts this in a process that can pretend."""

import json
from unittest import mock

import numpy as np
import pytest
import torch
from accelerate.state import AcceleratorState
from safetensors.torch import load_file

from benchmarks import tiers
from tests.pretended_gpu.gpu import OnGpu, brought, gpu
from tests.scenes import photo_tar, shifted_pairs
from tests.small_depth_networks import save_small_network
from tests.small_pipeline import save_small_pipeline
from tests.trainers import test_inpaint as fine_tuning
from tests.trainers import test_training as training
from trainers import run_folder
from trainers.models import load_matcher
from trainers.models.checkpoint import WEIGHTS_FILE
from trainers.validation import EvaluationSet
from zsdata import DepthNetwork, DiffusionNetwork, ZeroStereoStream, load_depth, load_inpainter

pytestmark = pytest.mark.filterwarnings("ignore::zsdata.synthesis.depth.builtin.BuiltinDepthWarning")

SIZE = (64, 96)
INDICES = [0, -1, slice(1, 3), (slice(None), 2), (..., 2), (..., slice(0, 4, 2)), (None, 1), [1, 2], (0, [1, 2]), (..., [0, 3])]


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    folder = tmp_path_factory.mktemp("folders")
    return {
        "photos": photo_tar(folder / "photos.tar", 8),
        "depth": save_small_network("depth_anything", folder / "depth"),
        "inpaint": save_small_pipeline(folder / "inpaint"),
    }


@pytest.fixture(autouse=True)
def fresh_accelerator():
    yield
    AcceleratorState._reset_state(reset_partial_state=True)


def test_it_computes_what_the_cpu_does_and_refuses_what_a_gpu_refuses():
    torch.manual_seed(0)
    values = torch.randn(4, 5, 6)
    network = torch.nn.Linear(6, 3)
    network(values).square().sum().backward()
    expected = network.weight.grad
    with gpu() as waits:
        there = values.to("cuda")
        for index in [*INDICES, values[..., 0] > 0, torch.tensor([1, 1])]:
            changed, changed_there = values.clone(), there.clone()
            changed[index] = changed_there[index] = 3
            assert torch.equal(values[index], there[index].cpu()) and torch.equal(changed, changed_there.cpu())
        assert torch.arange(3, device="cuda").device == torch.tensor([1], device="cuda").device == torch.device("cuda", 0)
        for refused in (lambda: values + there, lambda: torch.cat([values, there]), lambda: torch.add(there, there, out=values)):
            with pytest.raises(RuntimeError, match="one device"):
                refused()
        for refused in (there.numpy, lambda: np.asarray(there)):
            with pytest.raises(TypeError, match=r"Tensor\.cpu"):
                refused()
        network.zero_grad()
        network.to("cuda")(there).square().sum().backward()
        assert isinstance(network.weight.grad, OnGpu) and torch.equal(network.weight.grad.cpu(), expected)
        with torch.autocast("cuda", torch.bfloat16):
            assert network(there).dtype == torch.bfloat16
        waits.clear()
        there.sum().item()
        there.add_(1)
        assert sum(waits.values()) == 1
        brought.clear()
        for mode in (torch.no_grad, torch.inference_mode):
            with mode():
                values.to("cuda", non_blocking=True)
                torch.empty_like(there).copy_(values, non_blocking=True)
                assert sum(brought.values()) == 0
                values.to("cuda")
                torch.empty_like(there).copy_(values)
                torch.tensor([1.0], device="cuda")
                assert sum(brought.values()) == 3
                brought.clear()
                waits.clear()
                there.to("cpu")
                assert sum(waits.values()) == 1


def batches(photos, device, workers=1, micro_batch=None, **options):
    stream = ZeroStereoStream(photos, size=SIZE, **{"seed": 1, "epoch_size": 12, **options})
    with stream.loader(5, num_workers=workers, device=device, micro_batch=micro_batch) as loader:
        return list(loader)


def diffusion(folders, **options):
    return DiffusionNetwork(str(folders["inpaint"]), steps=3, dtype="float32", **options)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"workers": 0},
        {"inpaint": "background"},
        {"reuse": 3},
        {"inpaint": diffusion},
        {"inpaint": lambda folders: diffusion(folders, scheduler="dpm++"), "micro_batch": 2},
    ],
    ids=str,
)
def test_batches_are_finished_as_on_the_cpu(folders, options):
    options = {name: value(folders) if callable(value) else value for name, value in options.items()}
    expected = batches(folders["photos"], "cpu", **options)
    with gpu():
        made = batches(folders["photos"], "cuda", **options)
        assert all(
            isinstance(value, OnGpu) for batch in made for value in (*batch, *batch.masks, batch.left_clean) if value is not batch.masks
        )
        made = [batch.to("cpu") for batch in made]
    for one, other in zip(expected, made, strict=True):
        assert one.meta == other.meta
        for name in ("left_clean", "disparity", "confidence"):
            assert torch.equal(getattr(one, name), getattr(other, name))
        assert all(torch.equal(mask, other_mask) for mask, other_mask in zip(one.masks, other.masks, strict=True))
        assert torch.allclose(one.right_clean, other.right_clean, atol=0.01) and torch.allclose(one.right, other.right, atol=0.02)


@pytest.mark.parametrize(
    "options",
    [
        {"depth": "builtin"},
        {"depth": "network"},
        {"depth": "network", "views_per_image": 2},
        {"depth": "network", "inpaint": diffusion},
        {"depth": "loaded"},
    ],
    ids=str,
)
def test_pairs_are_made_as_in_the_workers(folders, options):
    def run(device, **placement):
        depth = {
            "builtin": lambda: "builtin",
            "network": lambda: DepthNetwork(str(folders["depth"]), micro_batch=3),
            "loaded": lambda: load_depth(folders["depth"], device),
        }[options["depth"]]()
        others = {name: value(folders) if callable(value) else value for name, value in options.items()}
        return batches(folders["photos"], device, **{**others, "depth": depth}, **placement)

    expected = run("cpu")
    with gpu():
        made = [batch.to("cpu") for batch in run("cuda", depth_placement="device")]
    for one, other in zip(expected, made, strict=True):
        assert [meta["key"] for meta in one.meta] == [meta["key"] for meta in other.meta]
        step = max(meta["largest_disparity_px"] for meta in one.meta) / 65_535 * 8  # of depth's 16 bits; a view may enlarge a part of it
        assert torch.allclose(one.disparity, other.disparity, atol=step) and torch.allclose(one.confidence, other.confidence, atol=1e-2)
        assert all((mask != other_mask).float().mean() <= 0.001 for mask, other_mask in zip(one.masks, other.masks, strict=True))


def test_a_loader_stays_on_the_gpu_that_was_current_when_it_was_made(folders):
    with gpu(), mock.patch("torch.cuda.device_count", lambda: 2), mock.patch("torch.cuda.current_device", lambda: 1):
        loader = ZeroStereoStream(folders["photos"], size=SIZE).loader(2, device="cuda")
    assert loader.device == torch.device("cuda", 1)


def test_a_network_is_given_all_steps_of_a_micro_batch_without_a_wait(folders):
    right, inpaint_mask = torch.full((4, 3, *SIZE), 9.0), torch.ones(4, 1, *SIZE, dtype=torch.bool)
    with gpu() as waits:
        inpainter = load_inpainter(diffusion(folders, micro_batch=2), "cuda")
        depth = load_depth(DepthNetwork(str(folders["depth"]), micro_batch=2), "cuda")
        right, inpaint_mask = right.to("cuda"), inpaint_mask.to("cuda")
        prepared = [depth.prepare(torch.zeros(1, 3, *SIZE, dtype=torch.uint8))] * 2
        waits.clear()
        brought.clear()
        inpainter(right, inpaint_mask, [np.random.default_rng(sample) for sample in range(4)])
        assert not waits and sum(brought.values()) == 2  # each micro-batch's noise, before anything else of it
        brought.clear()
        list(depth.predict_mirrored(prepared, [SIZE] * 2))
        assert not waits and not brought


@pytest.mark.parametrize("precision", ["no", "bf16", "fp16"])
def test_training_goes_on_exactly_and_no_step_waits_for_each_weight(folders, tmp_path, precision):
    settings = training.config(steps=4, mixed_precision=precision, ema=0.9, workers=1)
    sets = [EvaluationSet.parse(str(shifted_pairs(tmp_path / "pairs")))]
    with gpu() as waits:
        unbroken = training.run_training(folders["photos"], tmp_path / "run", settings, sets=sets, inpaint="builtin")
        assert {parameter.device.type for parameter in unbroken.parameters()} == {"cuda"}
        AcceleratorState._reset_state(reset_partial_state=True)
        half, waits["trainers.loop.train"] = tmp_path / "run" / "checkpoints" / "step-00000002", 0
        training.run_training(folders["photos"], tmp_path / "resumed", settings, resume=half, sets=sets, inpaint="builtin")
        assert waits["trainers.loop.train"] <= 2 * 2  # what two steps log, and fp16's look at its gradients
    one, other = (load_file(run_folder.newest(tmp_path / run) / WEIGHTS_FILE) for run in ("run", "resumed"))
    assert all(torch.equal(weight, other[name]) for name, weight in one.items())


@pytest.mark.parametrize("name", ["raft_stereo", "igev_stereo"])
def test_matchers_see_the_same_on_the_gpu(name):
    torch.manual_seed(0)
    matcher = load_matcher(name, **(training.SMALL if name == "raft_stereo" else {})).eval()
    left, right = torch.rand(2, 1, 3, 64, 128).mul(255)
    expected = matcher.predict(left, right, iterations=2)
    with gpu():
        matcher.to("cuda")
        assert torch.allclose(matcher.predict(left.to("cuda"), right.to("cuda"), iterations=2).cpu(), expected, atol=1e-4)
        with torch.autocast("cuda", torch.bfloat16):
            half = matcher.predict(left.to("cuda"), right.to("cuda"), iterations=2).cpu()
    assert 0 < (half - expected).abs().mean() < 0.05 * expected.abs().max()


def test_fine_tuning_goes_on_exactly_and_no_step_waits_for_each_weight(folders, tmp_path):
    settings = fine_tuning.config(steps=4, micro_batch=2, mixed_precision="bf16", ema=0.9, workers=1, gradient_checkpointing=True)
    pipeline, examples = folders["inpaint"], fine_tuning.examples_of(photos=folders["photos"])
    with gpu() as waits:
        unbroken = fine_tuning.run(pipeline, examples, tmp_path / "run", settings, pairs=[fine_tuning.real_pair()])
        half, waits["trainers.inpaint_loop.tune"] = tmp_path / "run" / "checkpoints" / "step-00000002", 0
        resumed = fine_tuning.run(pipeline, examples, tmp_path / "resumed", settings, resume=half)
        assert waits["trainers.inpaint_loop.tune"] <= 2
    one, other = fine_tuning.weights(unbroken), fine_tuning.weights(resumed)
    assert all(torch.equal(weight, other[name]) for name, weight in one.items())


def test_the_tiers_are_measured(tmp_path):
    with gpu():
        tiers.main(["--smoke", "--device", "cuda", "--json", str(tmp_path / "figures.json")])
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert figures["device"] == "pretended" and figures["dtype"] == "torch.bfloat16"
    assert {row["micro_batch"] for row in figures["inpainting"][1:]} == {2}
    assert all(row["peak_bytes"] is not None for row in figures["inpainting"] + figures["depth"])
