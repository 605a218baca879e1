import json
import logging
import math
import os
import pickle
import re
import shutil
import subprocess
import sys
import types
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save_file

from tests.scenes import grey_fill, photo, photo_tar
from zsdata import ZeroStereoStream, load_depth
from zsdata.synthesis.confidence import normalize_inverse_depth
from zsdata.synthesis.depth import pretrained
from zsdata.synthesis.depth.identity import depth_identity
from zsdata.synthesis.depth.options import DepthNetwork
from zsdata.synthesis.depth.pretrained import SMALLEST_DEPTH_M, _predicts, load_preprocessing

transformers = pytest.importorskip("transformers")
small = pytest.importorskip("tests.small_depth_networks")

PREDICT_DEPTH = {"metric_depth_anything", "dinov2_dpt", "glpn", "zoe"}
HALVES = ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
PIL_PROCESSORS = {"DPTImageProcessor", "GLPNImageProcessor", "ZoeDepthImageProcessor"}  # the others need torchvision


@pytest.fixture(scope="session")
def folders(tmp_path_factory):
    """A folder of each kind of network, saved when it is first asked for."""
    root, saved = tmp_path_factory.mktemp("networks"), {}
    return lambda kind: saved.setdefault(kind, None) or saved.update({kind: small.save_small_network(kind, root / kind)}) or saved[kind]


@pytest.fixture(scope="session")
def folder(folders):
    return folders("depth_anything")


@pytest.fixture
def copy(folder, tmp_path):
    """A Depth Anything in a folder of its own, to be changed."""
    return shutil.copytree(folder, tmp_path / "copy")


def photos(count, height=90, width=131, first_seed=0):
    """float32 [B, 3, H, W], whole numbers 0..255."""
    made = [torch.from_numpy(photo(first_seed + seed, height, width)).permute(2, 0, 1) for seed in range(count)]
    return torch.stack(made).float()


def change(folder, name, **values):
    path = folder / name
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def inverted(metres):
    """1 / depth, where the nearest thousandth of the pixels is no nearer than the next one."""
    sorted_metres = metres.flatten().sort().values
    return 1 / metres.clamp(min=max(SMALLEST_DEPTH_M, float(sorted_metres[math.ceil(len(sorted_metres) / 1000)])))


@pytest.mark.parametrize("dtype", ["float32", "bf16"])
@pytest.mark.parametrize("kind", small.NETWORKS)
def test_every_kind_of_network_gives_a_finite_map_of_the_photos_size(folders, kind, dtype):
    images = photos(2)
    depth = load_depth(folders(kind), dtype=dtype)(images)
    assert depth.shape == (2, 1, 90, 131) and depth.dtype == torch.float32
    assert torch.isfinite(depth).all() and depth.std() > 0 and not torch.equal(depth[0], depth[1])


@pytest.mark.parametrize(
    ("kind", "height", "width"),
    [
        ("depth_anything", 90, 131),
        ("metric_depth_anything", 160, 100),
        ("midas_vit", 90, 131),
        ("midas_hybrid", 90, 131),
        ("midas_beit", 90, 131),
        ("midas_swin", 90, 131),
        ("dinov2_dpt", 84, 126),  # where the size is right already: transformers pads or cuts where this resizes
        ("glpn", 96, 128),
        ("zoe", 90, 131),
    ],
)
@pytest.mark.skipif(not hasattr(transformers, "DPTImageProcessorPil"), reason="its image processors need torchvision")
def test_the_result_is_that_of_transformers_own_processor_and_model(folders, kind, height, width):
    path, image = folders(kind), photo(0, height, width)
    processor = getattr(transformers, f"{small.NETWORKS[kind][1]}Pil").from_pretrained(path)
    network = transformers.AutoModelForDepthEstimation.from_pretrained(path).eval()
    depth = load_depth(path)
    pixels = processor(images=[image], return_tensors="pt")["pixel_values"].float()
    tensor = torch.from_numpy(image).permute(2, 0, 1)[None]
    difference = pixels - depth.preprocessing.normalise(depth.prepare(tensor))
    levels = difference * torch.tensor(depth.preprocessing.std).view(3, 1, 1) / depth.preprocessing.rescale
    assert levels.abs().max() < 1.001  # PIL rounds a few pixels to the neighbouring grey level; ZoeDepth's does not round
    assert levels.abs().mean() < (0.3 if kind == "zoe" else 0.01)
    with torch.no_grad():
        predicted = network(pixel_values=pixels).predicted_depth
    inverse = inverted(predicted) if kind in PREDICT_DEPTH else predicted
    rows, columns = (int(math.sqrt(side / 2) * 3) if kind == "zoe" else 0 for side in (height, width))
    expected = F.interpolate(inverse[None], (height + 2 * rows, width + 2 * columns), mode="bilinear")
    expected = expected[..., rows : rows + height, columns : columns + width]
    assert (depth(tensor.float()) - expected).abs().max() < 0.02 * (expected.max() - expected.min())


needs_depth_pro = pytest.mark.skipif("depth_pro" not in small.NETWORKS, reason="needs transformers 4.49")


@needs_depth_pro
def test_depth_pro_is_given_its_square_and_not_inverted(folders):
    """transformers turns Depth Pro's prediction, which is inverse depth, into depth only after the network."""
    path, images = folders("depth_pro"), photos(1)
    network = transformers.AutoModelForDepthEstimation.from_pretrained(path).eval()
    with torch.no_grad():
        predicted = network(pixel_values=F.interpolate(images, (56, 56), mode="bilinear") / 127.5 - 1).predicted_depth
    expected = F.interpolate(predicted[None], (90, 131), mode="bilinear")
    assert (load_depth(path)(images) - expected).abs().max() < 0.02 * (expected.max() - expected.min())


@pytest.mark.skipif("chmv2" not in small.NETWORKS, reason="needs a newer transformers")
def test_chmv2_sees_what_its_image_processor_does_by_default(folders):
    preprocessing = load_preprocessing(DepthNetwork(str(folders("chmv2"))))
    assert preprocessing.input_size(90, 131) == (96, 128)
    assert (preprocessing.mean, preprocessing.std, preprocessing.mode) == ((0.42, 0.411, 0.296), (0.213, 0.156, 0.143), "bicubic")


@pytest.mark.skipif("prompt_depth_anything" not in small.REFUSED, reason="needs a newer transformers")
@pytest.mark.parametrize("predicts", [None, "depth"])
def test_a_network_that_wants_more_than_the_photo_is_refused(folders, predicts):
    """Without a depth map to go by, Prompt Depth Anything predicts 0 to 1 from the nearest point to the farthest."""
    with pytest.raises(ValueError, match="prompt_depth_anything network, which wants a depth map beside the photo; take one that"):
        load_preprocessing(DepthNetwork(str(folders("prompt_depth_anything")), predicts=predicts))


@pytest.mark.parametrize(("options", "factor"), [({}, 1 / 255), ({"rescale_factor": 1 / 127.5}, 1 / 127.5), ({"do_rescale": False}, 1.0)])
def test_grey_levels_are_rescaled_as_the_folder_says(copy, options, factor):
    change(copy, "preprocessor_config.json", image_mean=[1.0, 2.0, 3.0], image_std=[0.5, 1.0, 2.0], **options)
    made = load_preprocessing(DepthNetwork(str(copy))).normalise(torch.full((1, 3, 1, 1), 204, dtype=torch.uint8))
    expected = [(204 * factor - mean) / std for mean, std in ((1.0, 0.5), (2.0, 1.0), (3.0, 2.0))]
    assert torch.allclose(made.flatten(), torch.tensor(expected))


def test_the_network_sees_what_its_folder_says(folder, monkeypatch):
    depth, seen = load_depth(folder), []
    network = depth._network
    monkeypatch.setattr(depth, "_network", lambda pixel_values: seen.append(pixel_values) or network(pixel_values=pixel_values))
    depth(torch.full((1, 3, 100, 200), 128.0))
    assert seen[0].shape == (1, 3, 70, 140)  # the short side, whole patches, the aspect kept
    expected = (128 / 255 - torch.tensor([0.485, 0.456, 0.406])) / torch.tensor([0.229, 0.224, 0.225])
    assert torch.allclose(seen[0].mean((0, 2, 3)), expected, atol=1e-4)


@pytest.mark.parametrize(
    ("resolution", "size", "expected"),
    [
        (None, (90, 131), (70, 98)),
        (None, (290, 200), (98, 70)),
        (None, (30, 40), (70, 98)),  # small photos grow
        (140, (90, 131), (140, 210)),
        (150, (1000, 1000), (154, 154)),
        ("native", (90, 131), (84, 126)),
        ("native", (5, 700), (14, 700)),
    ],
)
def test_the_resolution_is_a_short_side_in_whole_patches(folder, resolution, size, expected):
    assert load_preprocessing(DepthNetwork(str(folder), resolution)).input_size(*size) == expected
    assert load_depth(folder, resolution=resolution).prepare(torch.zeros(1, 3, *size)).shape[-2:] == expected


def test_networks_that_take_squares_get_squares(folders):
    assert load_depth(folders("midas_vit"), resolution=96).prepare(photos(1)).shape[-2:] == (96, 96)
    assert load_depth(folders("midas_vit"), resolution=96)(photos(1)).shape == (1, 1, 90, 131)
    with pytest.raises(ValueError, match='takes squares alone: resolution is a number of pixels or None; got "native"'):
        load_depth(folders("midas_vit"), resolution="native")


@pytest.mark.parametrize(("kind", "side"), [pytest.param("depth_pro", 56, marks=needs_depth_pro), ("midas_hybrid", 64)])
@pytest.mark.parametrize("resolution", [112, "native"])
def test_networks_that_take_one_size_are_given_no_other(folders, kind, side, resolution):
    with pytest.raises(ValueError, match=f"takes {side}x{side} pixels and nothing else; got resolution={resolution!r}"):
        load_preprocessing(DepthNetwork(str(folders(kind)), resolution))
    assert load_preprocessing(DepthNetwork(str(folders(kind)), side)).input_size(90, 131) == (side, side)


@pytest.mark.parametrize("kind", small.NETWORKS)
def test_the_mirrored_photos_input_is_the_mirror_image(folders, kind):
    prepare = load_preprocessing(DepthNetwork(str(folders(kind)))).prepare
    images = photos(2, 91, 130)
    there, back = prepare(images), prepare(images.flip(-1)).flip(-1)
    assert there.dtype == torch.uint8
    if kind in ("zoe", "depth_pro"):  # resized without smoothing, in float32, where halves may be rounded either way
        assert (there.int() - back.int()).abs().max() <= 1
    else:
        assert torch.equal(there, back)


def test_photo_and_mirrored_photo_go_together_and_give_what_each_gives(folder):
    images, depth = photos(3), load_depth(folder)
    one, mirrored = depth.with_mirrored(images)
    assert torch.equal(one, depth(images))
    assert torch.equal(mirrored, depth(images.flip(-1)).flip(-1))
    assert (one - mirrored).abs().max() > 0.01


def test_the_two_halves_in_two_places_are_the_whole(folder):
    """What a worker prepares and sends, predicted elsewhere, photos of many sizes together."""
    depth = load_depth(folder)
    preprocessing = pickle.loads(pickle.dumps(load_preprocessing(DepthNetwork(str(folder)))))
    sizes = [(90, 131), (131, 90), (90, 131), (64, 64), (92, 132)]
    images = [photos(1, *size, first_seed=seed) for seed, size in enumerate(sizes)]
    inputs = [preprocessing.prepare(image.to(torch.uint8)) for image in images]
    assert inputs[0].shape == inputs[4].shape
    made = list(depth.predict_mirrored(inputs, sizes))
    for image, (one, mirrored) in zip(images, made, strict=True):
        expected = depth.with_mirrored(image)
        assert torch.equal(one, expected[0]) and torch.equal(mirrored, expected[1])
    with pytest.raises(ValueError, match="one size per photo: 5 inputs, 4 sizes"):
        depth.predict(inputs, sizes[:4])


@pytest.mark.parametrize("kind", ["depth_anything", "midas_swin", "glpn"])
def test_a_photo_does_not_depend_on_the_photos_beside_it(folders, kind):
    images, depth = photos(4), load_depth(folders(kind))
    together = depth(images)
    assert all(torch.equal(depth(images[i : i + 1]), together[i : i + 1]) for i in range(4))
    order = [2, 0]
    assert torch.equal(depth(images[order]), together[order])


def test_micro_batches_hold_photos_of_one_size_as_many_as_fit(folder, monkeypatch):
    depth, seen = load_depth(folder, micro_batch=3), []
    network = depth._network
    monkeypatch.setattr(
        depth, "_network", lambda pixel_values: seen.append(tuple(pixel_values.shape)) or network(pixel_values=pixel_values)
    )
    depth.micro_batch.size = 3  # as on a GPU
    wide, tall = photos(2), photos(1, 131, 90)
    inputs = [depth.prepare(image) for image in (wide[:1], tall, wide[1:])]
    made = list(depth.predict_mirrored(inputs, [(90, 131), (131, 90), (90, 131)]))
    assert seen == [(2, 3, 70, 98), (2, 3, 70, 98), (2, 3, 98, 70)]  # four in two equal parts
    assert torch.allclose(torch.cat([made[0][0], made[2][0]]), load_depth(folder)(wide), rtol=0, atol=1e-4)


def test_memory_that_runs_out_lowers_the_micro_batch_and_then_names_the_cure(folder, monkeypatch, caplog):
    depth = load_depth(folder)
    network, most = depth._network, 2

    def limited(pixel_values):
        if len(pixel_values) > most:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return network(pixel_values=pixel_values)

    monkeypatch.setattr(depth, "_network", limited)
    depth.micro_batch.size = 5
    with caplog.at_level(logging.WARNING, "zsdata"):
        assert depth(photos(5)).shape == (5, 1, 90, 131)
    assert (depth.micro_batch.size, depth.micro_batch.lowered) == (2, 1)
    assert "from now on it takes 2" in caplog.text
    most = 0
    with pytest.raises(MemoryError, match=r"one sample \(depth network\): lower resolution"):
        depth(photos(1))


def test_half_precision_keeps_fine_steps(folder):
    """The last layers stay in float32: depth is not rounded to the 256 steps that bfloat16 has between powers of two."""
    images = photos(1)
    exact, half = load_depth(folder)(images), load_depth(folder, dtype="bf16")(images)
    assert half.dtype == torch.float32 and 0 < (half - exact).abs().mean() < 0.05 * exact.std()
    with torch.autocast("cpu", torch.bfloat16):
        coarse = load_depth(folder)._network(pixel_values=torch.randn(1, 3, 70, 98)).predicted_depth
    fine = load_depth(folder, dtype="bf16")
    steps = next(fine.predict([fine.prepare(images)], [(70, 98)]))
    assert len(coarse.unique()) < 1000 < len(steps.unique())


@pytest.mark.parametrize("kind", small.NETWORKS)
def test_half_precision_keeps_as_many_values_as_float32_in_every_kind_of_network(folders, kind):
    exact, half = (load_depth(folders(kind), dtype=dtype) for dtype in ("float32", "bf16"))
    inputs = exact.prepare(photos(1))
    size = tuple(inputs.shape[-2:])
    exact_values, half_values = (len(next(depth.predict([inputs], [size])).unique()) for depth in (exact, half))
    assert half_values > 0.9 * exact_values


def test_an_autocast_around_it_changes_nothing(folder):
    depth = load_depth(folder)
    with torch.autocast("cpu", torch.bfloat16):
        made = depth(photos(1))
    assert torch.equal(made, depth(photos(1)))


@pytest.mark.filterwarnings("ignore:.*script_method.*:DeprecationWarning")  # PyTorch's own compiler
def test_a_compiled_network_is_used(folder):
    compiled, plain = load_depth(folder, compile=True), load_depth(folder)
    assert compiled._network._compiled_call_impl is not None and plain._network._compiled_call_impl is None
    with torch.compiler.set_stance("force_eager"):
        assert torch.equal(compiled(photos(1)), plain(photos(1)))


def test_photos_are_left_as_they_are(folder):
    images = photos(1)
    before = images.clone()
    load_depth(folder).with_mirrored(images)
    assert torch.equal(images, before)


def test_a_warm_up_runs_the_network_and_says_what_it_takes(folder):
    report = load_depth(folder).warm_up((90, 131))
    assert report.micro_batch == 1 and report.peak_bytes is None and report.seconds > 0
    assert str(report).startswith(f"depth {folder} at 70x98 for 1 photos of 90x131, torch.float32: micro-batch 1, warm after")


def test_a_warm_up_for_few_photos_leaves_the_micro_batch_to_many(folder):
    depth = load_depth(folder)
    depth.micro_batch.size = 8  # as on a GPU
    assert [depth.warm_up((90, 131), photos).micro_batch for photos in (1, 16, None)] == [2, 8, 8] and depth.micro_batch.size == 8


def test_maps_are_brought_to_the_photos_size_one_at_a_time(folder, monkeypatch):
    """Those of a batch of large photos would not fit into memory beside training."""
    depth, restored = load_depth(folder), []
    restore = type(depth.preprocessing).restore
    monkeypatch.setattr(type(depth.preprocessing), "restore", lambda self, *given: restored.append(given) or restore(self, *given))
    grey = depth.prepare(photos(1))
    maps = depth.predict_mirrored([grey] * 3, [(90, 131)] * 3)
    assert not restored
    assert all(
        one.shape == mirrored.shape == (1, 1, 90, 131) and len(restored) == 2 * number for number, (one, mirrored) in enumerate(maps, 1)
    )


def test_a_photo_too_large_for_memory_is_named_with_the_cure(folder, monkeypatch):
    depth = load_depth(folder)

    def restore(self, predicted, size):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(type(depth.preprocessing), "restore", restore)
    with pytest.raises(MemoryError, match=r"cpu has not enough memory for the depth of a photo of 131x90: .*smaller photos"):
        depth(photos(1))


def test_a_loaded_network_travels_to_other_processes(folder, tmp_path):
    """By its name: what libraries hang on a network does not travel."""
    depth = load_depth(folder, dtype="bf16", resolution=56)
    again = pickle.loads(pickle.dumps(depth))
    assert (again.network, again.device) == (depth.network, depth.device) and torch.equal(again(photos(1)), depth(photos(1)))
    tar = photo_tar(tmp_path / "photos.tar", 2)
    stream = ZeroStereoStream(tar, size=(64, 96), depth=load_depth(folder), inpaint=grey_fill)
    with stream.loader(2, num_workers=1, multiprocessing_context="spawn") as loader:
        made = next(iter(loader)).disparity
    assert torch.equal(made, torch.stack([pair.disparity for pair in stream]))


def test_a_network_works_in_the_stream(folder, tmp_path):
    tar = photo_tar(tmp_path / "photos.tar", 3)
    pairs = list(ZeroStereoStream(tar, size=(64, 96), depth=folder, inpaint=grey_fill))
    assert len(pairs) == 3 and all(pair.confidence.std() > 0 for pair in pairs)


def test_a_revision_is_found_in_the_hub_cache_without_network(folder, tmp_path):
    repository = tmp_path / "hub" / "models--somebody--depth"
    shutil.copytree(folder, repository / "snapshots" / ("0" * 40))
    (repository / "refs").mkdir()
    (repository / "refs" / "v1").write_text("0" * 40)
    program = (
        "import torch, zsdata\n"
        "from zsdata.synthesis.depth.identity import depth_identity\n"
        "from zsdata.synthesis.depth.options import DepthNetwork\n"
        'network = DepthNetwork("somebody/depth", "native", revision="v1")\n'
        "assert zsdata.load_depth(network)(torch.rand(1, 3, 28, 42) * 255).shape == (1, 1, 28, 42)\n"
        f'assert depth_identity(network) == "hub somebody/depth {"0" * 40} 3 resolution=native"\n'
        "try:\n"
        '    zsdata.load_depth("somebody/depth")\n'
        "except OSError as error:\n"
        "    assert 'depth=\"somebody/depth\" cannot be loaded' in str(error)\n"
        "else:\n"
        "    raise AssertionError\n"
    )
    offline = {**os.environ, "HF_HOME": str(tmp_path), "HF_HUB_CACHE": str(tmp_path / "hub"), "HF_HUB_OFFLINE": "1"}
    result = subprocess.run([sys.executable, "-c", program], env=offline, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr


def test_a_folder_has_no_revisions(folder, tmp_path):
    tar = photo_tar(tmp_path / "photos.tar", 1)
    message = f"depth=\"{folder}\" is a folder, which has no revisions; got revision='v1'. Leave revision out"
    for use in (load_depth, lambda depth: ZeroStereoStream(tar, depth=depth)):
        with pytest.raises(ValueError, match=message):
            use(DepthNetwork(str(folder), revision="v1"))


def test_the_cache_tells_options_apart(folder):
    plain, native, half = (depth_identity(DepthNetwork(str(folder), **o)) for o in ({}, {"resolution": "native"}, {"dtype": "bf16"}))
    assert plain == depth_identity(folder) and len({plain, native, half}) == 3
    assert depth_identity(DepthNetwork(str(folder), dtype="float32", compile=True, micro_batch=2)) == plain


def test_a_network_computes_in_whole_float32_unless_another_format_is_asked_for(folder, monkeypatch):
    """Wherever it runs: labels from a GPU are those from the workers and of `replay`."""
    kept_whole, networks = [], [load_depth(folder), load_depth(folder, dtype="bf16")]

    @contextmanager
    def recorded(device):
        kept_whole.append(device)
        yield

    monkeypatch.setattr(pretrained, "without_tf32", recorded)
    for depth in networks:
        depth(photos(1))
    assert [depth.dtype for depth in networks] == [torch.float32, torch.bfloat16] and kept_whole == [torch.device("cpu")]


def test_what_is_predicted_is_told_by_the_configuration_or_by_the_user(folder):
    unknown = types.SimpleNamespace(model_type="newest")
    with pytest.raises(ValueError, match=r'is a newest network.*DepthNetwork\("somebody/depth", predicts="depth"\)'):
        _predicts(DepthNetwork("somebody/depth"), unknown)
    images = photos(1, 70, 98)
    near, deep = (load_depth(folder, predicts=said)(images) for said in ("inverse depth", "depth"))
    assert torch.equal(near, load_depth(folder)(images))
    assert torch.allclose(deep, inverted(near))


def test_one_pixel_at_no_distance_changes_nothing_else(folder):
    depth, metres = load_depth(folder, predicts="depth"), torch.linspace(1, 10, 96 * 128).view(1, 96, 128)
    spoilt = metres.clone()
    spoilt[0, 50, 60] = 0
    made = []
    for seen in (metres, spoilt):
        depth._network = lambda pixel_values, seen=seen: types.SimpleNamespace(predicted_depth=seen)
        made.append(normalize_inverse_depth(depth(torch.zeros(1, 3, 96, 128))))
    different = (made[0] - made[1]).abs() > 0.002
    assert different.nonzero().tolist() == [[0, 0, 50, 60]] and made[1][0, 0, 50, 60] == 1


def test_zoe_depth_without_padding_still_aligns_corners(folders, tmp_path):
    path = shutil.copytree(folders("zoe"), tmp_path / "zoe")
    change(path, "preprocessor_config.json", do_pad=False)
    image = photos(1, 90, 131)
    expected = F.interpolate(image, (64, 96), mode="bilinear", align_corners=True)
    prepared = load_preprocessing(DepthNetwork(str(path))).prepare(image)
    assert prepared.shape == expected.shape and (prepared - expected).abs().max() <= 0.5


def test_zoe_depth_resized_by_cubic_curves_stays_within_0_and_255(folders, tmp_path):
    path = shutil.copytree(folders("zoe"), tmp_path / "zoe")
    change(path, "preprocessor_config.json", resample=3)
    checks = torch.zeros(1, 3, 32, 32)
    checks[..., ::3, :] = 255.0
    padded = F.pad(checks, (12, 12, 12, 12), mode="reflect")
    expected = F.interpolate(padded, (64, 64), mode="bicubic", align_corners=True)
    assert expected.min() < -10
    prepared = load_preprocessing(DepthNetwork(str(path))).prepare(checks)
    assert (prepared - expected.clamp(0, 255)).abs().max() <= 0.5


@pytest.mark.parametrize(
    ("kind", "predicts"),
    [
        ("depth_anything", "inverse depth"),
        ("metric_depth_anything", "depth"),
        ("midas_vit", "inverse depth"),
        ("midas_hybrid", "inverse depth"),
        ("dinov2_dpt", "depth"),
        ("glpn", "depth"),
        ("zoe", "depth"),
        ("depth_pro", "inverse depth"),
        ("tipsv2", "depth"),
        ("chmv2", "inverse depth"),  # the height of trees from above
    ],
)
def test_what_each_kind_of_network_predicts_is_known(folders, kind, predicts):
    if kind not in small.NETWORKS:
        pytest.skip("needs a newer transformers")
    assert torch.equal(load_depth(folders(kind))(photos(1)), load_depth(folders(kind), predicts=predicts)(photos(1)))


def of_another_class(folder):
    config = transformers.ViTConfig(hidden_size=8, num_hidden_layers=1, num_attention_heads=1, intermediate_size=8, image_size=16)
    transformers.ViTForImageClassification(config).save_pretrained(folder)


def in_two_files(folder):
    weights = load_file(folder / "model.safetensors")
    (folder / "model.safetensors").unlink()
    save_file(weights, folder / "model-00001-of-00002.safetensors", metadata={"format": "pt"})
    parts = {**dict.fromkeys(weights, "model-00001-of-00002.safetensors"), "head.conv1.weight": "model-00002-of-00002.safetensors"}
    (folder / "model.safetensors.index.json").write_text(json.dumps({"weight_map": parts}))


POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:abc\nsize 99\n"


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda folder: (folder / "model.safetensors").unlink(),
            r"holds no weights: model\.safetensors is missing; download the folder again",
        ),
        (in_two_files, r"lacks model-00002-of-00002\.safetensors, which model\.safetensors\.index\.json names; download it again"),
        (
            lambda folder: (folder / "model.safetensors").write_text(POINTER),
            "is a Git LFS pointer, not the weights; fetch them: git lfs pull",
        ),
        (lambda folder: (folder / "model.safetensors").write_bytes(b""), r"model\.safetensors is empty; download it again"),
        (
            lambda folder: os.truncate(folder / "model.safetensors", 100_000),
            r"is no whole safetensors file \(100,000 bytes: .*\); download it",
        ),
        (lambda folder: (folder / "config.json").write_text("{oops"), r"cannot be loaded: .*config\.json"),
        (lambda folder: (folder / "preprocessor_config.json").unlink(), r"cannot be loaded: .*preprocessor_config\.json"),
        (
            lambda folder: (folder / "preprocessor_config.json").write_text("{oops"),
            r"its preprocessor_config\.json is no JSON .*; download it",
        ),
        (lambda folder: (folder / "preprocessor_config.json").write_text("[]"), r"holds options by name; got \[\]\. Download it again"),
        (lambda folder: change(folder, "config.json", architectures=["DPTForSemanticSegmentation"]), r"is no depth network: .* DPTForSem"),
        (of_another_class, r"is no depth network: its config\.json says vit ViTForImageClassification; name one that"),
    ],
)
def test_a_folder_that_cannot_work_is_refused_as_the_stream_is_made(copy, tmp_path, spoil, message):
    tar = photo_tar(tmp_path / "photos.tar", 1)
    spoil(copy)
    with pytest.raises((OSError, ValueError), match=f'^depth="{copy}".*{message}'):
        ZeroStereoStream(tar, depth=copy)


@pytest.mark.parametrize(
    ("option", "value", "wanted"),
    [
        ("size", {"longest_edge": 70}, "a number of pixels, or height and width"),
        ("size", "big", "a number of pixels, or height and width"),
        ("image_mean", 0.5, "three numbers"),
        ("image_mean", [0.5], "three numbers"),
        ("image_std", [1, 0, 1], "three numbers above 0"),
        ("rescale_factor", "1/255", "a number above 0"),
        ("do_rescale", "no", "true or false"),
        ("resample", [3], "a whole number"),
    ],
)
def test_a_preprocessing_that_makes_no_sense_is_named(copy, option, value, wanted):
    change(copy, "preprocessor_config.json", **{option: value})
    with pytest.raises(
        ValueError, match=rf'^depth="{copy}": {option} in its .* is {wanted}; got {re.escape(repr(value))}\. Download it again'
    ):
        load_preprocessing(DepthNetwork(str(copy)))


def test_a_network_that_chooses_one_domain_for_all_images_is_given_one(folders, tmp_path, monkeypatch):
    """As a GPU would be asked, which takes many at once: a photo's depth must not hang on its neighbours."""
    one_domain, asked, batch = folders("zoe"), [], pretrained.MicroBatch
    monkeypatch.setattr(pretrained, "MicroBatch", lambda what, size, *rest: asked.append(size) or batch(what, size, *rest))
    monkeypatch.setitem(small.NETWORKS, "zoe", (small.zoe_of_two_domains, *small.NETWORKS["zoe"][1:]))
    two_domains = small.save_small_network("zoe", tmp_path / "zoe")
    load_depth(one_domain, micro_batch=4)
    load_depth(two_domains, micro_batch=4)(torch.rand(1, 3, 64, 96) * 255)
    assert asked == [4, 1]


def test_weights_of_another_shape_are_named(copy):
    change(copy, "config.json", head_hidden_size=16)
    with pytest.raises(
        ValueError,  # older transformers find it themselves
        match=r'^depth=".*" (has 3 weights of another shape than its config\.json says, "head\.conv2\.bias"|cannot be loaded: Error)',
    ):
        load_depth(copy)


@pytest.mark.parametrize("depth", [None, 3, ["a"], b"builtin"])
def test_what_is_no_depth_is_said(depth, tmp_path):
    tar = photo_tar(tmp_path / "photos.tar", 1)
    for use in (load_depth, lambda depth: ZeroStereoStream(tar, depth=depth)):
        with pytest.raises(TypeError, match=rf'^depth is "builtin", "stored", a Hub id, .*; got {re.escape(repr(depth))}$'):
            use(depth)


def test_missing_weights_are_named(copy):
    path = copy / "model.safetensors"
    weights = load_file(path)
    gone = next(name for name in sorted(weights) if name.startswith("head"))
    del weights[gone]
    save_file(weights, path, metadata={"format": "pt"})
    with pytest.raises(ValueError, match=f'lacks 1 weights, "{gone}" for one'):
        load_depth(copy)


def test_weights_saved_in_half_precision_are_computed_with_in_float32(copy):
    transformers.AutoModelForDepthEstimation.from_pretrained(copy).half().save_pretrained(copy)
    images = photos(1)
    made = load_depth(copy)(images)
    assert made.dtype == torch.float32 and torch.isfinite(made).all() and made.std() > 0


def test_weights_that_nothing_uses_may_be_missing(copy):
    """Published MiDaS networks lack the first fusion stage's first residual unit."""
    expected, path = load_depth(copy)(photos(1)), copy / "model.safetensors"
    weights = load_file(path)
    kept = {name: value for name, value in weights.items() if "fusion_stage.layers.0.residual_layer1." not in name}
    assert len(kept) < len(weights)
    save_file(kept, path, metadata={"format": "pt"})
    assert torch.equal(load_depth(copy)(photos(1)), expected)


def test_an_unknown_image_processor_is_named(copy):
    change(copy, "preprocessor_config.json", image_processor_type="NewImageProcessor")
    with pytest.raises(ValueError, match="wants its photos prepared by NewImageProcessor; known are those of CHMv2, DPT, DepthPro"):
        load_depth(copy)
    change(copy, "preprocessor_config.json", image_processor_type="DPTImageProcessor", resample=1)
    with pytest.raises(ValueError, match="resizes photos by method 1"):
        load_depth(copy)


def test_what_a_folder_leaves_out_is_what_transformers_would_do(copy):
    (copy / "preprocessor_config.json").write_text('{"image_processor_type": "DPTFeatureExtractor"}')
    prepared = load_preprocessing(DepthNetwork(str(copy)))
    assert (prepared.short_side_px, prepared.multiple_px, prepared.mean, prepared.mode) == (384, 14, (0.5, 0.5, 0.5), "bicubic")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resolution": 0}, 'resolution is the short side in pixels, "native" or None; got 0'),
        ({"resolution": "full"}, "got 'full'"),
        ({"predicts": "disparity"}, "predicts is one of"),
        ({"dtype": "int8"}, "got int8"),
        ({"micro_batch": 0}, "micro_batch is 1 or more; got 0"),
    ],
)
def test_bad_options_are_refused(folder, options, message):
    with pytest.raises(ValueError, match=message):
        load_depth(folder, **options)


def test_options_for_what_takes_none_are_refused(folder):
    for estimator in ("builtin", lambda images: images[:, :1], DepthNetwork(str(folder))):
        with pytest.raises(TypeError, match="resolution"):
            load_depth(estimator, resolution=70)


def test_a_missing_package_is_named_with_its_cure(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(ImportError, match=r'pip install "zsdata\[depth\]"'):
        load_depth(folder)


def test_a_name_that_is_nowhere_is_said(tmp_path):
    with pytest.raises(OSError, match="nowhere"):
        load_depth(tmp_path / "nowhere")


def test_no_global_random_number_is_drawn(folder):
    before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    load_depth(Path(folder))(photos(1))
    assert torch.equal(torch.get_rng_state(), before[0]) and np.array_equal(np.random.get_state()[1], before[1])  # noqa: NPY002
