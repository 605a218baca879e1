from __future__ import annotations

import sys

import numpy as np
import pytest
import torch

from trainers.models import load_matcher, save_checkpoint
from trainers.predictors import find_predictor, foreign_predictor

SMALL = {"hidden_dims": (16, 16, 16), "corr_levels": 2, "corr_radius": 2, "n_gru_layers": 1}

FOREIGN = """
import numpy as np
import torch

A_NUMBER = 7
seen = []

def by_torch(left, right):
    seen.append((left, right))
    return left[:, 0] / 8

def by_numpy(left, right):
    seen.append((left, right))
    return left[..., 0].astype(np.float64) / 8

def flow(left, right):
    return -left[:, 0] - 1

def pair(left, right):
    return None, [left[:, :1]]

def half_size(left, right):
    return left[:, :1, ::2, ::2]

def broken(left, right):
    raise KeyError("weights")

def full(left, right):
    raise torch.OutOfMemoryError("no memory left")

class Network(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.scale = torch.nn.Parameter(torch.tensor(0.125))

    def forward(self, left, right):
        seen.append(self.training)
        return self.scale * left[:, :1]

class Zoo:
    network = Network()
"""


@pytest.fixture
def foreign(tmp_path, monkeypatch):
    """A module `their_matchers` in the current folder."""
    (tmp_path / "their_matchers.py").write_text(FOREIGN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    yield "their_matchers"
    sys.modules.pop("their_matchers", None)


def images():
    rng = np.random.default_rng(0)
    arrays = [rng.integers(8, 256, (20, 33, 3), dtype=np.uint8) for _ in range(2)]
    return arrays, [torch.from_numpy(array).permute(2, 0, 1)[None].float() for array in arrays]


def test_a_model_of_somebody_else_gets_tensors(foreign):
    _, (left, right) = images()
    disparity = foreign_predictor(f"{foreign}:by_torch")(left, right)
    assert torch.equal(disparity, left[:, :1] / 8) and disparity.shape == (1, 1, 20, 33)
    assert torch.equal(sys.modules[foreign].seen[0][1], right)


def test_a_model_of_somebody_else_may_take_arrays(foreign):
    arrays, tensors = images()
    disparity = foreign_predictor(f"{foreign}:by_numpy", takes="numpy")(*tensors)
    assert disparity.dtype == torch.float32 and torch.equal(disparity, tensors[0][:, :1] / 8)
    for given, array in zip(sys.modules[foreign].seen[0], arrays, strict=True):
        assert given.dtype == np.uint8
        np.testing.assert_array_equal(given, array)


def test_a_network_is_judged_in_evaluation_mode_and_without_gradients(foreign):
    _, (left, right) = images()
    disparity = foreign_predictor(f"{foreign}:Zoo.network")(left, right)
    assert sys.modules[foreign].seen == [False] and not disparity.requires_grad
    assert torch.equal(disparity, left[:, :1] / 8)


@pytest.mark.parametrize(
    ("path", "error", "message"),
    [
        ("raff", ValueError, "raft, igev, sgbm, or package.module:callable; got 'raff'"),
        ("their_matchers:", ValueError, "package.module:callable"),
        (":by_torch", ValueError, "package.module:callable"),
        ("no.such_module:predict", ImportError, "cannot import no.such_module from here .*No module named 'no'"),
        ("their_matchers:by_tensorflow", ImportError, "their_matchers has no by_tensorflow; to call there is .*by_numpy, by_torch"),
        ("their_matchers:A_NUMBER", TypeError, "their_matchers:A_NUMBER is a int; name a function"),
        ("their_matchers:Network", TypeError, "is the class Network; name a function or an object"),
    ],
)
def test_a_path_that_leads_to_no_callable_is_said_in_words(foreign, path, error, message):
    with pytest.raises(error, match=message):
        find_predictor(path)


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("flow", ValueError, r"their_matchers:flow returned no disparity above 0; .*minus the horizontal flow"),
        ("pair", TypeError, "returned a tuple; a disparity is one tensor or array"),
        ("half_size", ValueError, r"returned \[1, 1, 10, 17\] for images of \[20, 33\]"),
        ("broken", RuntimeError, r"their_matchers:broken failed on images of 33 x 20 px: KeyError\('weights'\)"),
        ("full", torch.OutOfMemoryError, "no memory left"),
    ],
)
def test_an_answer_that_is_no_disparity_is_said_in_words(foreign, name, error, message):
    with pytest.raises(error, match=message):
        find_predictor(f"{foreign}:{name}")(*images()[1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"model": "raft"}, "--model raft needs --checkpoint"),
        ({"model": "sgbm", "checkpoint": "x.pth"}, "sgbm has no weights of ours"),
        ({"model": "some:model", "options": {"corr_levels": 2}}, "some:model has no weights of ours"),
        ({"model": "sgbm", "mixed_precision": "bf16"}, "sgbm is no network: leave out --mixed-precision"),
        ({"model": "some:model", "takes": "jax"}, "a model takes torch or numpy; got jax"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        find_predictor(**options)


def test_mixed_precision_and_strips_reach_the_network(tmp_path):
    matcher = load_matcher("raft_stereo", **SMALL)
    save_checkpoint(matcher, tmp_path / "weights.safetensors")
    dtypes, heights = [], []
    left, right = (torch.rand(1, 3, 288, 64) * 255 for _ in range(2))

    def watch(module, inputs, output):
        dtypes.append(output.dtype)
        heights.append(inputs[0].shape[-2])

    hook = torch.nn.modules.module.register_module_forward_hook(
        lambda module, inputs, output: watch(module, inputs, output) if isinstance(module, torch.nn.Conv2d) else None
    )
    try:
        common = {"checkpoint": tmp_path / "weights.safetensors", "options": SMALL, "iterations": 1}
        mixed = find_predictor("raft", mixed_precision="bf16", **common)(left, right)
        assert set(dtypes) == {torch.bfloat16} and mixed.dtype == torch.float32 and heights[0] == 288
        dtypes.clear(), heights.clear()
        find_predictor("raft", tile_rows=256, **common)(left, right)
        assert set(dtypes) == {torch.float32} and max(heights) == 256
    finally:
        hook.remove()
