import json
import os
import shutil
import subprocess
import sys

import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.scenes import grey_fill, layered_depth, photo, photo_tar, png, write_tar
from zsdata import QualityGate, ZeroStereoStream, load_depth
from zsdata.licences import NonCommercialModel
from zsdata.synthesis.depth import DepthNetwork
from zsdata.synthesis.depth.pretrained import PretrainedDepth
from zsdata.synthesis.inpaint import DiffusionNetwork
from zsdata.synthesis.micro_batch import GIB, WarmUp

small = pytest.importorskip("tests.small_depth_networks")

SIZE = (64, 96)
ALL_PASS = QualityGate(max_hole_share=1, min_visible_share=0, min_depth_range=0, min_flip_consistency=0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return small.save_small_network("depth_anything", tmp_path_factory.mktemp("networks") / "depth_anything")


@pytest.fixture(scope="module")
def tar(tmp_path_factory):
    return photo_tar(tmp_path_factory.mktemp("tar") / "photos.tar", 6)


def batches(stream, workers=2):
    with stream.loader(3, num_workers=workers) as loader:
        return list(loader)


@pytest.mark.parametrize("options", [{}, {"views_per_image": 2}, {"depth_resolution": 70}], ids=str)
def test_a_network_gives_the_same_labels_in_the_workers_and_on_the_device(folder, tar, tmp_path, options):
    def run(**placement):
        return batches(ZeroStereoStream(tar, size=SIZE, depth=folder, inpaint=grey_fill, **options, **placement))

    in_workers, on_device = run(depth_placement="worker"), run(depth_placement="device")
    cached = [run(depth_placement="device", depth_cache=tmp_path) for _ in range(2)][-1]
    assert len(in_workers) == len(on_device) == len(cached) == 2 * options.get("views_per_image", 1)
    for one, *others in zip(in_workers, on_device, cached, strict=True):
        for other in others:
            assert [meta["index"] for meta in one.meta] == [meta["index"] for meta in other.meta]
            assert torch.allclose(one.disparity, other.disparity, atol=1e-4) and torch.allclose(one.confidence, other.confidence, atol=1e-2)
            for mask, other_mask in zip(one.masks, other.masks, strict=True):
                assert (mask != other_mask).float().mean() <= 0.001


@pytest.mark.parametrize("batch_size", [2, 3, 8])
@pytest.mark.parametrize("workers", [0, 1])
def test_the_views_of_a_photo_cost_one_estimate_on_the_device_whatever_batches_cut_through_them(
    folder, tar, monkeypatch, batch_size, workers
):
    images, run = [], PretrainedDepth._run
    monkeypatch.setattr(PretrainedDepth, "_run", lambda self, inputs: images.append(len(inputs)) or run(self, inputs))
    stream = ZeroStereoStream(
        tar, size=SIZE, depth=folder, inpaint=grey_fill, views_per_image=8, depth_placement="device", quality=ALL_PASS
    )
    with stream.loader(batch_size, num_workers=workers) as loader:
        assert len(list(loader)) == 6 * 8 // batch_size
    assert sum(images) == 6 * 2  # photos, each with its mirror image


def test_the_resolution_reaches_the_network(folder, tar):
    coarse, fine = (next(iter(ZeroStereoStream(tar, size=SIZE, depth=folder, depth_resolution=side))) for side in (42, 140))
    assert not torch.equal(coarse.disparity, fine.disparity)
    whole = ZeroStereoStream(tar, size=SIZE, depth=DepthNetwork(str(folder), resolution=42))
    assert torch.equal(next(iter(whole)).disparity, coarse.disparity)
    with pytest.raises(ValueError, match="depth_resolution belongs to a network"):
        ZeroStereoStream(tar, depth=layered_depth, depth_resolution=42)


@pytest.mark.parametrize("placement", ["worker", "device"])
@pytest.mark.parametrize("loaded", [False, True])
def test_a_strip_is_counted_before_a_network_sees_it(folder, tmp_path, placement, loaded):
    sizes = [(64, 256), (64, 257), (400, 64), (64, 64)]
    tar = write_tar(tmp_path / "strips.tar", {f"{i}.png": png(photo(i, *size)) for i, size in enumerate(sizes)})
    depth = load_depth(folder) if loaded else folder
    with ZeroStereoStream(tar, size=SIZE, depth=depth, inpaint=grey_fill, depth_placement=placement).loader(1, num_workers=1) as loader:
        used = {sample["key"] for batch in loader for sample in batch.meta}
        assert used == {"0", "3"}
        assert loader.stats()["rejected"] == {"too long for the depth network": 2}


@pytest.mark.parametrize("placement", ["worker", "device"])
def test_depth_that_is_not_finite_names_the_sample_and_the_cure(folder, tar, tmp_path, placement):
    spoilt = shutil.copytree(folder, tmp_path / "spoilt")
    weights = load_file(spoilt / "model.safetensors")
    save_file(
        {**weights, "head.conv1.bias": weights["head.conv1.bias"] * torch.nan}, spoilt / "model.safetensors", metadata={"format": "pt"}
    )
    stream = ZeroStereoStream(tar, size=SIZE, depth=spoilt, inpaint=grey_fill, depth_placement=placement)
    message = r"sample \d of epoch 0 \(.*photos\.tar\) failed: inverse depth must be finite.*float32"
    with pytest.raises(RuntimeError, match=message), stream.loader(3) as loader:
        next(iter(loader))


def test_a_network_that_fails_on_the_device_names_its_photos(folder, tar, monkeypatch):
    stream = ZeroStereoStream(tar, size=SIZE, depth=folder, inpaint=grey_fill, depth_placement="device")
    with stream.loader(3) as loader:
        monkeypatch.setattr(PretrainedDepth, "_run", lambda self, inputs: inputs.nonsense)
        with pytest.raises(RuntimeError, match=r'"00000\d" in .*photos\.tar, "00000\d" in .*photos\.tar, "00000\d" in .*photos\.tar$'):
            next(iter(loader))


def test_a_network_that_takes_squares_sees_strips(tmp_path):
    square = small.save_small_network("midas_vit", tmp_path / "midas_vit")
    tar = write_tar(tmp_path / "strip.tar", {"strip.png": png(photo(0, 64, 400))})
    assert len(list(ZeroStereoStream(tar, size=SIZE, depth=square, inpaint=grey_fill, quality=ALL_PASS))) == 1


def test_a_network_that_is_nowhere_is_an_error_at_once_and_in_words(tar, tmp_path):
    with pytest.raises(FileNotFoundError, match=r'depth="/no/such" is neither "builtin", "stored", a folder that is there, nor a Hub id'):
        ZeroStereoStream(tar, depth="/no/such")
    with pytest.raises((OSError, ValueError), match=r'depth=".*" cannot be loaded'):
        ZeroStereoStream(tar, depth=tmp_path)


def test_a_network_of_the_hub_stays_the_one_that_it_was_when_the_stream_was_made(folder, tar, tmp_path):
    repository, commits = tmp_path / "hub" / "models--somebody--depth", ["a" * 40, "b" * 40]
    for seed, commit in enumerate(commits):
        small.save_small_network("depth_anything", repository / "snapshots" / commit, seed=seed)
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text(commits[0])
    program = f"""
import json, sys
from pathlib import Path
from tests.scenes import grey_fill
from zsdata import ZeroStereoStream

def stream(depth, **options):
    return ZeroStereoStream({str(tar)!r}, size={SIZE}, depth=depth, inpaint=grey_fill, **options)

def disparities(stream):
    with stream.loader(3, num_workers=1) as loader:
        return [batch.disparity.tolist() for batch in loader]

first, cached = stream("somebody/depth"), stream("somebody/depth", depth_cache={str(tmp_path / "cache")!r})
Path({str(repository / "refs" / "main")!r}).write_text({commits[1]!r})
second = stream("somebody/depth")
old, new = (disparities(stream({str(repository / "snapshots")!r} + "/" + commit)) for commit in {commits})
assert disparities(first) == disparities(cached) == old != new == disparities(second)
assert [one.provenance()["depth"][0]["revision"] for one in (first, second)] == {commits}
second.load_state_dict(first.state_dict())
"""
    environment = {**os.environ, "HF_HOME": str(tmp_path), "HF_HUB_CACHE": str(tmp_path / "hub"), "HF_HUB_OFFLINE": "1"}
    result = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=200)
    assert result.returncode == 0, result.stderr


def test_auto_keeps_depth_in_the_workers_where_the_loader_has_no_gpu(folder, tar):
    with ZeroStereoStream(tar, size=SIZE, depth=folder).loader(3, num_workers=1) as loader:
        next(iter(loader))
        assert "prepare" not in loader.stats()["seconds"]


class OnGpu:
    """An estimator that says it is on a GPU, as a network does that was loaded there; counts its calls in this process."""

    device, calls = torch.device("cuda", 0), 0

    def __call__(self, images):
        self.calls += 1
        return layered_depth(images)


def test_a_network_that_was_loaded_onto_a_gpu_stays_out_of_the_workers(tar):
    depth = OnGpu()
    with ZeroStereoStream(tar, size=SIZE, depth=depth, inpaint=grey_fill).loader(3, num_workers=1) as loader:
        next(iter(loader))
    assert depth.calls > 0
    with pytest.raises(
        ValueError, match=r'the network that was given is on cuda:0; load it onto the CPU \(load_depth\(\.\.\., device="cpu"\)\)'
    ):
        ZeroStereoStream(tar, size=SIZE, depth=depth, depth_placement="worker")


def test_options_that_change_no_picture_do_not_change_the_place(folder, tar):
    state = ZeroStereoStream(tar, size=SIZE, depth=DepthNetwork(str(folder), micro_batch=2)).state_dict()
    ZeroStereoStream(tar, size=SIZE, depth=DepthNetwork(str(folder), dtype="float32", micro_batch=16)).load_state_dict(state)
    for changed in ({"resolution": 42}, {"dtype": "bf16"}):
        with pytest.raises(ValueError, match="configuration"):
            ZeroStereoStream(tar, size=SIZE, depth=DepthNetwork(str(folder), **changed)).load_state_dict(state)


@pytest.mark.parametrize(("options", "loader", "samples"), [({}, {}, 8), ({"reuse": 3}, {}, 4), ({}, {"micro_batch": 2}, 2)])
def test_networks_are_warmed_up_for_the_pairs_that_a_batch_has_and_say_so(tar, capsys, options, loader, samples):
    """On a pretended device: torch's "meta" has no memory and computes nothing."""

    class Inpainter:
        def warm_up(self, size, most):
            return WarmUp(f"inpainting {most} pairs at {size}", most, 3 * GIB, GIB, 0.5)

        def __call__(self, right, inpaint_mask, generators):
            return right

    stream = ZeroStereoStream(tar, size=SIZE, depth=layered_depth, inpaint=Inpainter(), epoch_size=16, **options)
    stream.loader(8, device="meta", **loader)
    assert capsys.readouterr().err.splitlines() == [
        f"zsdata on meta: inpainting {samples} pairs at (64, 128): micro-batch {samples}, peak memory 3.00 GiB, warm after 0.5 s",
        "zsdata on meta: the stream takes at most 3.00 GiB beside training",
    ]
    stream.loader(8, device="meta", rank=1, world_size=2, **loader)
    assert capsys.readouterr().err == ""  # once for all ranks


def test_loaded_networks_count_by_their_options(folder, tar):
    def configuration(**options):
        return ZeroStereoStream(tar, size=SIZE, depth=load_depth(folder, **options)).provenance()["configuration"]

    assert configuration() == configuration(micro_batch=2) != configuration(resolution=42)


def test_provenance_names_the_models_with_their_licences(folder, tar):
    (folder / "README.md").write_text("---\nlicense: apache-2.0\n---\n# a card\n")
    stream = ZeroStereoStream(
        tar, size=SIZE, depth=folder, inpaint=DiffusionNetwork("Windsrain/ZeroStereo", subfolder="StereoGen", steps=4)
    )
    record = stream.provenance()
    assert json.loads(json.dumps(record)) == record
    assert record["depth"] == [{"id": str(folder), "revision": None, "licence": "apache-2.0"}]
    assert record["inpaint"][0]["id"] == "Windsrain/ZeroStereo" and record["inpaint"][0]["licence"] == "mit"
    builtin = ZeroStereoStream(tar, depth=layered_depth).provenance()
    assert builtin["inpaint"] == [{"id": "builtin", "revision": None, "licence": "apache-2.0"}]


@pytest.mark.parametrize("argument", ["depth", "inpaint"])
def test_a_commercial_user_is_kept_from_non_commercial_models(tar, argument):
    model = {"depth": "depth-anything/Depth-Anything-V2-Large-hf", "inpaint": "stabilityai/sd-turbo"}[argument]
    options = {"depth": layered_depth, argument: model}
    ZeroStereoStream(tar, depth=layered_depth, commercial_safe=True)
    with pytest.raises(NonCommercialModel, match=r"commercial_safe is set\. Take "):
        ZeroStereoStream(tar, commercial_safe=True, **options)
