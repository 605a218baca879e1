from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from tests import oracles_raft_stereo as oracles
from tests.published import published_values, published_weights
from trainers.models import load_matcher
from trainers.models.correlation import correlation_on_demand, correlation_pyramid
from trainers.models.update import convex_upsample

REALTIME = {"shared_backbone": True, "n_downsample": 3, "n_gru_layers": 2, "slow_fast_gru": True}
PUBLISHED = {"raft_stereo": {}, "raft_stereo_realtime": REALTIME}
SMALL = {"hidden_dims": (16, 16, 16), "corr_levels": 2, "corr_radius": 2}


@pytest.fixture(scope="module", params=list(PUBLISHED))
def published(request):
    matcher = load_matcher("raft_stereo", **PUBLISHED[request.param]).eval()
    matcher.load_state_dict(published_weights(request.param), strict=True)
    return matcher, published_values("input"), published_values(request.param)


def small_pair(batch: int = 1, size: tuple[int, int] = (32, 64)) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    left, right = torch.rand(2, batch, 3, *size, generator=generator) * 255
    return left, right


def test_every_published_prediction_is_reproduced(published):
    matcher, images, expected = published
    with torch.no_grad():
        initial, sequence = matcher(images["left"], images["right"], iterations=4)
    assert initial is None and len(sequence) == 4
    for prediction, flow in zip(sequence, expected["predictions"], strict=True):
        torch.testing.assert_close(prediction, -flow, atol=1e-3, rtol=0)
    torch.testing.assert_close(matcher.predict(images["left"], images["right"], iterations=4), -expected["final"], atol=1e-3, rtol=0)


def test_alt_gives_the_numbers_and_the_gradients_of_reg():
    left, right = torch.randn(2, 2, 16, 3, 19, generator=torch.Generator().manual_seed(1)).unbind()
    x = torch.rand(2, 1, 3, 19, generator=torch.Generator().manual_seed(2)) * 30 - 5
    results = []
    for correlate in (correlation_pyramid, correlation_on_demand):
        features = [left.clone().requires_grad_(), right.clone().requires_grad_()]
        found = correlate(*features, levels=3, radius=4)(x)
        (found * torch.linspace(-1, 1, found.numel()).view_as(found)).sum().backward()
        results.append((found, features[0].grad, features[1].grad))
    for reg, alt in zip(*results, strict=True):
        torch.testing.assert_close(alt, reg, atol=1e-5, rtol=1e-5)


def test_alt_keeps_no_more_than_the_features_for_the_backward_pass():
    features = torch.randn(2, 1, 16, 4, 64).unbind()
    kept = {}
    with torch.autograd.graph.saved_tensors_hooks(lambda tensor: kept.setdefault(tensor.data_ptr(), tensor), lambda tensor: tensor):
        left, right = (feature.requires_grad_() for feature in features)
        lookup = correlation_on_demand(left, right, levels=3, radius=4)
        for _ in range(4):
            lookup(torch.zeros(1, 1, 4, 64)).sum()
    assert sum(tensor.numel() for tensor in kept.values()) < 4 * left.numel()


def test_no_gradient_flows_from_one_iteration_to_the_next_through_the_disparity():
    matcher = load_matcher("raft_stereo", **SMALL)
    seen = []
    matcher.update_block.encoder.register_forward_pre_hook(lambda _, args: seen.append(args[0].requires_grad))
    matcher(*small_pair(size=(64, 64)), iterations=3)
    assert seen == [False] * 3


def test_the_whole_matcher_gives_the_same_with_alt():
    matchers = [load_matcher("raft_stereo", corr_implementation=name, **SMALL).eval() for name in ("reg", "alt")]
    matchers[1].load_state_dict(matchers[0].state_dict())
    with torch.no_grad():
        reg, alt = (matcher(*small_pair(), iterations=3)[1] for matcher in matchers)
    for a, b in zip(reg, alt, strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("correlate", [correlation_pyramid, correlation_on_demand])
def test_a_lookup_is_that_of_plain_loops(correlate):
    rng = np.random.default_rng(0)
    left, right = rng.standard_normal((2, 2, 8, 3, 13)).astype(np.float32)
    columns = rng.uniform(-6, 20, (2, 3, 13)).astype(np.float32)
    columns[0, 0, :4] = [0, 12, 13, -1]
    found = correlate(torch.from_numpy(left), torch.from_numpy(right), levels=3, radius=2)(torch.from_numpy(columns)[:, None])
    for b in range(2):
        np.testing.assert_allclose(found[b], oracles.lookup(left[b], right[b], columns[b], levels=3, radius=2), atol=1e-4)


@pytest.mark.parametrize("factor", [4, 8])
def test_the_convex_upsampling_is_that_of_plain_loops(factor):
    rng = np.random.default_rng(0)
    flow = rng.standard_normal((2, 1, 3, 5)).astype(np.float32)
    logits = rng.standard_normal((2, 9 * factor**2, 3, 5)).astype(np.float32)
    fine = convex_upsample(torch.from_numpy(flow), torch.from_numpy(logits), factor)
    for b in range(2):
        np.testing.assert_allclose(fine[b, 0], oracles.convex_upsample(flow[b, 0], logits[b], factor), atol=1e-4)


OPTIONS = [
    {},
    {"n_gru_layers": 1},
    {"n_gru_layers": 2, "slow_fast_gru": True},
    {"slow_fast_gru": True, "context_norm": "group"},
    {"context_norm": "instance", "hidden_dims": (8, 16, 24)},
    {"context_norm": "none", "n_downsample": 3},
    {"shared_backbone": True, "corr_implementation": "alt"},
]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_every_trainable_parameter_gets_a_gradient(options):
    """Distributed training stops at a parameter without one."""
    matcher = load_matcher("raft_stereo", **{**SMALL, **options})
    initial, sequence = matcher(*small_pair(batch=2, size=(64, 64)), iterations=2)
    assert initial is None and [tuple(prediction.shape) for prediction in sequence] == [(2, 1, 64, 64)] * 2
    torch.stack(sequence).abs().mean().backward()
    for name, parameter in matcher.named_parameters():
        assert (parameter.grad is not None) == parameter.requires_grad, name


@pytest.mark.parametrize("layers", [1, 2, 3])
def test_the_names_do_not_depend_on_how_many_gru_levels_are_used(layers):
    """Published checkpoints hold encoders and GRUs of all levels, whatever the option."""
    names = {name for name in load_matcher("raft_stereo", n_gru_layers=layers).state_dict() if "context_zqr_convs" not in name}
    assert names == {name for name in published_weights("raft_stereo") if "context_zqr_convs" not in name}


def test_predict_pads_any_size_as_the_published_evaluation_does():
    matcher = load_matcher("raft_stereo", **SMALL)
    left, right = small_pair(batch=2, size=(37, 71))
    prediction = matcher.predict(left, right, iterations=2)
    padded = [nn.functional.pad(image, (12, 13, 13, 14), mode="replicate") for image in (left, right)]
    with torch.no_grad():
        _, sequence = matcher.eval()(*padded, iterations=2)
    assert prediction.shape == (2, 1, 37, 71)
    assert torch.equal(prediction, sequence[-1][..., 13:50, 12:83])


def test_predict_upsamples_once_and_leaves_the_mode_as_it_was(monkeypatch):
    matcher = load_matcher("raft_stereo", **SMALL).train()
    calls = []
    monkeypatch.setattr("trainers.models.raft_stereo.convex_upsample", lambda *args: calls.append(1) or convex_upsample(*args))
    statistics = {name: value.clone() for name, value in matcher.named_buffers()}
    prediction = matcher.predict(*small_pair(), iterations=3)
    assert len(calls) == 1 and matcher.training and not prediction.requires_grad
    assert all(torch.equal(value, statistics[name]) for name, value in matcher.named_buffers())


def test_frozen_batch_norms_stay_frozen_when_training_goes_on():
    matcher = load_matcher("raft_stereo", **SMALL)
    matcher.freeze_bn()
    matcher.train()
    before = matcher.cnet.norm1.running_mean.clone()
    matcher(*small_pair(), iterations=1)
    assert matcher.training and torch.equal(matcher.cnet.norm1.running_mean, before)
    moving = load_matcher("raft_stereo", **SMALL).train()
    moving(*small_pair(), iterations=1)
    assert not torch.equal(moving.cnet.norm1.running_mean, torch.zeros(64))


def test_mixed_precision_correlates_and_predicts_in_float32(published, monkeypatch):
    matcher, images, expected = published
    seen = []

    def correlate(left, right, levels, radius):
        lookup = correlation_pyramid(left, right, levels, radius)
        return lambda x: seen.append((left.dtype, x.dtype, lookup(x).dtype)) or lookup(x)

    monkeypatch.setattr(matcher, "correlate", correlate)
    with torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16):
        _, sequence = matcher(images["left"], images["right"], iterations=2)
    assert seen == [(torch.float32,) * 3] * 2
    assert all(prediction.dtype == torch.float32 for prediction in sequence)
    assert (sequence[-1] + expected["predictions"][1]).abs().mean() < 0.1


def test_one_pair_of_a_batch_does_not_depend_on_the_others():
    matcher = load_matcher("raft_stereo", **SMALL).eval()
    left, right = small_pair(batch=3)
    torch.testing.assert_close(matcher.predict(left, right, 2)[1:2], matcher.predict(left[1:2], right[1:2], 2), atol=1e-3, rtol=0)


def test_unfit_images_are_refused_with_the_way_out():
    matcher = load_matcher("raft_stereo", **SMALL)
    with pytest.raises(ValueError, match=r"multiples of 32; got 30 x 64.*predict"):
        matcher(*small_pair(size=(30, 64)))
    with pytest.raises(ValueError, match=r"\[1, 3, 32, 64\] and \[1, 3, 32, 32\]"):
        matcher(torch.zeros(1, 3, 32, 64), torch.zeros(1, 3, 32, 32))
    with pytest.raises(ValueError, match="at least 1"):
        matcher(*small_pair(), iterations=0)
    with pytest.raises(ValueError, match="at least 64 px wide; got 32"):
        load_matcher("raft_stereo", n_downsample=3)(*small_pair(size=(32, 32)))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"n_layers": 3}, TypeError, "no option n_layers; it has hidden_dims, corr_implementation"),
        ({"corr_implementation": "cuda"}, ValueError, "corr_implementation is one of 'reg', 'alt'; got 'cuda'"),
        ({"context_norm": "layer"}, ValueError, "context_norm"),
        ({"n_gru_layers": 4}, ValueError, "n_gru_layers"),
        ({"n_downsample": 1}, ValueError, "n_downsample"),
        ({"hidden_dims": (128, 128)}, ValueError, "hidden_dims"),
        ({"corr_levels": 0}, ValueError, "corr_levels"),
    ],
)
def test_unknown_options_are_refused_with_the_choices(options, error, message):
    with pytest.raises(error, match=message):
        load_matcher("raft_stereo", **options)


def test_an_unknown_matcher_is_refused_with_the_choices():
    with pytest.raises(ValueError, match=r"'raft'.*raft_stereo"):
        load_matcher("raft")
