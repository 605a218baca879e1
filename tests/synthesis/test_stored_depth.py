"""depth="stored": pairs from the depth maps that lie beside the photos, however they are made."""

import json
import logging
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from tests.scenes import grey16, jpeg, layered_depth, npy, photo, photo_tar, png, write_tar
from tests.source.http_server import ScriptedServer
from tests.source.images import encode, exif
from tests.test_stream import by_index, fingerprint, open_stream
from zsdata import AugmentConfig, FailureBudget, ImageSource, NoUsablePhoto, SynthesisConfig, TooManyFaults, ViewConfig, cli
from zsdata.source import http_ranges
from zsdata.source.index import write_index
from zsdata.source.photo import decode_photo
from zsdata.source.verify import verify
from zsdata.synthesis.depth import as_network, load_depth

COUNT = 6
NO_FLIP = SynthesisConfig(flip_confidence=False)


def smooth_depth(images):
    """An estimator whose maps have more values than a PNG can hold."""
    return layered_depth(images) + images.mean(1, keepdim=True) / 1000


def estimated(photo_bytes):
    """What the estimator returns for a photo, float32 [H, W]."""
    with torch.inference_mode():
        return smooth_depth(decode_photo(photo_bytes)[None].float())[0, 0].numpy()


def with_depth(count=COUNT, first_seed=0, to_bytes=npy, extension="depth.npy", **size):
    """Members of a tar: photos, each with the map that the estimator returns for it."""
    members = {}
    for seed in range(first_seed, first_seed + count):
        members[f"{seed:06d}.jpg"] = jpeg(photo(seed, **size))
        members[f"{seed:06d}.{extension}"] = to_bytes(estimated(members[f"{seed:06d}.jpg"]))
    return members


@pytest.fixture(scope="module")
def tar(tmp_path_factory):
    return write_tar(tmp_path_factory.mktemp("tar") / "photos.tar", with_depth())


def open_stored(sources, **options):
    return open_stream(sources, depth="stored", **options)


@pytest.fixture(scope="module")
def plain(tar):
    return by_index(open_stored(tar))


@pytest.mark.parametrize(
    "options", [{}, {"views_per_image": 2, "epoch_size": 8}, {"reuse": 2, "epoch_size": 8}, {"size": None}, {"inpaint": "background"}]
)
def test_pairs_are_byte_for_byte_those_of_the_estimator_that_made_the_maps(tar, options):
    stored = by_index(open_stored(tar, **options))
    assert stored == by_index(open_stream(tar, depth=smooth_depth, synthesis=NO_FLIP, **options)) and len(stored) >= COUNT


def test_the_mirrored_photo_has_the_mirrored_map(tar):
    options = {"view": ViewConfig(mirror_probability=1.0)}
    mirrored = by_index(open_stored(tar, **options))
    assert mirrored == by_index(open_stream(tar, depth=smooth_depth, synthesis=NO_FLIP, **options))
    assert all(pair.meta["mirror"] for pair in open_stored(tar, **options))


def test_nothing_is_known_of_the_mirrored_photo_so_every_label_counts_fully(tar, plain):
    for pair in open_stored(tar):
        assert (pair.confidence == 1).all() and pair.meta["flip_consistency"] == 1
    assert by_index(open_stored(tar, synthesis=NO_FLIP)) == plain


@pytest.mark.parametrize("workers", [0, 1, 3])
@pytest.mark.parametrize("placement", ["auto", "worker", "device"])
def test_the_loader_gives_the_same_pairs_wherever_they_are_made(tar, plain, workers, placement):
    with open_stored(tar, depth_placement=placement).loader(2, num_workers=workers) as loader:
        batches = list(loader)
    assert by_index(batch[i] for batch in batches for i in range(len(batch))) == plain


@pytest.mark.filterwarnings("ignore:This DataLoader will create")
def test_a_torch_dataloader_gives_the_same_pairs(tar, plain):
    batches = list(DataLoader(open_stored(tar), batch_size=3, num_workers=2))
    assert by_index(batch[i] for batch in batches for i in range(len(batch))) == plain


def test_a_map_is_read_and_decoded_once_for_all_views_of_its_photo(tar, monkeypatch):
    from zsdata import worker

    decode, calls = worker.decode_depth, []
    monkeypatch.setattr(worker, "decode_depth", lambda *given: calls.append(1) or decode(*given))
    assert len(list(open_stored(tar, views_per_image=3, epoch_size=9))) == 9 and len(calls) == 3


def test_maps_cost_nothing_where_depth_is_estimated(tar, monkeypatch):
    from zsdata.source import manifest as module
    from zsdata.source.manifest import Manifest

    read, sizes = module.read_range, []
    monkeypatch.setattr(Manifest, "read_depth", None)
    monkeypatch.setattr(module, "read_range", lambda url, offset, size, **more: sizes.append(size) or read(url, offset, size, **more))
    stream = open_stream(tar)
    assert len(list(stream)) == COUNT == len(sizes)
    assert sorted(sizes) == sorted(stream._schedule.at(0).manifests[0].sizes.tolist())


def test_a_grey_png_gives_the_label_to_half_a_step_of_its_values(tmp_path):
    def sixteen_bits(depth):
        low, high = depth.min(), depth.max()
        return grey16(((depth - low) / (high - low) * 65535).round().astype(np.uint16))

    shard = write_tar(tmp_path / "a.tar", with_depth(to_bytes=sixteen_bits, extension="Depth.PNG"))
    for pair, expected in zip(open_stored(shard), open_stream(shard, depth=smooth_depth, synthesis=NO_FLIP), strict=True):
        assert pair.meta["key"] == expected.meta["key"]
        close = (pair.disparity - expected.disparity).abs() <= pair.meta["largest_disparity_px"] / 65535 * 1.01
        assert close.float().mean() > 0.99  # the sharpening may decide otherwise where it chooses between two neighbours


@pytest.mark.parametrize("transform", [lambda depth: depth * 2.0**70, lambda depth: depth * 2 - 8, lambda depth: depth.astype("<f8") * 4])
def test_scale_and_offset_of_a_map_change_nothing_that_matters(tmp_path, plain, tar, transform):
    shard = write_tar(tmp_path / "photos.tar", with_depth(to_bytes=lambda depth: npy(transform(depth))))
    for pair, expected in zip(open_stored(shard), open_stored(tar), strict=True):
        assert torch.allclose(pair.disparity, expected.disparity, atol=1e-3)


def test_larger_is_nearer(tmp_path):
    half = np.tile(np.where(np.arange(160) < 80, 1.0, 5.0).astype(np.float32), (120, 1))
    shard = write_tar(tmp_path / "a.tar", {"a.png": png(photo(0)), "a.depth.npy": npy(half)})
    (pair,) = open_stored(shard, size=None)
    assert pair.disparity[0, :, 100:].min() > 2 * pair.disparity[0, :, :60].max()


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_a_map_is_turned_with_its_photo(tmp_path, orientation):
    image = photo(0, 120, 160)
    stored = (image[..., 1].astype(np.float32) + np.arange(160, dtype=np.float32)) * 2
    shard = write_tar(tmp_path / "a.tar", {"a.jpg": encode(image, "JPEG", quality=95, exif=exif(orientation)), "a.depth.npy": npy(stored)})
    turn = {3: cv2.ROTATE_180, 6: cv2.ROTATE_90_CLOCKWISE, 8: cv2.ROTATE_90_COUNTERCLOCKWISE}[orientation]
    upright = torch.from_numpy(cv2.rotate(stored, turn))[None, None]
    (pair,) = open_stored(shard, size=None)
    (expected,) = open_stream(shard, size=None, depth=lambda images: upright, synthesis=NO_FLIP)
    assert fingerprint(pair) == fingerprint(expected) and pair.meta["photo_size"] == list(upright.shape[-2:])


def test_a_smaller_map_is_enlarged(tmp_path):
    image = photo(3, 240, 320)
    full = cv2.GaussianBlur(image[..., 0].astype(np.float32), (0, 0), 12)
    small = cv2.resize(full, (161, 119), interpolation=cv2.INTER_AREA)  # as a network with whole patches has it
    members = {"a.png": png(image), "a.depth.npy": npy(small)}
    (pair,) = open_stored(write_tar(tmp_path / "small.tar", members), size=None)
    (expected,) = open_stored(write_tar(tmp_path / "full.tar", members | {"a.depth.npy": npy(full)}), size=None)
    assert (pair.disparity - expected.disparity).abs().max() < 1


def test_photos_decoded_at_a_fraction_have_their_map_too(tmp_path):
    shard = write_tar(tmp_path / "large.tar", with_depth(count=3, height=480, width=640))
    options = {"view": ViewConfig(min_scale=-3, max_scale=-2)}
    stored = by_index(open_stored(shard, **options))
    assert stored == by_index(open_stream(shard, depth=smooth_depth, synthesis=NO_FLIP, **options))


FAULTS = {
    "missing": (None, "no stored depth"),
    "nan": (npy(np.full((120, 160), np.nan, np.float32)), "stored depth not finite"),
    "flat": (npy(np.ones((120, 160), np.float32)), "stored depth flat"),
    "other": (npy(np.random.default_rng(0).random((120, 60))), "stored depth does not fit"),
    "bytes": (grey16(np.arange(19200, dtype=np.uint8).reshape(120, 160)), "stored depth of another kind"),
    "cut": (npy(np.zeros((120, 160)))[:900], "stored depth damaged"),
}


@pytest.fixture(scope="module")
def faulty(tmp_path_factory):
    """A shard with a map of each fault, and a few good ones."""
    members = with_depth()
    for name, (data, _) in FAULTS.items():
        members[f"{name}.jpg"] = jpeg(photo(len(members)))
        if data is not None:
            members[f"{name}.depth.npy"] = data
    return write_tar(tmp_path_factory.mktemp("faulty") / "faulty.tar", members)


def test_each_map_that_cannot_be_used_is_counted_by_name_and_its_photo_replaced(faulty, tmp_path):
    stream = open_stored(faulty)
    pairs = list(stream)
    assert len(pairs) == COUNT + len(FAULTS) and all(pair.meta["key"] not in FAULTS for pair in pairs)
    rejected = stream.stats()["rejected"]
    assert set(rejected) == {reason for _, reason in FAULTS.values()} and min(rejected.values()) >= 1
    told = {key: reason for _, _, key, reason in stream.stats()["examples"]}
    assert told["missing"] == "no stored depth: neither missing.depth.npy nor missing.depth.png; add one, or let depth be estimated"
    assert "the photo has 160 x 120 pixels as stored, the depth map 60 x 120" in told["other"]
    with stream.loader(2, num_workers=2, rejected=tmp_path / "rejected.jsonl") as loader:
        batches = list(loader)
    assert by_index(batch[i] for batch in batches for i in range(len(batch))) == by_index(pairs)
    lines = [json.loads(line) for line in Path(tmp_path / "rejected.jsonl").read_text().splitlines()]
    assert {line["key"] for line in lines} == set(FAULTS)


def test_verify_names_what_the_stream_refuses(faulty):
    report = verify(faulty)
    assert {problem.key: problem.reason.split(":")[0] for problem in report.problems} == {
        name: reason for name, (data, reason) in FAULTS.items() if data is not None
    }
    assert (report.photos, report.depth_maps) == (COUNT + len(FAULTS), COUNT)


def test_photos_without_a_map_spend_the_failure_budget(tmp_path):
    members = with_depth(count=2) | {f"bare-{seed}.jpg": jpeg(photo(seed)) for seed in range(2)}
    stream = open_stored(write_tar(tmp_path / "a.tar", members), epoch_size=100, budget=FailureBudget(count=2, rate=0.05))
    with pytest.raises(TooManyFaults, match=r"Refused since the start: no stored depth: 3; the first: bare-"):
        list(stream)


def test_a_source_without_one_map_is_an_error_at_once(tar, tmp_path):
    bare = photo_tar(tmp_path / "bare.tar", 3)
    for sources in (bare, {"good": ImageSource(tar), "bare": ImageSource(bare)}, {0: tar, 5: bare}):
        with pytest.raises(ValueError, match=r'depth="stored", but not one of the 3 photos of source ".*" \(.*bare\.tar.*KEY\.depth\.npy'):
            open_stored(sources)
    stream = open_stored(tar)
    before = stream.state_dict()
    with pytest.raises(ValueError, match="not one of the 3 photos"):
        stream.set_sources(bare, epoch=1)
    assert stream.state_dict() == before


def test_a_source_with_some_maps_says_how_many_are_missing(faulty, caplog):
    open_stored(faulty)
    assert '1 of the 12 photos of source "photos" have no depth map' in caplog.text
    caplog.clear()
    open_stream(faulty)
    assert not caplog.records


def test_when_no_map_can_be_used_the_error_says_why(tmp_path):
    shard = write_tar(tmp_path / "a.tar", {"a.jpg": jpeg(photo(0)), "a.depth.npy": FAULTS["flat"][0], "b.jpg": jpeg(photo(1))})
    with pytest.raises(NoUsablePhoto, match=r"stored depth flat: 1 at every pixel"):
        list(open_stored(shard))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"depth_cache": "cache"}, "depth_cache would keep it a second time; leave depth_cache out"),
        ({"depth_resolution": 518}, "depth_resolution belongs to a network given by name or folder; depth is 'stored'"),
    ],
)
def test_options_of_estimators_are_refused(tar, options, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=message):
        open_stored(tar, **options)
    assert not list(tmp_path.iterdir())


def test_stored_depth_is_no_estimator():
    assert as_network("stored") is None
    with pytest.raises(ValueError, match=r'depth="stored" is no estimator.*name an estimator'):
        load_depth("stored")


def test_of_stored_depth_no_model_is_known(tar, tmp_path, monkeypatch):
    (tmp_path / "stored").mkdir()
    (tmp_path / "stored" / "README.md").write_text("---\nlicense: cc-by-nc-4.0\n---\n")
    monkeypatch.chdir(tmp_path)  # a folder of that name says nothing about it
    stream = open_stored(tar, commercial_safe=True, inpaint="builtin")
    assert stream.provenance()["depth"] == [{"id": "stored", "revision": None, "licence": None}]


def test_a_state_resumes_and_belongs_to_the_maps_that_were_there(tar, plain, tmp_path):
    first = open_stored(tar)
    list(islice(first, 3))
    state = json.loads(json.dumps(first.state_dict()))
    second = open_stored(tar)
    second.load_state_dict(state)
    assert by_index(second) == {place: value for place, value in plain.items() if place[1] > 2}
    with pytest.raises(ValueError, match="configuration"):
        open_stream(tar).load_state_dict(state)
    members = with_depth()
    del members["000003.depth.npy"]
    other = write_tar(tmp_path / "photos.tar", members)
    with pytest.raises(ValueError, match="the state's manifest"):
        open_stored(other).load_state_dict(state)


def test_with_an_index_the_pairs_are_the_same(tar, plain, tmp_path):
    shard = tmp_path / "photos.tar"
    shard.write_bytes(Path(tar).read_bytes())
    write_index(shard)
    pairs = list(open_stored(str(shard)))
    for pair in pairs:
        pair.meta["shard"] = tar
    assert by_index(pairs) == plain


def test_maps_of_remote_shards_are_read_by_range_and_kept_by_the_shard_cache(tar, plain, tmp_path, monkeypatch):
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("ZSDATA_CACHE", str(tmp_path / "indexes"))
    with ScriptedServer() as server:
        url = server.put("photos.tar", Path(tar).read_bytes(), ETag='"1"')
        for _ in range(2):
            stream = open_stored(url, shard_cache=tmp_path / "cache")
            opened = len(server.requests)
            pairs = list(stream)
            asked = len(server.requests) - opened
            for pair in pairs:
                pair.meta["shard"] = tar
            assert by_index(pairs) == plain
        assert asked == 0  # by the second stream, of photos and maps alike
        http_ranges.close_connections()


def test_the_commands_take_stored_depth(tar, tmp_path, capsys, caplog):
    caplog.set_level(logging.WARNING)
    small = ["--sources", tar, "--depth", "stored"]
    assert cli.main(["preview", *small, "--output", str(tmp_path / "sheet.png"), "--size", "64", "96", "--pairs", "2"]) == 0
    assert cli.main(["stats", *small, "--pairs", "3"]) == 0
    assert cli.main(["export", *small, "--output", str(tmp_path / "pairs"), "--pairs", "2"]) == 0
    exported = np.load(next((tmp_path / "pairs").rglob("*confidence*/**/*.npy")))
    assert (exported == 1).all()
    assert cli.main(["bench", *small, "--size", "64", "96", "--workers", "0", "--pairs", "2", "--batch-size", "2"]) == 0
    assert cli.main(["verify", tar]) == 0
    out = capsys.readouterr().out
    assert "6 good photos with 6 good depth maps in 1 shard" in out
    assert cli.main(["bench", *small, "--depth-cache", str(tmp_path / "depth")]) == 2
    assert cli.main(["preview", "--sources", photo_tar(tmp_path / "bare.tar", 2), *small[2:], "--output", str(tmp_path / "no.png")]) == 2
    errors = capsys.readouterr().err
    assert "leave depth_cache out" in errors and "not one of the 2 photos" in errors
    assert not caplog.records


def test_pack_and_train_on_what_lies_beside_the_photos(tmp_path, capsys):
    (tmp_path / "photos").mkdir()
    for name, data in with_depth(count=2).items():
        (tmp_path / "photos" / name).write_bytes(data)
    assert cli.main(["pack", str(tmp_path / "photos"), str(tmp_path / "shards")]) == 0
    assert "packed 2 photos with 2 depth maps" in capsys.readouterr().out
    pairs = list(open_stored(tmp_path / "shards", augmentation=AugmentConfig.none()))
    assert [pair.meta["key"] for pair in pairs] and len(pairs) == 2


def test_the_trainers_arguments_take_stored_depth(tar, tmp_path):
    import argparse

    from trainers.arguments import add_training_arguments, open_stream

    parser = argparse.ArgumentParser()
    add_training_arguments(parser)
    told = ["--sources", tar, "--depth", "stored", "--size", "64", "96", "--output", str(tmp_path / "run")]
    assert len(list(open_stream(parser.parse_args(told)))) == COUNT
