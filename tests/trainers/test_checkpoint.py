from __future__ import annotations

import pytest
import torch
from safetensors.torch import save_file

from tests.published import published_weights
from trainers.models import load_checkpoint, load_matcher, save_checkpoint

SMALL = {"hidden_dims": (16, 16, 16), "corr_levels": 2, "corr_radius": 2}


def small_matcher(**options):
    return load_matcher("raft_stereo", **{**SMALL, **options})


def assert_same_weights(matcher, weights):
    state = matcher.state_dict()
    assert state.keys() == weights.keys()
    assert all(torch.equal(state[name], weights[name]) for name in state)


@pytest.mark.parametrize("prefix", ["module.", ""])
def test_a_published_checkpoint_loads(tmp_path, prefix):
    weights = published_weights("raft_stereo")
    torch.save({prefix + name: tensor for name, tensor in weights.items()}, tmp_path / "published.pth")
    matcher = load_matcher("raft_stereo")
    load_checkpoint(matcher, tmp_path / "published.pth")
    assert torch.equal(matcher.state_dict()["fnet.conv2.weight"], weights["fnet.conv2.weight"])


def test_what_was_saved_comes_back(tmp_path):
    saved, loaded = small_matcher(), small_matcher()
    save_checkpoint(saved, tmp_path / "model.safetensors")
    load_checkpoint(loaded, tmp_path / "model.safetensors")
    assert_same_weights(loaded, saved.state_dict())


def test_a_file_that_keeps_one_name_of_a_shared_tensor_loads(tmp_path):
    saved, loaded = small_matcher(), small_matcher()
    weights = {name: tensor.clone() for name, tensor in saved.state_dict().items() if ".norm3." not in name}
    assert len(weights) < len(saved.state_dict())
    save_file(weights, tmp_path / "model.safetensors")
    load_checkpoint(loaded, tmp_path / "model.safetensors")
    assert_same_weights(loaded, saved.state_dict())


def test_a_checkpoint_of_other_options_is_refused_and_changes_nothing(tmp_path):
    save_checkpoint(small_matcher(n_gru_layers=2, shared_backbone=True, n_downsample=3), tmp_path / "other.safetensors")
    matcher = small_matcher()
    before = {name: tensor.clone() for name, tensor in matcher.state_dict().items()}
    with pytest.raises(ValueError, match="does not fit RAFTStereo") as error:
        load_checkpoint(matcher, tmp_path / "other.safetensors")
    message = str(error.value)
    assert "missing: context_zqr_convs.2.weight" in message
    assert "left over: conv2.0.conv1" in message
    assert "update_block.mask.2.weight [576, 256, 1, 1] instead of [144, 256, 1, 1]" in message
    assert_same_weights(matcher, before)


def test_a_checkpoint_that_holds_more_than_the_matcher_is_refused_in_words(tmp_path):
    torch.save({**small_matcher().state_dict(), "fnet.attention": torch.zeros(3)}, tmp_path / "more.pth")
    with pytest.raises(ValueError, match=r"does not fit RAFTStereo .*\(1 left over: fnet.attention\)"):
        load_checkpoint(small_matcher(), tmp_path / "more.pth")


def test_what_is_no_checkpoint_is_named(tmp_path):
    matcher = small_matcher()
    with pytest.raises(FileNotFoundError, match=r"none\.pth"):
        load_checkpoint(matcher, tmp_path / "none.pth")
    (tmp_path / "weights.onnx").write_bytes(b"")
    with pytest.raises(ValueError, match=r"\.safetensors or \.pth"):
        load_checkpoint(matcher, tmp_path / "weights.onnx")
    torch.save({"epoch": 3, "weights": {}}, tmp_path / "training.pth")
    with pytest.raises(ValueError, match="dictionary of tensors"):
        load_checkpoint(matcher, tmp_path / "training.pth")


@pytest.mark.parametrize("name", ["model.safetensors", "model.pth"])
def test_a_file_cut_short_is_refused(tmp_path, name):
    matcher = small_matcher()
    if name.endswith(".pth"):
        torch.save(matcher.state_dict(), tmp_path / name)
    else:
        save_checkpoint(matcher, tmp_path / name)
    for kept in (0.5, 0.0):
        content = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(content[: int(len(content) * kept)])
        with pytest.raises(ValueError, match=name):
            load_checkpoint(matcher, tmp_path / name)


def test_code_in_a_checkpoint_does_not_run(tmp_path):
    class Payload:
        def __reduce__(self):
            return (open, (str(tmp_path / "written"), "w"))

    torch.save({"weight": Payload()}, tmp_path / "evil.pth")
    with pytest.raises(ValueError, match="holds more than tensors"):
        load_checkpoint(small_matcher(), tmp_path / "evil.pth")
    assert not (tmp_path / "written").exists()
