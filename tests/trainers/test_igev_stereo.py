from __future__ import annotations

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from tests import oracles_igev_stereo as oracles
from tests.published import published_values, published_weights
from trainers.models import igev_stereo as module
from trainers.models import load_checkpoint, load_matcher
from trainers.models.cost_volume import expected_disparity, groupwise_correlation
from trainers.models.geometry_encoding import geometry_encoding
from trainers.models.igev_stereo import FeaturePyramid, upsample
from trainers.models.mobilenet import MobileNetV2, load_imagenet_weights

SMALL = {"hidden_dims": (16, 16, 16), "corr_radius": 2, "max_disp": 32}


@pytest.fixture(scope="module")
def published():
    matcher = load_matcher("igev_stereo").eval()
    matcher.load_state_dict(published_weights("igev_stereo"), strict=True)
    return matcher, published_values("input"), published_values("igev_stereo")


@pytest.fixture(scope="module")
def small():
    return load_matcher("igev_stereo", **SMALL).eval()


def small_pair(batch: int = 1, size: tuple[int, int] = (32, 64)) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    left, right = torch.rand(2, batch, 3, *size, generator=generator) * 255
    return left, right


def test_every_published_prediction_is_reproduced(published):
    matcher, images, expected = published
    with torch.no_grad():
        initial, sequence = matcher(images["left"], images["right"], iterations=4)
    torch.testing.assert_close(initial, expected["initial"], atol=1e-3, rtol=0)
    torch.testing.assert_close(torch.stack(sequence), expected["predictions"], atol=1e-3, rtol=0)
    torch.testing.assert_close(matcher.predict(images["left"], images["right"], iterations=4), expected["final"], atol=1e-3, rtol=0)


@pytest.mark.parametrize("prefix", ["module.", ""])
def test_a_published_checkpoint_loads(tmp_path, prefix):
    weights = published_weights("igev_stereo")
    torch.save({prefix + name: tensor for name, tensor in weights.items()}, tmp_path / "published.pth")
    matcher = load_matcher("igev_stereo")
    load_checkpoint(matcher, tmp_path / "published.pth")
    assert torch.equal(matcher.state_dict()["cost_agg.agg_0.1.conv.weight"], weights["cost_agg.agg_0.1.conv.weight"])


@pytest.mark.parametrize("layers", [1, 2, 3])
def test_the_names_do_not_depend_on_how_many_gru_levels_are_used(layers):
    """Published checkpoints hold encoders and GRUs of all levels, whatever the option."""
    names = {name for name in load_matcher("igev_stereo", n_gru_layers=layers).state_dict() if "context_zqr_convs" not in name}
    assert names == {name for name in published_weights("igev_stereo") if "context_zqr_convs" not in name}


def test_the_cost_volume_is_that_of_plain_loops_also_when_it_reaches_beyond_the_image():
    left, right = np.random.default_rng(0).standard_normal((2, 2, 6, 3, 5)).astype(np.float32)
    volume = groupwise_correlation(torch.from_numpy(left), torch.from_numpy(right), disparities=8, groups=2)
    assert volume.shape == (2, 2, 8, 3, 5)
    for b in range(2):
        np.testing.assert_allclose(volume[b], oracles.groupwise_correlation(left[b], right[b], disparities=8, groups=2), atol=1e-4)


@pytest.mark.parametrize(("levels", "radius"), [(1, 1), (2, 4), (3, 2)])
def test_a_geometry_lookup_is_that_of_plain_loops(levels, radius):
    rng = np.random.default_rng(0)
    volume = rng.standard_normal((2, 3, 7, 3, 9)).astype(np.float32)
    left, right = rng.standard_normal((2, 2, 5, 3, 9)).astype(np.float32)
    disparity = rng.uniform(-3, 12, (2, 3, 9)).astype(np.float32)
    disparity[0, 0, :4] = [0, 6, 7, -1]
    lookup = geometry_encoding(*map(torch.from_numpy, (volume, left, right)), levels, radius)
    found = lookup(torch.from_numpy(disparity)[:, None])
    for b in range(2):
        expected = oracles.geometry_encoding(volume[b], left[b], right[b], disparity[b], levels, radius)
        np.testing.assert_allclose(found[b], expected, atol=1e-4)


def test_the_gradients_of_a_geometry_lookup_are_those_of_finite_differences():
    rng = np.random.default_rng(0)
    inputs = [torch.from_numpy(rng.standard_normal(shape)).requires_grad_() for shape in ((1, 2, 4, 2, 5), (1, 3, 2, 5), (1, 3, 2, 5))]
    disparity = torch.from_numpy(rng.uniform(0, 4, (1, 1, 2, 5)))
    assert torch.autograd.gradcheck(lambda *inputs: geometry_encoding(*inputs, levels=2, radius=1)(disparity), inputs)


def test_the_upsampling_is_that_of_plain_loops():
    rng = np.random.default_rng(0)
    disparity = rng.uniform(0, 40, (2, 1, 3, 5)).astype(np.float32)
    logits = rng.standard_normal((2, 9, 12, 20)).astype(np.float32)
    fine = upsample(torch.from_numpy(disparity), torch.from_numpy(logits))
    for b in range(2):
        np.testing.assert_allclose(fine[b, 0], oracles.context_upsample(disparity[b, 0], logits[b], 4), atol=1e-4)


def test_the_initial_disparity_is_the_mean_of_the_softmax():
    scores = np.random.default_rng(0).uniform(-8, 8, (2, 12, 3, 5)).astype(np.float32)
    disparity = expected_disparity(torch.from_numpy(scores))
    for b in range(2):
        np.testing.assert_allclose(disparity[b, 0], oracles.expected_disparity(scores[b]), atol=1e-4)


OPTIONS = [
    {},
    {"n_gru_layers": 1},
    {"n_gru_layers": 2, "slow_fast_gru": True},
    {"slow_fast_gru": True, "hidden_dims": (8, 16, 24), "corr_levels": 3},
]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_every_trainable_parameter_gets_a_gradient(options):
    """Distributed training stops at a parameter without one."""
    matcher = load_matcher("igev_stereo", **{**SMALL, **options})
    matcher.freeze_bn()
    initial, sequence = matcher(*small_pair(batch=2), iterations=2)
    assert [tuple(prediction.shape) for prediction in (initial, *sequence)] == [(2, 1, 32, 64)] * 3
    (initial.abs().mean() + torch.stack(sequence).abs().mean()).backward()
    for name, parameter in matcher.named_parameters():
        assert (parameter.grad is not None) == parameter.requires_grad, name


def test_slow_fast_updates_the_coarse_levels_more_often():
    matcher = load_matcher("igev_stereo", slow_fast_gru=True, **SMALL)
    calls = []
    for gru in ("gru04", "gru08", "gru16"):
        matcher.update_block.get_submodule(gru).register_forward_pre_hook(lambda *_, gru=gru: calls.append(gru))
    matcher(*small_pair(), iterations=1)
    assert calls == ["gru16", "gru16", "gru08", "gru16", "gru08", "gru04"]


def test_no_gradient_flows_from_one_iteration_to_the_next_through_the_disparity(small):
    seen = []
    hook = small.update_block.encoder.register_forward_pre_hook(lambda _, args: seen.append(args[0].requires_grad))
    small(*small_pair(), iterations=3)
    hook.remove()
    assert seen == [False] * 3


def test_the_backbone_loads_timms_imagenet_weights(tmp_path):
    """Stages 3 and 4 have the same resolution, and share a block here."""
    backbone = FeaturePyramid()
    before = backbone.state_dict()["deconv32_16.conv1.conv.weight"].clone()
    timm = {"blocks.6.0.conv_pw.weight": torch.zeros(960, 160, 1, 1), "conv_head.weight": torch.zeros(1280, 320, 1, 1)}
    stages = {"block0.0": 0, "block1.0": 1, "block2.0": 2, "block3.0": 3, "block3.1": 4, "block4.0": 5}
    for name, tensor in MobileNetV2().state_dict().items():
        prefix, _, rest = name.partition(".")
        number, _, rest = rest.partition(".")
        timm[f"blocks.{stages[f'{prefix}.{number}']}.{rest}" if prefix.startswith("block") else name] = torch.rand_like(tensor.float())
    save_file(timm, tmp_path / "mobilenet.safetensors")
    load_imagenet_weights(backbone, tmp_path / "mobilenet.safetensors")
    state = backbone.state_dict()
    assert torch.equal(state["conv_stem.weight"], timm["conv_stem.weight"])
    assert torch.equal(state["bn1.running_var"], timm["bn1.running_var"])
    assert torch.equal(state["block0.0.0.conv_dw.weight"], timm["blocks.0.0.conv_dw.weight"])
    assert torch.equal(state["block3.1.2.conv_pwl.weight"], timm["blocks.4.2.conv_pwl.weight"])
    assert torch.equal(state["block4.0.1.bn3.bias"], timm["blocks.5.1.bn3.bias"])
    assert torch.equal(state["deconv32_16.conv1.conv.weight"], before)


def test_weights_of_another_backbone_are_refused_and_change_nothing(tmp_path):
    backbone = MobileNetV2()
    before = {name: tensor.clone() for name, tensor in backbone.state_dict().items()}
    save_file({"conv_stem.weight": torch.zeros(32, 3, 3, 3), "layer1.0.weight": torch.zeros(1)}, tmp_path / "other.safetensors")
    message = r"other.safetensors is no mobilenetv2_100 of timm \(missing: bn1.weight \[32\], .* and \d+ more; left over: layer1.0.weight\)"
    with pytest.raises(ValueError, match=message):
        load_imagenet_weights(backbone, tmp_path / "other.safetensors")
    assert all(torch.equal(tensor, before[name]) for name, tensor in backbone.state_dict().items())


def test_fresh_weights_with_frozen_norms_pass_the_image_through_the_backbone(small):
    """With norms that do not normalise, nothing else keeps the features from dying out."""
    with torch.no_grad():
        for features in small.feature(2 * small_pair(size=(128, 128))[0] / 255 - 1):
            assert 0.1 < features.std() < 10


def test_predict_pads_any_size_as_the_published_evaluation_does(small):
    left, right = small_pair(batch=2, size=(37, 71))
    prediction = small.predict(left, right, iterations=2)
    padded = [nn.functional.pad(image, (12, 13, 13, 14), mode="replicate") for image in (left, right)]
    with torch.no_grad():
        _, sequence = small(*padded, iterations=2)
    assert prediction.shape == (2, 1, 37, 71)
    assert torch.equal(prediction, sequence[-1][..., 13:50, 12:83])


def test_predict_upsamples_once_and_leaves_the_mode_as_it_was(monkeypatch):
    matcher = load_matcher("igev_stereo", **SMALL).train()
    calls = []
    monkeypatch.setattr(module, "upsample", lambda *args: calls.append(1) or upsample(*args))
    statistics = {name: value.clone() for name, value in matcher.named_buffers()}
    prediction = matcher.predict(*small_pair(), iterations=3)
    assert len(calls) == 1 and matcher.training and not prediction.requires_grad
    assert all(torch.equal(value, statistics[name]) for name, value in matcher.named_buffers())


def test_frozen_are_the_batch_norms_of_images_and_not_those_of_volumes():
    """As published: volumes have no pre-trained statistics."""
    matcher = load_matcher("igev_stereo", **SMALL)
    matcher.freeze_bn()
    matcher.train()
    before = {name: value.clone() for name, value in matcher.named_buffers() if name.endswith("running_mean")}
    matcher(*small_pair(), iterations=1)
    of_images = {name: isinstance(matcher.get_submodule(name.removesuffix(".running_mean")), nn.BatchNorm2d) for name in before}
    for name, value in matcher.named_buffers():
        if name in before:
            assert torch.equal(value, before[name]) == of_images[name], name
    assert set(of_images.values()) == {True, False}


def test_mixed_precision_matches_and_predicts_in_float32(published, monkeypatch):
    matcher, images, expected = published
    seen = []

    def correlate(left, right, *args):
        seen.append((left.dtype, right.dtype))
        return groupwise_correlation(left, right, *args)

    def encode(volume, left, right, *args):
        lookup = geometry_encoding(volume, left, right, *args)
        seen.append((volume.dtype, left.dtype, right.dtype))
        return lambda disparity: seen.append((disparity.dtype, lookup(disparity).dtype)) or lookup(disparity)

    monkeypatch.setattr(module, "groupwise_correlation", correlate)
    monkeypatch.setattr(matcher, "encode_geometry", encode)
    with torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16):
        initial, sequence = matcher(images["left"], images["right"], iterations=2)
    assert len(seen) == 4 and {dtype for dtypes in seen for dtype in dtypes} == {torch.float32}
    assert all(prediction.dtype == torch.float32 for prediction in (initial, *sequence))
    assert (initial - expected["initial"]).abs().mean() < 0.1
    assert (sequence[-1] - expected["predictions"][1]).abs().mean() < 0.1


def test_one_pair_of_a_batch_does_not_depend_on_the_others(small):
    left, right = small_pair(batch=3)
    torch.testing.assert_close(small.predict(left, right, 2)[1:2], small.predict(left[1:2], right[1:2], 2), atol=1e-3, rtol=0)


def test_unfit_images_are_refused_with_the_way_out(small):
    with pytest.raises(ValueError, match=r"multiples of 32; got 30 x 64.*predict"):
        small(*small_pair(size=(30, 64)))
    with pytest.raises(ValueError, match="iterations is at least 1; got 0"):
        small(*small_pair(), iterations=0)
    with pytest.raises(ValueError, match="at least 64 px wide; got 32"):
        load_matcher("igev_stereo", **{**SMALL, "corr_levels": 5, "max_disp": 64})(*small_pair(size=(32, 32)))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"corr_implementation": "reg"}, TypeError, "no option corr_implementation; it has hidden_dims, corr_levels"),
        ({"n_gru_layers": 4}, ValueError, "n_gru_layers"),
        ({"n_downsample": 3}, ValueError, "n_downsample is one of 2; got 3"),
        ({"hidden_dims": (128, 128)}, ValueError, "hidden_dims"),
        ({"corr_levels": 0}, ValueError, "corr_levels"),
        ({"max_disp": 200}, ValueError, "max_disp is a multiple of 32; got 200"),
        ({"max_disp": 32, "corr_levels": 5}, ValueError, "max_disp 32 is too small for 5 corr_levels, which need 64"),
    ],
)
def test_unknown_options_are_refused_with_the_choices(options, error, message):
    with pytest.raises(error, match=message):
        load_matcher("igev_stereo", **options)
