"""Compiled, channel after channel, in half precision: faster, and the same matcher."""

from __future__ import annotations

import shutil

import pytest
import torch
from torch import nn

from trainers.models import load_matcher

TINY = {
    "raft_stereo": {
        "hidden_dims": (8, 8, 8),
        "n_gru_layers": 2,
        "slow_fast_gru": True,
        "corr_levels": 2,
        "corr_radius": 1,
        "n_downsample": 3,
    },
    "igev_stereo": {"hidden_dims": (8, 8, 8), "n_gru_layers": 1, "corr_radius": 1, "max_disp": 32},
}
pytestmark = pytest.mark.filterwarnings("ignore")  # the compiler stumbles over its own warnings where they are errors
needs_a_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("g++", "clang++", "c++"))), reason="torch.compile needs a C++ compiler on the CPU"
)


def two_alike(name: str, **options) -> list[nn.Module]:
    torch.manual_seed(0)
    matchers = [load_matcher(name, **{**TINY[name], **options}) for _ in range(2)]
    matchers[1].load_state_dict(matchers[0].state_dict())
    return [matcher.eval() for matcher in matchers]  # batch statistics of so small volumes would blow up every rounding


def pair(size: tuple[int, int] = (32, 64)) -> tuple[torch.Tensor, torch.Tensor]:
    left, right = torch.rand(2, 1, 3, *size, generator=torch.Generator().manual_seed(0)) * 255
    return left, right


def predictions_and_gradient(matcher: nn.Module, iterations: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    matcher.zero_grad()
    initial, sequence = matcher(*pair(), iterations=iterations)
    predictions = torch.cat([*([] if initial is None else [initial]), *sequence])
    predictions.abs().mean().backward()
    return predictions.detach(), torch.cat([p.grad.flatten() for p in matcher.parameters() if p.grad is not None])


def assert_alike(plain: nn.Module, fast: nn.Module) -> None:
    (expected, gradient), (found, found_gradient) = predictions_and_gradient(plain), predictions_and_gradient(fast)
    torch.testing.assert_close(found, expected, atol=1e-3, rtol=1e-4)
    assert (found_gradient - gradient).norm() < 1e-2 * gradient.norm()  # its kinks turn roundings into steps


def test_the_parts_of_raft_stereo_are_captured_whole_and_once_for_all_iterations():
    from torch._dynamo.backends.debugging import aot_eager

    graphs = []
    plain, compiled = two_alike("raft_stereo", shared_backbone=True)
    compiled.compile_parts(backend=lambda graph, inputs: graphs.append(graph) or aot_eager(graph, inputs))
    assert_alike(plain, compiled)
    captured = len(graphs)
    assert captured <= 6, "encoders, lookup, update and upsampling; and the first update apart"
    compiled(*pair(), iterations=6)
    assert len(graphs) == captured


@pytest.mark.parametrize("parts", [("_update", "_upsample", "_upsample_initial"), pytest.param(None, marks=pytest.mark.slow)])
def test_the_parts_of_igev_stereo_are_captured_whole(monkeypatch, parts):
    plain, compiled = two_alike("igev_stereo")
    monkeypatch.setattr(type(compiled), "PARTS", parts or type(compiled).PARTS)
    compiled.compile_parts(backend="aot_eager")
    assert_alike(plain, compiled)


@needs_a_compiler
def test_a_part_compiled_for_the_cpu_computes_the_same(monkeypatch):
    """One part of the smallest matcher; all of them below, in minutes."""
    plain, compiled = two_alike("raft_stereo", corr_implementation="alt")
    monkeypatch.setattr(type(compiled), "PARTS", ("_upsample",))
    compiled.compile_parts()
    assert_alike(plain, compiled)


@needs_a_compiler
@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", list(TINY))
def test_a_matcher_compiled_for_the_cpu_computes_the_same(name):
    plain, compiled = two_alike(name)
    compiled.use_channels_last()
    compiled.compile_parts()
    assert_alike(plain, compiled)


def test_a_compiled_matcher_predicts_any_size_without_being_compiled_again():
    graphs = []
    plain, compiled = two_alike("raft_stereo")
    compiled.compile_parts(backend=lambda graph, inputs: graphs.append(graph) or graph.forward)
    for size in ((40, 70), (32, 100), (64, 64)):
        torch.testing.assert_close(compiled.predict(*pair(size), 2), plain.predict(*pair(size), 2))
    assert not graphs


@pytest.mark.parametrize("name", list(TINY))
def test_channels_last_is_how_every_filter_lies_and_changes_no_number(name):
    plain, fast = two_alike(name)
    fast.use_channels_last()
    for module in fast.modules():
        if isinstance(module, nn.Conv2d):
            assert module.weight.is_contiguous(memory_format=torch.channels_last)
        if isinstance(module, nn.Conv3d):
            assert module.weight.is_contiguous(memory_format=torch.channels_last_3d)
    assert_alike(plain, fast)
