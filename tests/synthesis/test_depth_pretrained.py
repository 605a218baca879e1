import warnings

import pytest
import torch

from tests.scenes import grey_fill, photo_tar
from zsdata import ZeroStereoStream, load_depth

transformers = pytest.importorskip("transformers")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A small Depth Anything V2 with random weights, saved by transformers itself in its real format."""
    backbone = transformers.Dinov2Config(
        hidden_size=32, num_hidden_layers=4, num_attention_heads=2, mlp_ratio=2, image_size=70, patch_size=14,
        out_features=["stage1", "stage2", "stage3", "stage4"], reshape_hidden_states=False,
    )  # fmt: skip
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone,
        reassemble_hidden_size=32,
        neck_hidden_sizes=[8, 16, 24, 32],
        fusion_hidden_size=16,
        head_hidden_size=8,
        patch_size=14,
    )
    path = tmp_path_factory.mktemp("depth_anything")
    torch.manual_seed(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        transformers.DepthAnythingForDepthEstimation(config).save_pretrained(path)
    (path / "preprocessor_config.json").write_text(
        '{"image_processor_type": "DPTImageProcessor", "size": {"height": 70, "width": 70}, "keep_aspect_ratio": true,'
        ' "ensure_multiple_of": 14, "image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}'
    )
    return path


def test_a_saved_network_gives_a_finite_map_of_the_photos_size(folder):
    images = torch.rand(2, 3, 90, 131) * 255
    depth = load_depth(folder)(images)
    assert depth.shape == (2, 1, 90, 131) and depth.dtype == torch.float32
    assert torch.isfinite(depth).all() and depth.std() > 0


def test_the_network_sees_what_its_folder_says(folder, monkeypatch):
    depth, seen = load_depth(folder), []
    network = depth._network
    monkeypatch.setattr(depth, "_network", lambda pixel_values: seen.append(pixel_values) or network(pixel_values=pixel_values))
    depth(torch.full((1, 3, 100, 200), 127.5))
    assert seen[0].shape == (1, 3, 70, 140)  # the short side, whole patches, the aspect kept
    expected = (0.5 - torch.tensor([0.485, 0.456, 0.406])) / torch.tensor([0.229, 0.224, 0.225])
    assert torch.allclose(seen[0].mean((0, 2, 3)), expected, atol=1e-4)


def test_a_network_works_in_the_stream(folder, tmp_path):
    tar = photo_tar(tmp_path / "photos.tar", 3)
    pairs = list(ZeroStereoStream(tar, size=(64, 96), depth=folder, inpaint=grey_fill))
    assert len(pairs) == 3 and all(pair.confidence.std() > 0 for pair in pairs)


def test_a_name_that_is_nowhere_is_said(tmp_path):
    with pytest.raises(OSError, match="nowhere"):
        load_depth(tmp_path / "nowhere")
