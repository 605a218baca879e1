import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.hub_cache import COMMITS, run_offline, save_to_hub
from tests.scenes import grey_fill, layered_depth, photo, photo_tar, png, write_tar
from tests.small_pipeline import save_small_pipeline
from tests.source.http_server import ScriptedServer
from zsdata import QualityGate, ZeroStereoStream, load_depth
from zsdata.licences import NonCommercialModel
from zsdata.source import http_ranges
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
    main = save_to_hub(tmp_path, "somebody/depth", lambda number, path: small.save_small_network("depth_anything", path, seed=number))
    program = f"""
import json, sys
from pathlib import Path
from tests.scenes import grey_fill
from zsdata import DepthNetwork, ZeroStereoStream

def stream(depth, **options):
    return ZeroStereoStream({str(tar)!r}, size={SIZE}, depth=depth, inpaint=grey_fill, **options)

def disparities(stream):
    with stream.loader(3, num_workers=1) as loader:
        return [batch.disparity.tolist() for batch in loader]

first, cached = stream("somebody/depth"), stream("somebody/depth", depth_cache={str(tmp_path / "cache")!r})
Path({str(main)!r}).write_text({COMMITS[1]!r})
second = stream("somebody/depth")
old, new = (disparities(stream({str(main.parents[1] / "snapshots")!r} + "/" + commit)) for commit in {COMMITS})
assert disparities(first) == disparities(cached) == old != new == disparities(second)
assert [one.provenance()["depth"][0]["revision"] for one in (first, second)] == {COMMITS}
try:
    second.load_state_dict(first.state_dict())
    raise SystemExit("a state of other labels was taken")
except ValueError as error:
    assert "somebody/depth@{COMMITS[0]}" in str(error) and "somebody/depth@{COMMITS[1]}" in str(error), error
for same in (DepthNetwork("somebody/depth", revision={COMMITS[0]!r}), "somebody/depth@{COMMITS[0]}"):
    stream(same).load_state_dict(first.state_dict())
"""
    run_offline(program, tmp_path)


def test_it_is_the_commit_that_is_used_which_must_be_commercial(tar, tmp_path):
    """The Hub may move after the licence was looked at."""

    def save(number, path):
        small.save_small_network("depth_anything", path, seed=number)
        (path / "README.md").write_text(f"---\nlicense: {['mit', 'cc-by-nc-4.0'][number]}\n---\n")

    main = save_to_hub(tmp_path, "somebody/depth", save)
    program = f"""
from pathlib import Path
import zsdata.stream
from zsdata import ZeroStereoStream
from zsdata.licences import NonCommercialModel
from zsdata.source import http_ranges

first = ZeroStereoStream({str(tar)!r}, depth="somebody/depth", commercial_safe=True)
assert first.provenance()["depth"][0]["licence"] == "mit"
read = zsdata.stream.preprocessing_of
zsdata.stream.preprocessing_of = lambda depth: Path({str(main)!r}).write_text({COMMITS[1]!r}) and read(depth)
try:
    ZeroStereoStream({str(tar)!r}, depth="somebody/depth", commercial_safe=True)
    raise SystemExit("a model for non-commercial use was taken")
except NonCommercialModel as error:
    assert "cc-by-nc-4.0" in str(error), error
"""
    run_offline(program, tmp_path)


def test_a_pipeline_of_the_hub_stays_the_one_that_it_was_when_the_stream_was_made(tar, tmp_path):
    pytest.importorskip("diffusers")

    def save(number, path):
        weights = save_small_pipeline(path / "inner") / "unet" / "diffusion_pytorch_model.safetensors"
        save_file({name: weight * (1 + number) for name, weight in load_file(weights).items()}, weights)

    main = save_to_hub(tmp_path, "somebody/pipelines", save)
    program = f"""
from pathlib import Path
import torch
from tests.scenes import layered_depth
from zsdata import DiffusionNetwork, ZeroStereoStream, load_inpainter

def stream(name="somebody/pipelines", **options):
    network = DiffusionNetwork(name, subfolder="inner", steps=1, **options)
    return ZeroStereoStream({str(tar)!r}, size={SIZE}, depth=layered_depth, inpaint=network, epoch_size=2)

first, named = stream(), stream(name="somebody/pipelines@{COMMITS[0]}")
Path({str(main)!r}).write_text({COMMITS[1]!r})
second, again = stream(), stream(revision={COMMITS[0]!r})
made = [next(iter(one)).right for one in (first, second, again)]
assert torch.equal(made[0], made[2]) and not torch.equal(made[0], made[1])
assert [one.provenance()["inpaint"][0]["revision"] for one in (first, second, again)] == {[*COMMITS, COMMITS[0]]}
for key in ("configuration", "models"):
    assert again.state_dict()[key] == first.state_dict()[key] == named.state_dict()[key]
again.load_state_dict(first.state_dict())
loaded = load_inpainter("somebody/pipelines", subfolder="inner", steps=1)
assert loaded.network.revision is None and loaded.pinned.revision == {COMMITS[1]!r}
try:
    second.load_state_dict(first.state_dict())
    raise SystemExit("a state of other pictures was taken")
except ValueError as error:
    assert "'inpaint': 'somebody/pipelines@{COMMITS[0]}'" in str(error), error
"""
    run_offline(program, tmp_path)


def test_a_name_with_a_revision_is_both(tmp_path):
    assert DepthNetwork("owner/name@v1") == DepthNetwork("owner/name", revision="v1")
    assert DiffusionNetwork("owner/name@v1", autoencoder="a/b@v2") == DiffusionNetwork(
        "owner/name", revision="v1", autoencoder="a/b", autoencoder_revision="v2"
    )
    (tmp_path / "at@home").mkdir()
    for path in (str(tmp_path / "at@home"), "/no/such/at@home"):
        assert DepthNetwork(path).name == path
    with pytest.raises(ValueError, match='"owner/name@v1" names a revision, and revision="v2" another'):
        DepthNetwork("owner/name@v1", revision="v2")
    with pytest.raises(ValueError, match="autoencoder_revision belongs to an autoencoder, and none is named"):
        DiffusionNetwork("owner/name", autoencoder_revision="v2")


@pytest.mark.parametrize(
    ("inpaint", "message"),
    [
        ("buildin", '"buildin" is neither a folder nor a Hub id'),
        ("/no/such", '"/no/such" is neither a folder nor a Hub id'),
        ("FOLDER", 'is no inpainting pipeline: it lacks unet/, vae/, .*; ".*/pipeline" may be meant'),
        (DiffusionNetwork("PIPELINE", scheduler="fastest"), 'scheduler is one of .*; got "fastest"'),
        (DiffusionNetwork("PIPELINE", autoencoder="/no/such"), '"/no/such" is neither a folder nor a Hub id'),
        (DiffusionNetwork("PIPELINE", revision="v1"), 'is a folder, which has no revisions; got revision="v1"'),
    ],
    ids=str,
)
def test_an_inpainter_that_cannot_work_is_refused_before_any_photo_is_made(tar, tmp_path, inpaint, message):
    pytest.importorskip("diffusers")
    pipeline = save_small_pipeline(tmp_path / "pipeline")
    for part in ("unet", "vae", "text_encoder"):
        (next((pipeline / part).glob("*.safetensors"))).write_bytes(b"no weights are read")
    if isinstance(inpaint, DiffusionNetwork):
        inpaint = replace(inpaint, name=str(pipeline))
    with pytest.raises((ValueError, OSError), match=message):
        ZeroStereoStream(tar, size=SIZE, depth=layered_depth, inpaint=tmp_path if inpaint == "FOLDER" else inpaint)


def test_shards_that_differ_in_their_query_alone_keep_their_depth_apart(folder, tmp_path, monkeypatch):
    """As data repositories have them, https://host/download?id=1; with the same keys. What is shown of a url has no query."""
    monkeypatch.setenv("ZSDATA_CACHE", str(tmp_path / "indexes"))
    with ScriptedServer() as server:
        urls = []
        for number in range(2):
            tar = write_tar(tmp_path / f"{number}.tar", {f"{key}.png": png(photo(10 * number + key)) for key in range(3)})
            urls.append(server.put(f"download?id={number}", Path(tar).read_bytes()))
        made = [
            [
                batch.disparity
                for batch in batches(ZeroStereoStream(urls, size=SIZE, depth=folder, inpaint=grey_fill, depth_placement=place), 0)
            ]
            for place in ("worker", "device")
        ]
        http_ranges.close_connections()
    assert made[0] and all(torch.allclose(one, other, atol=1e-4) for one, other in zip(*made, strict=True))


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


@pytest.mark.parametrize("size", [SIZE, None])
def test_networks_that_see_whole_photos_are_warmed_up_for_the_largest_of_the_first_ones(tmp_path, capsys, size):
    """On a pretended device, as above. A photo that cannot be used is passed over."""

    class Network:
        def __init__(self, what):
            self.what = what

        def warm_up(self, size, most):
            return WarmUp(f"{self.what} of {most} at {size}", most, 2 * GIB, GIB, 0.5)

        def __call__(self, images, *_):
            return images

    photos = {f"{i}.png": png(photo(i, *shape)) for i, shape in enumerate([(70, 100), (120, 160), (90, 130)])}
    tar = write_tar(tmp_path / "photos.tar", {**photos, "3.png": b"not an image"})
    stream = ZeroStereoStream(tar, size=size, depth=Network("depth"), inpaint=Network("inpainting"), depth_placement="device")
    stream.loader(4 if size else 1, device="meta")
    inpainting, depth, together = capsys.readouterr().err.splitlines()
    pairs, seen = (4, (64, 128)) if size else (1, (120, 192))  # of what the crop, or the photo, is filled from
    assert f"inpainting of {pairs} at {seen}:" in inpainting and f"depth of {pairs} at (120, 160):" in depth
    assert together.endswith("the stream takes at most 3.00 GiB beside training while no photo is larger than the first 3")


def test_the_warm_up_of_depth_sees_the_largest_photo_and_the_one_that_is_enlarged_most(folder, tmp_path, capsys, monkeypatch):
    seen = []
    monkeypatch.setattr(
        PretrainedDepth, "warm_up", lambda depth, size, most: seen.append(size) or WarmUp("depth", 2, size[1] * GIB, GIB, 1)
    )
    photos = {f"{i}.png": png(photo(i, *shape)) for i, shape in enumerate([(64, 240), (120, 160), (90, 130)])}
    stream = ZeroStereoStream(write_tar(tmp_path / "a.tar", photos), size=SIZE, depth=folder, inpaint=grey_fill)
    monkeypatch.setattr("zsdata.stream.load_depth", lambda network, device: load_depth(network))
    stream.loader(3, device="meta")
    assert sorted(seen) == [(64, 240), (120, 160)] and "the stream takes at most 240.00 GiB" in capsys.readouterr().err


def test_loaded_networks_count_by_their_options(folder, tar):
    def configuration(**options):
        return ZeroStereoStream(tar, size=SIZE, depth=load_depth(folder, **options)).provenance()["configuration"]

    assert configuration() == configuration(micro_batch=2) != configuration(resolution=42)


def test_provenance_names_the_models_with_their_licences(folder, tar, tmp_path):
    pytest.importorskip("diffusers")
    (folder / "README.md").write_text("---\nlicense: apache-2.0\n---\n# a card\n")
    save_small_pipeline(tmp_path / "ZeroStereo" / "StereoGen")
    (tmp_path / "ZeroStereo" / "StereoGen" / "README.md").unlink()
    network = DiffusionNetwork(str(tmp_path / "ZeroStereo"), subfolder="StereoGen", steps=4)
    record = ZeroStereoStream(tar, size=SIZE, depth=folder, inpaint=network).provenance()
    assert json.loads(json.dumps(record)) == record
    assert record["depth"] == [{"id": str(folder), "revision": None, "licence": "apache-2.0"}]
    assert record["inpaint"] == [{"id": network.name, "revision": None, "licence": "mit"}]
    builtin = ZeroStereoStream(tar, depth=layered_depth).provenance()
    assert builtin["inpaint"] == [{"id": "builtin", "revision": None, "licence": "apache-2.0"}]


@pytest.mark.parametrize("argument", ["depth", "inpaint"])
def test_a_commercial_user_is_kept_from_non_commercial_models(tar, argument):
    model = {"depth": "depth-anything/Depth-Anything-V2-Large-hf", "inpaint": "stabilityai/sd-turbo"}[argument]
    options = {"depth": layered_depth, argument: model}
    ZeroStereoStream(tar, depth=layered_depth, commercial_safe=True)
    with pytest.raises(NonCommercialModel, match=r"commercial_safe is set\. Take "):
        ZeroStereoStream(tar, commercial_safe=True, **options)
