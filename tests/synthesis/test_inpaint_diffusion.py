import json
import logging
import os
import pickle
import re
import shutil
import subprocess
import sys
from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from safetensors.torch import load_file, save_file
from torch.utils.data import DataLoader

from tests import oracles_diffusion as oracle
from tests.scenes import SHARED, layered_depth, photo_tar
from zsdata import ZeroStereoStream, load_inpainter
from zsdata.seeding import rng
from zsdata.synthesis import micro_batch
from zsdata.synthesis.inpaint import diffusion, fill
from zsdata.synthesis.inpaint.diffusion import AUTOENCODER_BATCH, latent_mask
from zsdata.synthesis.inpaint.options import DiffusionNetwork
from zsdata.synthesis.inpaint.schedulers import SCHEDULERS

diffusers = pytest.importorskip("diffusers")
transformers = pytest.importorskip("transformers")

PUBLISHED = SHARED / "published"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A small inpainting pipeline with random weights in the layout of Stable Diffusion 2 Inpainting, of a class that diffusers lacks."""
    path = tmp_path_factory.mktemp("inpainting")
    with torch.random.fork_rng():
        torch.manual_seed(0)
        small_unet(9).save_pretrained(path / "unet")
        vae = diffusers.AutoencoderKL(
            down_block_types=["DownEncoderBlock2D"] * 4,
            up_block_types=["UpDecoderBlock2D"] * 4,
            block_out_channels=[4, 4, 8, 8],
            norm_num_groups=2,
        )
        vae.save_pretrained(path / "vae")
        text = transformers.CLIPTextConfig(vocab_size=4, hidden_size=16, intermediate_size=16, num_hidden_layers=1, num_attention_heads=2)
        transformers.CLIPTextModel(text).save_pretrained(path / "text_encoder")
    scheduler = diffusers.PNDMScheduler(
        beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear", skip_prk_steps=True, steps_offset=1
    )
    scheduler.save_pretrained(path / "scheduler")
    (path / "tokenizer").mkdir()
    (path / "tokenizer" / "vocab.json").write_text('{"<|startoftext|>": 0, "<|endoftext|>": 1, "a": 2, "a</w>": 3}')
    (path / "tokenizer" / "merges.txt").write_text("#version: 0.2\n")
    (path / "tokenizer" / "tokenizer_config.json").write_text(
        '{"tokenizer_class": "CLIPTokenizer", "model_max_length": 77, "bos_token": "<|startoftext|>", "eos_token": "<|endoftext|>",'
        ' "pad_token": "!", "unk_token": "<|endoftext|>"}'
    )
    (path / "model_index.json").write_text('{"_class_name": "NobodyKnowsThisPipeline"}')
    return path


def small_unet(in_channels):
    return diffusers.UNet2DConditionModel(
        in_channels=in_channels,
        out_channels=4,
        block_out_channels=[8, 16, 16],
        norm_num_groups=4,
        attention_head_dim=4,
        layers_per_block=1,
        cross_attention_dim=16,
        down_block_types=["CrossAttnDownBlock2D", "CrossAttnDownBlock2D", "DownBlock2D"],
        up_block_types=["UpBlock2D", "CrossAttnUpBlock2D", "CrossAttnUpBlock2D"],
    )


def tiny_autoencoder(halvings):
    blocks = {"encoder_block_out_channels": (8,) * (halvings + 1), "decoder_block_out_channels": (8,) * (halvings + 1)}
    return diffusers.AutoencoderTiny(**blocks, num_encoder_blocks=(1,) * (halvings + 1), num_decoder_blocks=(1,) * (halvings + 1))


@pytest.fixture
def copy(folder, tmp_path):
    """The same pipeline in a folder of its own, to be damaged."""
    return shutil.copytree(folder, tmp_path / "copy")


@pytest.fixture(scope="module")
def inpainter(folder):
    return load_inpainter(folder, steps=3)


def change(config, **values):
    config.write_text(json.dumps({**json.loads(config.read_text()), **values}))


def scenes(count, height=48, width=64):
    """Images and ragged masks; the last part of each image is a strip of holes, as a warp leaves it."""
    random = np.random.default_rng(0)
    right = torch.from_numpy(random.uniform(0, 255, (count, 3, height, width)).astype(np.float32))
    inpaint_mask = torch.from_numpy(random.uniform(size=(count, 1, height, width)) < 0.05)
    inpaint_mask[..., -10:] = True
    return right, inpaint_mask


def generators(*indices):
    return [rng(0, 0, index, "inpaint") for index in indices]


def latent_noise(count, height=48, width=64):
    random = np.random.default_rng(1)
    return torch.from_numpy(random.standard_normal((count, 4, -(-height // 8), -(-width // 8)), dtype=np.float32))


@pytest.mark.skipif(not PUBLISHED.is_dir(), reason="the published pipeline is not here")
@pytest.mark.skipif(int(transformers.__version__.split(".")[0]) < 5, reason="its text encoder was saved by transformers 5")
@pytest.mark.parametrize("steps", [4, 50])
def test_the_published_images_are_reproduced(steps):
    with np.load(PUBLISHED / "inpainting.npz") as file:
        published = {name: torch.from_numpy(file[name]) for name in file.files}
    inpainter = load_inpainter(PUBLISHED / "tiny_inpainting", steps=steps)
    made = inpainter.inpaint_from_noise((published["warped"] + 1) * 127.5, published["inpaint_mask"], published["noise"])
    assert torch.allclose(made / 127.5 - 1, published[f"output_{steps}_steps"], rtol=0, atol=1e-4)
    other = published[f"output_{54 - steps}_steps"]
    assert (made / 127.5 - 1 - other).abs().max() > 1e-2  # the comparison can tell 4 steps from 50


@pytest.mark.parametrize("size", [(48, 64), (43, 61)])
def test_every_step_is_the_one_of_the_formulas(folder, size):
    """Against a plain DDIM loop; the folder's scheduler is another one (PNDM), as in Stable Diffusion's own folders."""
    right, inpaint_mask = scenes(1, *size)
    noise = latent_noise(1, *size)
    made = load_inpainter(folder, steps=7).inpaint_from_noise(right, inpaint_mask, noise)
    unet = diffusers.UNet2DConditionModel.from_pretrained(folder, subfolder="unet")
    vae = diffusers.AutoencoderKL.from_pretrained(folder, subfolder="vae")
    text_encoder = transformers.CLIPTextModel.from_pretrained(folder, subfolder="text_encoder")
    with torch.no_grad():
        prompt = text_encoder(torch.tensor([[0, 1]])).last_hidden_state  # begin, end
        expected = oracle.ddim_inpaint(unet, vae, prompt, right[0].numpy(), inpaint_mask[0, 0].numpy(), noise[0].numpy(), steps=7)
    assert np.std(expected) > 1
    np.testing.assert_allclose(made[0].numpy(), expected, rtol=0, atol=1e-4 * 127.5)


@pytest.mark.parametrize("scheduler", ["ddim", "lcm"])  # lcm adds noise at every step
def test_a_sample_does_not_depend_on_the_samples_beside_it(folder, scheduler):
    inpainter = load_inpainter(folder, steps=3, scheduler=scheduler)
    right, inpaint_mask = scenes(8)
    whole = inpainter(right, inpaint_mask, generators(*range(8)))
    for at_once in (1, 3, 8, None):
        assert torch.equal(fill(inpainter, right, inpaint_mask, generators(*range(8)), {}, at_once), whole)
    order = [5, 0, 7, 2]
    assert torch.equal(inpainter(right[order], inpaint_mask[order], generators(*order)), whole[order])


@pytest.mark.parametrize("micro_batch", [1, 3, 8])
def test_the_micro_batch_changes_no_more_than_rounding(folder, inpainter, micro_batch, monkeypatch):
    """As on a GPU, where many samples go through the networks at once."""
    right, inpaint_mask = scenes(8)
    expected = inpainter(right, inpaint_mask, generators(*range(8)))
    together, seen = load_inpainter(folder, steps=3), []
    together.micro_batch.size = micro_batch
    unet, encode, decode = together._unet.forward, together._autoencoder.encode, together._autoencoder.decode
    decoded = []
    monkeypatch.setattr(together._unet, "forward", lambda noisy, *_, **__: seen.append(len(noisy)) or unet(noisy, *_, **__))
    monkeypatch.setattr(together._autoencoder, "encode", lambda images: seen.append(-len(images)) or encode(images))
    monkeypatch.setattr(together._autoencoder, "decode", lambda latents: decoded.append(len(latents)) or decode(latents))
    made = together(right, inpaint_mask, generators(*range(8)))
    assert max(seen) == micro_batch and -min(seen) == max(decoded) == min(micro_batch, AUTOENCODER_BATCH)
    assert torch.allclose(made, expected, rtol=0, atol=1e-4 * 127.5)


def test_samples_without_holes_skip_the_network(inpainter, monkeypatch):
    right, inpaint_mask = scenes(3)
    inpaint_mask[1] = False
    seen, unet = [], inpainter._unet.forward
    monkeypatch.setattr(inpainter._unet, "forward", lambda noisy, *_, **__: seen.append(len(noisy)) or unet(noisy, *_, **__))
    filled = fill(inpainter, right, inpaint_mask, generators(0, 1, 2), {}, None)
    assert sum(seen) == 2 * 3 and torch.equal(filled[1], right[1])  # two samples, three steps


def test_each_sample_has_noise_of_its_own(inpainter):
    right, inpaint_mask = scenes(1)
    one, other = inpainter(right.expand(2, -1, -1, -1), inpaint_mask.expand(2, -1, -1, -1), generators(0, 1))
    assert (one - other).abs().max() > 1


@pytest.mark.parametrize("scheduler", ["lcm", "tcd"])
def test_noise_that_is_added_on_the_way_is_each_samples_own(folder, scheduler):
    """Two samples begin with all but the same noise: only what a scheduler adds can make them differ."""
    inpainter, (right, inpaint_mask), noise = load_inpainter(folder, steps=3, scheduler=scheduler), scenes(1), latent_noise(1)
    noises = torch.cat([noise, noise + 1e-4])
    one, other = inpainter.inpaint_from_noise(right.expand(2, -1, -1, -1), inpaint_mask.expand(2, -1, -1, -1), noises)
    assert (one - other).abs().max() > 1
    assert torch.equal(inpainter.inpaint_from_noise(right, inpaint_mask, noises[1:])[0], other)


@settings(max_examples=50, deadline=None)
@given(st.data())
def test_a_cell_is_known_only_if_all_its_pixels_are(data):
    height, width = data.draw(st.tuples(st.integers(1, 40), st.integers(1, 40)))
    mask = data.draw(arrays(bool, (height, width), elements=st.booleans(), fill=st.just(False)))
    assert np.array_equal(latent_mask(torch.from_numpy(mask)[None, None])[0, 0].numpy(), oracle.latent_mask(mask))


@pytest.mark.parametrize("size", [(48, 64), (41, 71), (9, 8)])
def test_known_pixels_stay_and_holes_are_filled_at_any_size(inpainter, size):
    right, inpaint_mask = scenes(2, *size)
    before = right.clone(), inpaint_mask.clone()
    made = inpainter(right, inpaint_mask, generators(0, 1))
    holes = inpaint_mask.expand_as(right)
    assert made.shape == right.shape and made.dtype == torch.float32
    assert torch.equal(made[~holes], right[~holes])
    assert made[holes].min() >= 0 and made[holes].max() <= 255 and (made[holes] != right[holes]).float().mean() > 0.9
    assert torch.equal(right, before[0]) and torch.equal(inpaint_mask, before[1])


def test_what_stands_in_the_holes_is_not_looked_at(inpainter):
    right, inpaint_mask = scenes(1)
    filled = inpainter(right, inpaint_mask, generators(0))
    assert torch.equal(inpainter(right.masked_fill(inpaint_mask, float("nan")), inpaint_mask, generators(0)), filled)


@pytest.mark.parametrize(
    "scheduler",
    [
        *SCHEDULERS,
        "DDPMScheduler",
        "DPMSolverSinglestepScheduler",
        "EulerAncestralDiscreteScheduler",
        "HeunDiscreteScheduler",
        "PNDMScheduler",
        "UniPCMultistepScheduler",
    ],
)
def test_other_schedulers_run_and_repeat_themselves(folder, scheduler):
    inpainter = load_inpainter(folder, steps=4, scheduler=scheduler)
    right, inpaint_mask = scenes(2)
    made = inpainter(right, inpaint_mask, generators(0, 1))
    assert torch.isfinite(made).all() and inpainter.scheduler == SCHEDULERS.get(scheduler, scheduler)
    assert torch.equal(inpainter(right, inpaint_mask, generators(0, 1)), made)


@pytest.mark.parametrize("steps", [1, 2, 50])
@pytest.mark.parametrize(
    "scheduler", ["ddim", "dpm++", "euler", "lcm", "tcd", "DDPMScheduler", "EulerAncestralDiscreteScheduler", "HeunDiscreteScheduler"]
)
def test_noise_becomes_what_a_perfect_network_was_trained_on(folder, monkeypatch, scheduler, steps):
    """A network that knows that all latents are drawn from N(0.5, 0.7) leads noise there: all but the spread in few steps."""
    inpainter = load_inpainter(folder, steps=steps, scheduler=scheduler)
    alphas = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64).square().neg().add(1).cumprod(0)

    def predict_noise(noisy, timestep, encoder_hidden_states):
        kept = alphas[round(float(timestep))]
        noisy = noisy[:, :4].double()
        clean = 0.5 + kept.sqrt() * 0.49 / (kept * 0.49 + 1 - kept) * (noisy - kept.sqrt() * 0.5)
        return SimpleNamespace(sample=((noisy - kept.sqrt() * clean) / (1 - kept).sqrt()).float())

    monkeypatch.setattr(inpainter._unet, "forward", predict_noise)
    noise = latent_noise(1, 512, 512)
    nothing = torch.zeros(1, 1, 64, 64), torch.zeros(1, 4, 64, 64)
    latents = inpainter._denoise(noise, *nothing, [torch.Generator().manual_seed(0)], None)
    assert abs(latents.mean() - 0.5) < 0.06
    assert latents.std() < 0.75 and (steps < 50 or latents.std() > 0.45)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"beta_schedule": None}, "lacks beta_schedule: the noise that its U-Net was trained with"),
        ({"prediction_type": "flow_prediction"}, "prediction_type 'flow_prediction'"),
        ({"use_flow_sigmas": True}, "use_flow_sigmas"),
    ],
)
def test_a_pipeline_without_its_noise_schedule_is_refused(copy, config, message):
    path = copy / "scheduler" / "scheduler_config.json"
    change(path, **config)
    with pytest.raises(ValueError, match=message):
        load_inpainter(copy)
    path.write_text("{}")
    with pytest.raises(ValueError, match="lacks beta_start, beta_end, beta_schedule"):
        load_inpainter(copy)


def test_eulers_steps_are_those_of_ddim(copy):
    """Euler's method in units of sigma is DDIM in other words, once both end without noise; it scales its latents, and DDIM does not."""
    change(copy / "scheduler" / "scheduler_config.json", set_alpha_to_one=True, timestep_spacing="leading")
    right, inpaint_mask = scenes(1)
    ddim, euler = (load_inpainter(copy, steps=5, scheduler=name)(right, inpaint_mask, generators(0)) for name in ("ddim", "euler"))
    assert torch.allclose(euler, ddim, rtol=0, atol=0.02)


def test_a_tiny_autoencoder_can_take_the_place_of_the_pipelines_own(copy, inpainter):
    with torch.random.fork_rng():
        torch.manual_seed(1)
        tiny_autoencoder(halvings=3).save_pretrained(copy / "tiny")
    shutil.rmtree(copy / "vae")
    right, inpaint_mask = scenes(2, 41, 64)
    made = load_inpainter(copy, steps=3, autoencoder=str(copy / "tiny"))(right, inpaint_mask, generators(0, 1))
    assert torch.isfinite(made).all() and not torch.equal(made, inpainter(right, inpaint_mask, generators(0, 1)))
    (copy / "tiny").rename(copy / "vae")  # or be the pipeline's own
    assert torch.equal(load_inpainter(copy, steps=3)(right, inpaint_mask, generators(0, 1)), made)


def test_half_precision_stays_close(folder, inpainter):
    right, inpaint_mask = scenes(1)
    half = load_inpainter(folder, steps=3, dtype="bf16")
    made = half(right, inpaint_mask, generators(0))
    assert half.dtype == torch.bfloat16 and inpainter.dtype == torch.float32 and made.dtype == torch.float32
    assert 0 < (made - inpainter(right, inpaint_mask, generators(0))).abs().mean() < 10


def test_an_autocast_around_it_changes_nothing(folder, inpainter):
    right, inpaint_mask = scenes(1)
    with torch.autocast("cpu", torch.bfloat16):
        made = inpainter(right, inpaint_mask, generators(0))
        loaded_there = load_inpainter(folder, steps=inpainter.steps)  # as a stream does at its first pair
    expected = inpainter(right, inpaint_mask, generators(0))
    assert torch.equal(made, expected)
    assert torch.equal(loaded_there(right, inpaint_mask, generators(0)), expected)


@pytest.mark.filterwarnings("ignore:.*script_method.*:DeprecationWarning")  # PyTorch's own compiler
def test_a_compiled_unet_is_used(folder, inpainter):
    right, inpaint_mask = scenes(1)
    compiled = load_inpainter(folder, steps=3, compile=True)
    parts = compiled._unet, compiled._autoencoder.encoder, compiled._autoencoder.decoder
    assert all(part._compiled_call_impl is not None for part in parts) and inpainter._unet._compiled_call_impl is None
    with torch.compiler.set_stance("force_eager"):
        assert torch.equal(compiled(right, inpaint_mask, generators(0)), inpainter(right, inpaint_mask, generators(0)))


def test_no_global_random_number_is_drawn(folder):
    before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    load_inpainter(folder, steps=2, scheduler="tcd")(*scenes(1), generators(0))
    assert torch.equal(torch.get_rng_state(), before[0]) and np.array_equal(np.random.get_state()[1], before[1])  # noqa: NPY002


def test_a_pipeline_deeper_in_the_folder_is_found(folder):
    inpainter = load_inpainter(folder.parent, steps=2, subfolder=folder.name)
    assert inpainter(*scenes(1), generators(0)).shape == (1, 3, 48, 64)


def test_a_hub_id_is_found_in_the_cache_without_network(folder, tmp_path):
    repository = tmp_path / "hub" / "models--somebody--pipelines"
    shutil.copytree(folder, repository / "snapshots" / ("0" * 40) / "inpainting")
    (repository / "refs").mkdir()
    (repository / "refs" / "v1").write_text("0" * 40)
    program = (
        "from zsdata import load_inpainter\n"
        'inpainter = load_inpainter("somebody/pipelines", steps=2, subfolder="inpainting", revision="v1")\n'
        'assert inpainter.network.revision == "v1"\n'
        "try:\n"
        '    load_inpainter("somebody/pipelines", steps=2, revision="v1")\n'
        "except OSError as error:\n"
        '    assert "somebody/pipelines/scheduler cannot be loaded" in str(error)\n'
    )
    offline = {**os.environ, "HF_HOME": str(tmp_path), "HF_HUB_CACHE": str(tmp_path / "hub"), "HF_HUB_OFFLINE": "1"}
    result = subprocess.run([sys.executable, "-c", program], env=offline, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr


def test_a_pipeline_works_in_the_stream(folder, tmp_path):
    photos = photo_tar(tmp_path / "photos.tar", 2)
    stream = ZeroStereoStream(photos, size=(64, 96), inpaint=folder, depth=lambda images: images.mean(1, keepdim=True))
    pairs = list(stream)
    holes = [pair.right_clean[pair.masks.inpaint.expand(3, -1, -1)] for pair in pairs]
    assert len(pairs) == 2 and all(len(values) and torch.isfinite(values).all() and values.std() > 0 for values in holes)


def pretend_gpu(inpainter, micro_batch):
    """Lets it take more than one sample at once, which on the CPU it does not."""
    inpainter.micro_batch._most = sys.maxsize
    inpainter.micro_batch.choose(micro_batch)
    inpainter._auto = inpainter.network.micro_batch == "auto"


def count_memory(inpainter, per_sample, monkeypatch):
    """Pretends that a trial takes so many bytes for each sample and half a second; returns the list of the numbers that are tried."""
    tried = []
    counted = lambda work, device: (work(), (tried[-1] * per_sample, 0.5))[1]  # noqa: E731
    monkeypatch.setattr(inpainter, "_try", lambda samples, size: tried.append(samples))
    monkeypatch.setattr(diffusion, "measure", counted)
    monkeypatch.setattr(micro_batch, "measure", counted)
    return tried


def count_unet(inpainter, monkeypatch):
    """The list of the numbers of samples that its U-Net gets from now on."""
    seen, unet = [], inpainter._unet.forward
    monkeypatch.setattr(inpainter._unet, "forward", lambda noisy, *_, **__: seen.append(len(noisy)) or unet(noisy, *_, **__))
    return seen


def limit_memory(inpainter, most, monkeypatch):
    """Lets the U-Net take `most` samples at once."""
    unet = inpainter._unet.forward

    def limited(noisy, *arguments, **options):
        if len(noisy) > most:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return unet(noisy, *arguments, **options)

    monkeypatch.setattr(inpainter._unet, "forward", limited)


def test_out_of_memory_lowers_the_micro_batch_and_nothing_else(folder, inpainter, monkeypatch, caplog):
    right, inpaint_mask = scenes(5)
    full = load_inpainter(folder, steps=3)
    full.micro_batch.size = 5
    limit_memory(full, 2, monkeypatch)
    with caplog.at_level(logging.WARNING, "zsdata"):
        made = full(right, inpaint_mask, generators(*range(5)))
        full(right, inpaint_mask, generators(*range(5)))
    assert torch.allclose(made, inpainter(right, inpaint_mask, generators(*range(5))), rtol=0, atol=1e-4 * 127.5)
    assert (full.micro_batch.size, full.micro_batch.lowered, len(caplog.records)) == (2, 1, 1)


def test_a_sample_that_does_not_fit_says_what_to_lower(folder, monkeypatch):
    full = load_inpainter(folder, steps=2)
    limit_memory(full, 0, monkeypatch)
    with pytest.raises(MemoryError, match=r"not enough memory for one sample \(diffusion inpainting\): .*take a smaller crop"):
        full(*scenes(3), generators(0, 1, 2))
    with pytest.raises(MemoryError, match="smaller crop"):
        full.warm_up((48, 64))


def test_a_warm_up_runs_the_networks_and_says_what_they_take(folder, monkeypatch):
    inpainter, seen = load_inpainter(folder, steps=50), []
    unet = inpainter._unet.forward
    monkeypatch.setattr(inpainter._unet, "forward", lambda noisy, *_, **__: seen.append(noisy.shape) or unet(noisy, *_, **__))
    report = inpainter.warm_up((43, 64))
    assert seen == [(1, 9, 6, 8)] * 2  # not all 50 steps
    assert (report.micro_batch, report.peak_bytes) == (1, None)
    assert str(report).startswith(f"inpainting {folder} at 43x64, torch.float32: micro-batch 1, warm after")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu_the_micro_batch_is_found_and_memory_counted(folder):
    inpainter = load_inpainter(folder, "cuda", steps=2, dtype="float32")
    report = inpainter.warm_up((48, 64))
    assert report.micro_batch == inpainter.micro_batch.size > 1 and report.peak_bytes > 0
    right, inpaint_mask = (tensor.cuda() for tensor in scenes(3))
    made = inpainter(right, inpaint_mask, generators(0, 1, 2))
    expected = load_inpainter(folder, steps=2)(right.cpu(), inpaint_mask.cpu(), generators(0, 1, 2))
    assert (made.cpu() - expected).abs().mean() < 0.1
    little = load_inpainter(folder, "cuda", steps=2, memory_gib=1e-3)
    assert little.warm_up((48, 64)).micro_batch == 1


def test_auto_takes_what_the_budget_allows(folder, monkeypatch):
    """On a pretended GPU whose need is a quarter of a GiB a sample."""
    inpainter = load_inpainter(folder, memory_gib=1.2)
    pretend_gpu(inpainter, 1)
    tried = count_memory(inpainter, 2**28, monkeypatch)
    report = inpainter.warm_up((48, 64))
    assert tried == [1, 2, 4, 4] and report.micro_batch == 4
    assert 2**30 < report.peak_bytes < 1.01 * 2**30  # the small weights are counted too
    assert report.seconds == 2


@pytest.mark.parametrize(
    ("samples", "tried", "found"), [(2, [1, 2, 2], 2), (6, [1, 2, 4, 3], 3), (3, [1, 2, 2], 2), (100, [1, 2, 4, 4], 4)]
)
def test_auto_takes_no_more_than_will_come_and_divides_it_evenly(folder, monkeypatch, samples, tried, found):
    """On a pretended GPU where four samples fit: six come as three and three."""
    inpainter = load_inpainter(folder, memory_gib=1.2)
    pretend_gpu(inpainter, 1)
    seen = count_memory(inpainter, 2**28, monkeypatch)
    assert inpainter.warm_up((48, 64), samples).micro_batch == found and seen[: len(tried)] == tried


def test_an_inpainter_that_two_loaders_share_is_made_ready_for_each(folder, monkeypatch):
    """A validation of single pairs must not leave a training of eight with single ones, and a larger crop is tried anew."""
    inpainter = load_inpainter(folder, memory_gib=2.2)
    pretend_gpu(inpainter, 1)
    tried = count_memory(inpainter, 2**28, monkeypatch)
    ready = [inpainter.warm_up(size, samples).micro_batch for size, samples in [((48, 64), 1), ((48, 64), 8), ((48, 64), 2), ((96, 64), 8)]]
    assert ready == [1, 8, 2, 8]
    assert tried == [1, 1, *(1, 2, 4, 8), 8, 2, *(1, 2, 4, 8), 8]
    asked = load_inpainter(folder, micro_batch=8)
    pretend_gpu(asked, 8)
    count_memory(asked, 2**28, monkeypatch)
    assert [asked.warm_up((48, 64), samples).micro_batch for samples in (2, 8, 12, None)] == [2, 8, 6, 8]


def test_a_micro_batch_that_memory_ran_out_with_is_not_tried_again(folder, monkeypatch):
    inpainter = load_inpainter(folder, micro_batch=8)
    pretend_gpu(inpainter, 8)
    limit_memory(inpainter, 4, monkeypatch)
    assert [inpainter.warm_up((48, 64), samples).micro_batch for samples in (8, 2, 8)] == [4, 2, 4]
    assert (inpainter.micro_batch.size, inpainter.micro_batch.lowered) == (4, 1)


def test_what_a_warm_up_says_is_not_the_memory_of_what_did_not_fit(folder, monkeypatch):
    inpainter, tried = load_inpainter(folder, micro_batch=8), []
    pretend_gpu(inpainter, 8)
    limit_memory(inpainter, 4, monkeypatch)

    def largest(work, device):
        tried.clear()
        work()
        return max(tried) * 2**28, 0.5

    one_try = inpainter._try
    monkeypatch.setattr(inpainter, "_try", lambda samples, size: tried.append(samples) or one_try(samples, size))
    monkeypatch.setattr(micro_batch, "measure", largest)
    report = inpainter.warm_up((48, 64))
    assert (report.micro_batch, report.peak_bytes - report.weights, report.seconds) == (4, 4 * 2**28, 1)


def test_without_a_warm_up_no_more_are_tried_than_have_come(folder, monkeypatch):
    inpainter = load_inpainter(folder, steps=2, memory_gib=8.0)
    pretend_gpu(inpainter, 1)
    tried = count_memory(inpainter, 2**28, monkeypatch)
    for count in (1, 1, 3, 2):
        inpainter(*scenes(count), generators(*range(count)))
    assert tried == [1, *(1, 2)]


def test_auto_measures_a_compiled_network_without_what_it_is_filled_up_with(folder, monkeypatch):
    """A second search, for more samples, finds more, though the network was compiled for fewer before."""
    compiled = load_inpainter(folder, steps=1, compile=True, memory_gib=8.0)
    pretend_gpu(compiled, 1)
    seen = count_unet(compiled, monkeypatch)
    for module in (diffusion, micro_batch):
        monkeypatch.setattr(module, "measure", lambda work, device: (work(), (seen[-1] * 2**28, 0.5))[1])
    with torch.compiler.set_stance("force_eager"):
        assert [compiled.warm_up((48, 64), samples).micro_batch for samples in (4, 16)] == [4, 16]
    assert seen == [1, 2, 4, 4, *(1, 2, 4, 8, 16), 16]


def test_a_smaller_warm_up_leaves_larger_batches_whole(folder, monkeypatch):
    inpainter = load_inpainter(folder, steps=1, micro_batch=8)
    pretend_gpu(inpainter, 8)
    for samples in (8, 2):
        inpainter.warm_up((48, 64), samples)
    seen = count_unet(inpainter, monkeypatch)
    inpainter(*scenes(8), generators(*range(8)))
    assert seen == [8]


def test_a_memory_limit_that_cannot_be_held_is_said(folder, monkeypatch, caplog):
    inpainter = load_inpainter(folder, memory_gib=0.1)
    monkeypatch.setattr(diffusion, "measure", lambda work, device: (2**28, 0.5))
    pretend_gpu(inpainter, 1)
    with caplog.at_level(logging.WARNING, "zsdata"):
        assert inpainter.warm_up((48, 64)).micro_batch == 1
    assert "memory_gib=0.1 cannot be held: one sample and the weights take 0.25 GiB" in caplog.text


@pytest.mark.filterwarnings("ignore:.*script_method.*:DeprecationWarning")  # PyTorch's own compiler
def test_a_compiled_network_sees_one_size_alone(folder, inpainter, monkeypatch):
    """Whatever number of samples has holes; another size would be compiled anew in the middle of training."""
    right, inpaint_mask = scenes(5)
    compiled, seen = load_inpainter(folder, steps=3, compile=True), []
    compiled.micro_batch.size = 3
    unet = compiled._unet.forward
    monkeypatch.setattr(compiled._unet, "forward", lambda noisy, *_, **__: seen.append(len(noisy)) or unet(noisy, *_, **__))
    with torch.compiler.set_stance("force_eager"):
        made = compiled(right, inpaint_mask, generators(*range(5)))
    assert set(seen) == {3}
    assert torch.allclose(made, inpainter(right, inpaint_mask, generators(*range(5))), rtol=0, atol=1e-4 * 127.5)


@pytest.mark.filterwarnings("ignore:.*script_method.*:DeprecationWarning")  # PyTorch's own compiler
def test_a_compiled_network_that_runs_out_of_memory_takes_half_of_what_it_was_filled_up_to(folder, monkeypatch):
    """Three samples, filled up to eight, of which four fit: four are tried next, and not one."""
    compiled = load_inpainter(folder, steps=2, compile=True, micro_batch=8)
    pretend_gpu(compiled, 8)
    with torch.compiler.set_stance("force_eager"):
        compiled.warm_up((48, 64), 8)
        limit_memory(compiled, 4, monkeypatch)
        compiled(*scenes(3), generators(0, 1, 2))
        assert (compiled.micro_batch.size, compiled.micro_batch.lowered) == (4, 1)
        compiled(*scenes(1), generators(0))
    assert compiled.micro_batch.lowered == 1


@pytest.mark.filterwarnings("ignore:.*script_method.*:DeprecationWarning")  # PyTorch's own compiler
def test_auto_tries_a_compiled_network_as_it_is(folder, monkeypatch):
    compiled = load_inpainter(folder, steps=1, compile=True, memory_gib=1.2)
    pretend_gpu(compiled, 1)
    seen = count_unet(compiled, monkeypatch)
    for module in (diffusion, micro_batch):
        monkeypatch.setattr(module, "measure", lambda work, device: (work(), (seen[-1] * 2**28, 0.5))[1])
    with torch.compiler.set_stance("force_eager"):
        assert compiled.warm_up((48, 64), 3).micro_batch == 2
        assert seen == [1, 2, 2]
        seen.clear()
        compiled(*scenes(3), generators(0, 1, 2))
    assert seen == [2, 2]


@pytest.mark.filterwarnings("ignore:.*script_method.*:DeprecationWarning")  # PyTorch's own compiler
def test_a_compiled_network_takes_single_images_as_such_where_it_was_made_ready_for_them(folder, monkeypatch):
    compiled = load_inpainter(folder, steps=1, compile=True, micro_batch=8)
    pretend_gpu(compiled, 8)
    seen = count_unet(compiled, monkeypatch)
    with torch.compiler.set_stance("force_eager"):
        for samples in (1, 8):
            compiled.warm_up((48, 64), samples)
        seen.clear()
        for count in (1, 3, 8):
            compiled(*scenes(count), generators(*range(count)))
    assert seen == [1, 8, 8]


@pytest.mark.parametrize("scheduler", ["ddim", "lcm"])
def test_latents_are_not_clipped_whatever_the_pipelines_scheduler_says(folder, copy, scheduler):
    """As one saved by DDPMScheduler says without a word of its maker's; latents reach far beyond -1..1."""
    change(copy / "scheduler" / "scheduler_config.json", clip_sample=True)
    clipped, expected = (load_inpainter(path, steps=2, scheduler=scheduler) for path in (copy, folder))
    right, inpaint_mask = scenes(1)
    assert torch.equal(clipped(right, inpaint_mask, generators(0)), expected(right, inpaint_mask, generators(0)))


def test_a_loaded_pipeline_travels_to_other_processes(folder, tmp_path):
    """By its name: a fork server takes few of the hundreds of files of shared memory that its weights would be."""
    loaded = load_inpainter(folder, steps=2, dtype="bf16", micro_batch=3)
    again = pickle.loads(pickle.dumps(loaded))
    assert (again.network, again.device) == (loaded.network, loaded.device)
    assert torch.equal(again(*scenes(1), generators(0)), loaded(*scenes(1), generators(0)))
    pipeline = DiffusionNetwork(str(folder), steps=1)
    stream = ZeroStereoStream(photo_tar(tmp_path / "photos.tar", 2), size=(64, 96), depth=layered_depth, inpaint=pipeline)
    plain = [pair.right for pair in stream]  # it has loaded the pipeline by now
    stream.set_epoch(0)
    pairs = DataLoader(stream, batch_size=None, num_workers=1, multiprocessing_context="forkserver")
    assert torch.equal(torch.stack([pair.right for pair in pairs]), torch.stack(plain))


def test_no_samples_are_no_work(inpainter):
    right, inpaint_mask = scenes(1)
    assert inpainter(right[:0], inpaint_mask[:0], []).shape == (0, 3, 48, 64)


def test_a_configured_network_is_an_argument_of_the_stream(folder):
    network = DiffusionNetwork(str(folder), steps=2, scheduler="dpm++", dtype="bf16")
    assert pickle.loads(pickle.dumps(network)) == network and json.loads(json.dumps(asdict(network)))["steps"] == 2
    inpainter = load_inpainter(network)
    assert (inpainter.network, inpainter.scheduler, inpainter.dtype) == (network, "DPMSolverMultistepScheduler", torch.bfloat16)
    for takes_none in (network, "builtin", inpainter):
        with pytest.raises(TypeError, match="steps"):
            load_inpainter(takes_none, steps=3)


def test_a_missing_package_is_named_with_its_cure(folder, monkeypatch):
    for package in ("diffusers", "transformers"):
        with monkeypatch.context() as patch, pytest.raises(ImportError, match=r'pip install "zsdata\[diffusion\]"'):
            patch.setitem(sys.modules, package, None)
            load_inpainter(folder)


@pytest.mark.parametrize("part", ["unet", "vae", "text_encoder", "tokenizer", "scheduler"])
def test_a_missing_part_is_named(copy, part):
    shutil.rmtree(copy / part)
    with pytest.raises(FileNotFoundError, match=f"lacks {part}/"):
        load_inpainter(copy)


@pytest.mark.parametrize("part", ["unet", "vae", "text_encoder"])
def test_pickled_weights_are_refused(copy, part):
    safe = next((copy / part).glob("*.safetensors"))
    torch.save(load_file(safe), safe.with_name("pytorch_model.bin" if part == "text_encoder" else "diffusion_pytorch_model.bin"))
    safe.rename(safe.with_name("of_something_else.safetensors"))
    with pytest.raises(OSError, match=rf"{part} cannot be loaded.*pickled .bin weights are refused"):
        load_inpainter(copy)
    safe.with_name("of_something_else.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match=rf'{part}" holds no weights in safetensors \(pickled'):
        load_inpainter(copy)


@pytest.mark.parametrize("part", ["unet", "vae", "text_encoder"])
def test_damaged_and_incomplete_weights_are_named(copy, part):
    path = next((copy / part).glob("*.safetensors"))
    weights = load_file(path)
    gone = sorted(weights)[0]
    del weights[gone]
    save_file(weights, path, metadata={"format": "pt"})
    with pytest.raises((ValueError, OSError), match=re.escape(gone)):  # older diffusers find it themselves
        load_inpainter(copy)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(OSError, match=f"{part} cannot be loaded"):
        load_inpainter(copy)


def test_a_plain_text_to_image_unet_is_refused(copy):
    small_unet(4).save_pretrained(copy / "unet")
    with pytest.raises(ValueError, match=r"no inpainting model: its U-Net takes 4 channels and gives 4, inpainting takes 9"):
        load_inpainter(copy)


@pytest.mark.parametrize("condition", [{"time_cond_proj_dim": 8}, {"class_embed_type": "timestep"}, {"addition_embed_type": "text"}])
def test_a_unet_that_wants_more_than_a_prompt_is_refused(copy, condition):
    change(copy / "unet" / "config.json", **condition)
    with pytest.raises(ValueError, match=rf"wants more than the empty prompt \({next(iter(condition))}"):
        load_inpainter(copy)


def test_weights_of_another_size_are_named(copy):
    change(copy / "unet" / "config.json", block_out_channels=[16, 16, 16])
    with pytest.raises(OSError, match="unet cannot be loaded"):
        load_inpainter(copy)


def test_weights_in_half_precision_alone_are_found_and_no_other_ones_are_missed(copy, inpainter, caplog):
    for part in ("unet", "vae", "text_encoder"):
        path = next((copy / part).glob("*.safetensors"))
        save_file({name: weight.half() for name, weight in load_file(path).items()}, path, metadata={"format": "pt"})
        path.rename(path.with_name(path.name.replace(".safetensors", ".fp16.safetensors")))
    right, inpaint_mask = scenes(1)
    logger = logging.getLogger("diffusers")  # hands nothing on to the root
    logger.addHandler(caplog.handler)
    made = load_inpainter(copy, steps=3)(right, inpaint_mask, generators(0))
    logger.removeHandler(caplog.handler)
    assert not caplog.records
    assert 0 < (made - inpainter(right, inpaint_mask, generators(0))).abs().mean() < 1


def test_a_tokenizer_without_its_vocabulary_is_refused(copy):
    for name in ("vocab.json", "merges.txt"):
        (copy / "tokenizer" / name).unlink()
    with pytest.raises((ValueError, OSError), match=r"tokenizer (knows \d words|cannot be loaded)"):
        load_inpainter(copy)


def test_a_folder_has_no_revisions(copy):
    with pytest.raises(ValueError, match=r'is a folder, which has no revisions; got revision="v9"'):
        load_inpainter(copy, revision="v9")


def test_an_autoencoder_of_another_latent_space_is_refused(folder, tmp_path):
    tiny_autoencoder(halvings=1).save_pretrained(tmp_path)
    with pytest.raises(ValueError, match=r"makes 4 channels of 2x2 pixels; .* are 4 channels of 8x8"):
        load_inpainter(folder, autoencoder=str(tmp_path))
    with pytest.raises(ValueError, match="is a UNet2DConditionModel; an autoencoder here is one of"):
        load_inpainter(folder, autoencoder=str(folder / "unet"))
    shutil.copytree(folder / "vae", tmp_path / "vae")
    change(tmp_path / "vae" / "config.json", scaling_factor=0.13025)
    with pytest.raises(ValueError, match=r"vae has scaling_factor 0\.13025: its latents are those of another model"):
        load_inpainter(folder, autoencoder=str(tmp_path / "vae"))


def test_a_text_encoder_of_another_pipeline_is_refused(copy):
    text = transformers.CLIPTextConfig(vocab_size=4, hidden_size=8, intermediate_size=16, num_hidden_layers=1, num_attention_heads=2)
    transformers.CLIPTextModel(text).save_pretrained(copy / "text_encoder")
    with pytest.raises(ValueError, match="the text encoder gives 8 channels, the U-Net takes 16"):
        load_inpainter(copy)


def test_a_name_that_is_nowhere_is_said(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        load_inpainter(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"steps": 0}, "steps is 1 or more; got 0"),
        ({"steps": 1001}, "cannot make 1001 steps"),
        ({"steps": 600}, "cannot make 600 steps: the first would stand at 600 of 1000"),
        ({"scheduler": "lcm", "steps": 51}, "cannot make 51 steps: .*take another number of steps"),
        ({"dtype": "int8"}, "got int8"),
        ({"micro_batch": 0}, 'micro_batch is 1 or more, or "auto"; got 0'),
        ({"micro_batch": "all"}, "got 'all'"),
        ({"compile": "fast"}, "compile is True, False or one of default, reduce-overhead"),
        ({"memory_gib": 0}, "memory_gib is more than 0; got 0"),
        ({"scheduler": "fastest"}, 'got "fastest"'),
        ({"scheduler": "NoScheduler"}, 'got "NoScheduler"'),
        ({"scheduler": "FlowMatchEulerDiscreteScheduler"}, "another kind of model"),
        ({"scheduler": "RePaintScheduler"}, "another kind of model"),
        ({"scheduler": "DDIMInverseScheduler"}, "another kind of model"),
        ({"scheduler": "CogVideoXDDIMScheduler"}, "another kind of model"),
    ],
)
def test_bad_options_are_refused(folder, options, message):
    with pytest.raises(ValueError, match=message):
        load_inpainter(folder, **options)


def test_bad_inputs_are_refused(inpainter):
    right, inpaint_mask = scenes(2)
    with pytest.raises(ValueError, match=r"right must be \[B, 3, H, W\]; got \[2, 1, 48, 64\]"):
        inpainter(right[:, :1], inpaint_mask, generators(0, 1))
    with pytest.raises(ValueError, match=r"inpaint_mask must be bool \[2, 1, 48, 64\]; got torch.float32"):
        inpainter(right, inpaint_mask.float(), generators(0, 1))
    with pytest.raises(ValueError, match="2 samples, 1 generators"):
        inpainter(right, inpaint_mask, generators(0))
    with pytest.raises(ValueError, match=r"noise must be \[2, 4, 6, 8\].*got \[2, 4, 48, 64\]"):
        inpainter.inpaint_from_noise(right, inpaint_mask, torch.zeros(2, 4, 48, 64))
