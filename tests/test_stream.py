import hashlib
import json
import logging
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from tests.scenes import grey_fill, jpeg, layered_depth, photo, photo_tar, png, write_tar
from zsdata import AdaptiveDisparity, AugmentConfig, ImageSource, StereoBatch, UniformDisparity, ZeroStereoStream
from zsdata.quality import QualityGate
from zsdata.seeding import rng
from zsdata.synthesis.synthesizer import SynthesisConfig
from zsdata.synthesis.view import ViewConfig

SIZE = (64, 96)


def open_stream(sources, **options):
    return ZeroStereoStream(sources, **{"size": SIZE, "depth": layered_depth, "inpaint": grey_fill, **options})


def fingerprint(pair: StereoBatch) -> str:
    """A hash of every byte of one pair."""
    tensors = (pair.left, pair.right, pair.disparity, pair.confidence, *pair.masks, pair.left_clean, pair.right_clean)
    digest = hashlib.sha256(json.dumps(pair.meta, sort_keys=True).encode())
    for tensor in tensors:
        digest.update(str((tensor.dtype, tuple(tensor.shape))).encode() + tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()


def by_index(pairs):
    return {(pair.meta["epoch"], pair.meta["index"]): fingerprint(pair) for pair in pairs}


@pytest.fixture(scope="module")
def tar(tmp_path_factory):
    return photo_tar(tmp_path_factory.mktemp("tar") / "photos.tar", 12)


@pytest.fixture(scope="module")
def plain(tar):
    return by_index(open_stream(tar))


def test_a_pair_unpacks_into_the_documented_fields(tar, tmp_path):
    left, right, disparity, confidence, masks = pair = next(iter(open_stream(tar)))
    for image in (left, right, pair.left_clean, pair.right_clean):
        assert image.shape == (3, *SIZE) and image.dtype == torch.float32
        assert 0 <= image.min() and image.max() <= 255 and image.max() > 1
    for label in (disparity, confidence):
        assert label.shape == (1, *SIZE) and label.dtype == torch.float32
    assert disparity.min() > 0 and 0 <= confidence.min() and confidence.max() <= 1
    for mask in masks:
        assert mask.shape == (1, *SIZE) and mask.dtype == torch.bool
    assert masks.nonocclusion.any() and masks.inpaint.any() and masks.valid.all()
    assert json.loads(json.dumps(pair.meta)) == pair.meta
    torch.save(pair.meta, tmp_path / "meta.pt")
    assert torch.load(tmp_path / "meta.pt", weights_only=True) == pair.meta  # nothing of NumPy's


def test_an_epoch_is_one_exact_pass_and_the_next_one_another_order(tar):
    stream = open_stream(tar)
    first, second = ([pair.meta["key"] for pair in stream] for _ in range(2))
    assert len(stream) == 12
    assert sorted(first) == sorted(second) == [f"{i:06d}" for i in range(12)]
    assert first != second


def test_a_loop_that_was_broken_off_goes_on_where_it_stopped(tar, plain):
    stream, pairs = open_stream(tar), []
    for _ in range(3):
        for pair in stream:
            pairs.append(pair)
            if len(pairs) % 4 == 0:
                break
    assert by_index(pairs) == plain and stream.state_dict()["samples"] == 12


def test_a_loop_that_was_broken_off_at_its_last_pair_goes_on_with_the_next_epoch(tar):
    stream, resumed = open_stream(tar, epoch_size=2), open_stream(tar, epoch_size=2)
    assert len(list(islice(stream, 2))) == 2
    resumed.load_state_dict(stream.state_dict())
    assert [pair.meta["epoch"] for pair in stream] == [1, 1] == [pair.meta["epoch"] for pair in resumed]
    single = open_stream(tar, epoch_size=1)
    assert [next(iter(single)).meta["epoch"] for _ in range(3)] == [0, 1, 2]


def test_a_state_brings_the_loop_over_the_stream_back(tar, plain):
    first = open_stream(tar)
    pairs = list(islice(first, 5))
    second = open_stream(tar)
    second.load_state_dict(json.loads(json.dumps(first.state_dict())))
    pairs += list(second)
    assert by_index(pairs) == plain and len(pairs) == 12


def test_replay_gives_the_very_same_pair(tar, plain):
    stream = open_stream(tar)
    assert all(fingerprint(stream.replay(epoch=epoch, index=index)) == value for (epoch, index), value in plain.items())
    with pytest.raises(IndexError, match="sample 12 of an epoch of 12"):
        stream.replay(epoch=0, index=12)


@pytest.mark.filterwarnings("ignore:This DataLoader will create")  # torch's hint on machines with fewer cores
@pytest.mark.parametrize("workers", [0, 1, 2, 3])
def test_a_torch_dataloader_gives_the_same_pairs(tar, plain, workers):
    loader = DataLoader(open_stream(tar), batch_size=2, num_workers=workers)
    batches = list(loader)
    assert all(isinstance(batch, StereoBatch) for batch in batches)
    assert by_index(batch[i] for batch in batches for i in range(len(batch))) == plain


@pytest.mark.parametrize("workers", [0, 1, 2, 3])
@pytest.mark.parametrize("batch_size", [1, 3])
def test_the_loader_gives_the_same_pairs(tar, plain, workers, batch_size):
    with open_stream(tar).loader(batch_size, num_workers=workers) as loader:
        batches = list(loader)
        assert len(batches) == len(loader) == 12 // batch_size
    assert by_index(batch[i] for batch in batches for i in range(len(batch))) == plain


def test_set_epoch_reaches_dataloader_workers(tar):
    stream = open_stream(tar)
    loader = DataLoader(stream, batch_size=None, num_workers=2)
    keys = []
    for epoch in range(2):
        stream.set_epoch(epoch)
        keys.append([pair.meta["index"] for pair in loader if pair.meta["epoch"] == epoch])
    assert [sorted(indices) for indices in keys] == [list(range(12))] * 2


def test_persistent_dataloader_workers_move_on_by_themselves(tar):
    loader = DataLoader(open_stream(tar), batch_size=None, num_workers=2, persistent_workers=True)
    epochs = [{pair.meta["epoch"] for pair in loader} for _ in range(3)]
    assert epochs == [{0}, {1}, {2}]


@pytest.mark.filterwarnings("ignore:This DataLoader will create")
def test_persistent_dataloader_workers_stay_in_one_epoch_after_a_loop_that_was_broken_off(tar):
    """Batches are fetched ahead, so that one worker is at its end by then and the other is not."""
    loader = DataLoader(open_stream(tar), batch_size=None, num_workers=3, persistent_workers=True, prefetch_factor=2)
    for number, _ in enumerate(loader):
        if number == 7:
            break
    epochs = [sorted((pair.meta["epoch"], pair.meta["index"]) for pair in loader) for _ in range(2)]
    assert epochs == [[(epoch, index) for index in range(12)] for epoch in (1, 2)]


@pytest.mark.parametrize("taken", [1, 5])
def test_the_place_of_a_worker_follows_its_pairs(tar, monkeypatch, taken):
    """As data loaders ask for it that save the state of their workers."""
    monkeypatch.setattr("zsdata.stream.get_worker_info", lambda: SimpleNamespace(id=1, num_workers=2))
    stream, resumed = open_stream(tar), open_stream(tar)
    first = list(islice(stream, taken))
    resumed.load_state_dict(stream.state_dict())
    assert [pair.meta["index"] for pair in [*first, *resumed]] == [1, 3, 5, 7, 9, 11]
    assert resumed.state_dict()["epoch"] == 1


def test_another_seed_gives_other_pairs(tar, plain):
    other = by_index(open_stream(tar, seed=1))
    assert not set(other.values()) & set(plain.values())


def test_the_folder_of_the_shards_does_not_matter_to_the_place(tar, tmp_path):
    moved = tmp_path / "photos.tar"
    moved.write_bytes(Path(tar).read_bytes())
    open_stream(str(moved)).load_state_dict(open_stream(tar).state_dict())


def test_weighted_sources_are_mixed_by_their_weights(tmp_path):
    first, second = photo_tar(tmp_path / "a.tar", 5), photo_tar(tmp_path / "b.tar", 5, first_seed=50)
    stream = open_stream({"a": ImageSource(first, weight=0.75), "b": ImageSource(second, weight=0.25)}, epoch_size=16)
    sources = [pair.meta["source"] for pair in stream]
    assert (sources.count("a"), sources.count("b")) == (12, 4)


def test_weights_without_an_epoch_size_are_said_to_change_nothing(tar, caplog):
    stream = open_stream({"a": ImageSource(tar, weight=0.7)})
    assert len(stream) == 12 and "weights change nothing" in caplog.text


def test_a_schedule_swaps_sources_between_epochs(tmp_path):
    first, second = photo_tar(tmp_path / "a.tar", 3), photo_tar(tmp_path / "b.tar", 4, first_seed=50)
    stream = open_stream({0: first, 2: {"late": second}})
    sources = [[pair.meta["source"] for pair in stream] for _ in range(3)]
    assert sources == [["photos"] * 3, ["photos"] * 3, ["late"] * 4]


def test_set_sources_equals_a_schedule(tmp_path):
    first, second = photo_tar(tmp_path / "a.tar", 3), photo_tar(tmp_path / "b.tar", 4, first_seed=50)
    planned, swapped = open_stream({0: first, 1: second}), open_stream(first)
    swapped.set_sources(second, epoch=1)
    assert by_index([*planned, *planned]) == by_index([*swapped, *swapped])
    swapped.load_state_dict(planned.state_dict())


def test_a_bad_photo_is_counted_and_replaced(tmp_path):
    good = {f"{i}.jpg": jpeg(photo(i)) for i in range(4)}
    tar = write_tar(tmp_path / "mixed.tar", {**good, "cut.jpg": jpeg(photo(9))[:2000], "page.jpg": b"<html>not found</html>" * 20})
    stream = open_stream(tar)
    pairs = list(stream)
    assert len(pairs) == 6 and {pair.meta["key"] for pair in pairs} <= {"0", "1", "2", "3"}
    stats = stream.stats()
    assert sum(stats["rejected"].values()) >= 2 and {example[2] for example in stats["examples"]} == {"cut", "page"}
    assert by_index(pairs) == by_index(open_stream(tar))


def test_a_source_without_one_usable_photo_is_an_error_that_says_why(tmp_path):
    tar = write_tar(tmp_path / "bad.tar", {"a.jpg": b"no", "b.jpg": b"never"})
    with pytest.raises(RuntimeError, match=r"no usable photo for sample 0 of epoch 0: 2 of source .photos. were refused"):
        next(iter(open_stream(tar)))


def odd_photos():
    from io import BytesIO

    from PIL import Image

    def saved(image, kind, **options):
        buffer = BytesIO()
        image.save(buffer, kind, **options)
        return buffer.getvalue()

    rgb = Image.fromarray(photo(3))
    exif = Image.Exif()
    exif[0x0112] = 6
    sixteen = np.asarray(rgb.convert("L")).astype(np.uint16) * 257
    palette = rgb.convert("RGBA")
    palette.putalpha(Image.fromarray((np.indices((120, 160))[1] % 256).astype(np.uint8)))
    return {
        "constant.png": saved(Image.new("RGB", (160, 120), (90, 90, 90)), "PNG"),
        "thin.png": saved(Image.new("RGB", (1, 120)), "PNG"),
        "tiny.png": saved(rgb.resize((8, 6)), "PNG"),
        "small.png": saved(rgb.resize((40, 33)), "PNG"),
        "grey.jpg": saved(rgb.convert("L"), "JPEG"),
        "cmyk.jpg": saved(rgb.convert("CMYK"), "JPEG"),
        "turned.jpg": saved(rgb, "JPEG", exif=exif),
        "deep.png": saved(Image.fromarray(sixteen), "PNG"),
        "palette.png": saved(palette.quantize(16), "PNG"),
        "wide.jpg": saved(rgb.resize((900, 40)), "JPEG"),
    }


@pytest.mark.parametrize("depth", [layered_depth, "builtin"])
@pytest.mark.filterwarnings("ignore::zsdata.synthesis.depth.builtin.BuiltinDepthWarning")
def test_odd_photos_give_a_right_pair_or_are_counted(tmp_path, depth):
    tar = write_tar(tmp_path / "odd.tar", odd_photos())
    stream = open_stream(tar, depth=depth, inpaint="builtin")
    seen = set()
    for pair in stream:
        seen.add(pair.meta["key"])
        for tensor in (pair.left, pair.right, pair.disparity, pair.confidence, pair.right_clean):
            assert torch.isfinite(tensor).all()
        assert pair.disparity.min() > 0 and pair.confidence.min() >= 0 and pair.confidence.max() <= 1
    assert seen == {"constant", "small", "grey", "cmyk", "turned", "deep", "palette"}
    assert {example[2] for example in stream.stats()["examples"]} == {"thin", "tiny", "wide"}
    everything = QualityGate(max_hole_share=1, min_visible_share=0, min_depth_range=0, min_flip_consistency=0)
    assert {pair.meta["key"] for pair in open_stream(tar, depth=depth, quality=everything)} == {*seen, "wide"}


@pytest.mark.parametrize("placement", ["worker", "device"])
@pytest.mark.parametrize("workers", [0, 2])
def test_pairs_that_teach_nothing_are_counted_and_replaced_by_the_same_ones_everywhere(tar, placement, workers):
    gate = QualityGate(max_hole_share=0.16)
    options = {"depth": CountingDepth(), "quality": gate, "views_per_image": 2}
    plain = list(open_stream(tar, **options))
    refused = [reject for pair in plain for reject in pair.meta["replaced"]]
    assert refused and all(reason.startswith("too many holes: ") for *_, reason in refused)
    assert all(pair.meta["hole_share"] <= 0.16 for pair in plain)
    with open_stream(tar, depth_placement=placement, **options).loader(3, num_workers=workers) as loader:
        assert by_index(batch[i] for batch in loader for i in range(3)) == by_index(plain)
        assert loader.stats()["rejected"] == {"too many holes": len(refused)}


def test_the_gate_and_the_figures_of_a_pair_speak_of_its_crop(tar, monkeypatch):
    asked, refuses = [], QualityGate.refuses
    monkeypatch.setattr(QualityGate, "refuses", lambda gate, **figures: asked.append(figures) or refuses(gate, **figures))
    pairs = list(open_stream(tar))
    assert len(asked) == len(pairs)
    for pair, figures in zip(pairs, asked, strict=True):
        assert figures["hole_share"] == pair.meta["hole_share"] == pair.masks.inpaint.double().mean()
        assert figures["visible_share"] == pair.masks.nonocclusion.double().mean()
        assert figures["disparity_range_px"] == pair.disparity.max().item() - pair.disparity.min().item()
        assert pair.meta["largest_disparity_px"] == pair.disparity.max().item()
        assert figures["drawn_px"] == pytest.approx(pair.meta["disparity_scale"] * 160 * pair.meta["scale_x"])


def test_holes_show_another_photo_than_the_pairs_own(tmp_path):
    """As MfS-Stereo fills them; flat photos tell by their colour which one it is."""
    tar = write_tar(tmp_path / "flat.tar", {f"{i:02d}.png": png(np.full((120, 160, 3), 20 * i + 10, np.uint8)) for i in range(12)})
    seen = []

    class Background:
        needs = ("background",)

        def __call__(self, right, inpaint_mask, generators, background):
            seen.extend(background.mean((1, 2, 3)).tolist())
            return background

    everything = QualityGate(max_hole_share=1, min_visible_share=0, min_depth_range=0, min_flip_consistency=0)
    ramp = lambda images: torch.linspace(0, 1, images.shape[-1]).expand(1, 1, *images.shape[-2:])  # noqa: E731
    pairs = list(open_stream(tar, depth=ramp, inpaint=Background(), augmentation=AugmentConfig.none(), quality=everything, epoch_size=48))
    assert len(seen) == len(pairs) and all(20 * int(pair.meta["key"]) + 10 != value for pair, value in zip(pairs, seen, strict=True))
    assert len(set(seen)) > 6


@pytest.mark.parametrize("loaded", [False, True])
def test_on_a_cpu_holes_are_filled_on_one_thread_and_the_callers_threads_come_back(tar, loaded):
    """A network's sums depend on how many there are."""
    seen, threads = set(), torch.get_num_threads()

    def fill(right, inpaint_mask, generators):
        seen.add(torch.get_num_threads())
        return grey_fill(right, inpaint_mask, generators)

    stream = open_stream(tar, inpaint=fill)
    torch.set_num_threads(2)
    try:
        list(stream.loader(4, device="cpu") if loaded else stream)
        assert seen == {1} and torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)


def test_every_sample_of_a_reused_pair_knows_all_that_it_stands_in_for(tmp_path):
    """Also where its pair is refused on the device, and the samples before it were in another batch."""
    damaged = {"cut.jpg": jpeg(photo(9))[:2000], "page.jpg": b"<html>not found</html>" * 20}
    tar = write_tar(tmp_path / "mixed.tar", {f"{i}.jpg": jpeg(photo(i)) for i in range(8)} | damaged)
    stream = open_stream(tar, depth=CountingDepth(), quality=QualityGate(max_hole_share=0.08), reuse=2, depth_placement="device")
    plain = list(stream)
    assert any(len({reason.split(":")[0] for *_, reason in pair.meta["replaced"]}) > 1 for pair in plain)
    with stream.loader(1, num_workers=0) as loader:
        assert by_index(batch[0] for batch in loader) == by_index(plain)
        assert loader.stats()["rejected"] == stream.stats()["rejected"]
    assert sum(stream.stats()["rejected"].values()) == sum(len(pair.meta["replaced"]) for pair in plain[::2])


def test_what_stands_in_for_a_pair_draws_anew(tar):
    """What was refused may be the draw: a disparity that leaves nothing of any photo."""
    drawn = [
        (pair.meta, AdaptiveDisparity().draw_scale(rng(0, 0, pair.meta["pair"], "disparity"), 160))
        for pair in open_stream(tar, depth=CountingDepth(), quality=QualityGate(max_hole_share=0.16), views_per_image=2)
    ]
    assert any(meta["replaced"] for meta, _ in drawn)
    assert all((meta["disparity_scale"] == first) == (not meta["replaced"]) for meta, first in drawn)


def test_the_largest_disparity_is_the_drawn_share_of_the_photos_width(tar):
    for pair in open_stream(tar, augmentation=AugmentConfig.none()):
        largest = pair.meta["disparity_scale"] * 160 * pair.meta["scale_x"]
        assert pair.disparity.max() <= largest * (1 + 1e-5) and 0 < pair.meta["disparity_scale"] < 0.2


def test_the_uniform_baseline_draws_pixels(tar):
    pairs = list(open_stream(tar, disparity=UniformDisparity(min_px=10, max_px=12)))
    assert all(10 <= pair.meta["disparity_scale"] * 160 <= 12 for pair in pairs)


def test_the_uniform_baseline_draws_pixels_of_what_a_large_photo_is_taken_for(tmp_path):
    """Not of its file: in the crop the same range would be a fraction of that of other photos."""
    large = photo_tar(tmp_path / "large.tar", 4, height=512, width=768)  # eight crops wide, and taken for two
    pairs = list(open_stream(large, disparity=UniformDisparity(min_px=10, max_px=12)))
    assert len(pairs) == 4 and all(10 <= pair.meta["disparity_scale"] * 192 <= 12 for pair in pairs)


def test_the_label_reprojects_the_right_image_onto_the_left(tar):
    from zsdata import backward_warp

    for pair in open_stream(tar):
        back = backward_warp(pair.right_clean[None], pair.disparity[None])[0]
        known = backward_warp((~pair.masks.inpaint)[None].float(), pair.disparity[None])[0] > 0.999
        both = (known & pair.masks.nonocclusion).expand_as(back)
        assert (back - pair.left_clean)[both].abs().mean() < 2


def test_without_augmentation_the_pair_is_the_clean_one(tar):
    pair = next(iter(open_stream(tar, augmentation=AugmentConfig.none())))
    assert torch.equal(pair.left, pair.left_clean) and torch.equal(pair.right, pair.right_clean)


def test_holes_alone_are_invented(tar):
    pair = next(iter(open_stream(tar)))
    hole = pair.masks.inpaint.expand_as(pair.right_clean)
    assert pair.right_clean[hole].unique().numel() == 1
    assert pair.right_clean[~hole].unique().numel() > 50


def test_an_inpainter_that_fails_is_told_so(tar):
    with pytest.raises(ValueError, match="NaN or infinity"):
        next(iter(open_stream(tar, inpaint=lambda right, mask, generators: right * float("nan"))))
    with pytest.raises(ValueError, match="must return"):
        next(iter(open_stream(tar, inpaint=lambda right, mask, generators: right[..., 1:])))
    with pytest.raises(ValueError, match="the inpainter must return its images on cpu, where it gets them; got meta"):
        next(iter(open_stream(tar, inpaint=lambda right, mask, generators: right.to("meta"))))


def test_a_depth_estimator_that_fails_names_the_sample(tar):
    def broken(images):
        raise RuntimeError("out of luck")

    with pytest.raises(RuntimeError, match=r'sample 0 of epoch 0 \(source "photos", "0000\d\d" in .*photos.tar\) failed: out of luck'):
        next(iter(open_stream(tar, depth=broken)))
    with pytest.raises(RuntimeError, match=r"sample 0 .* must return its maps on cpu, where the photos are; got meta"):
        next(iter(open_stream(tar, depth=lambda images: images[:, :1].to("meta"))))
    for returned in (None, {}, np.zeros(3)):
        with pytest.raises(RuntimeError, match=rf"sample 0 .* must return a tensor, .*; got {type(returned).__name__}"):
            next(iter(open_stream(tar, depth=lambda images, returned=returned: returned)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 5}, "seed"),
        ({"size": (64, 64)}, "configuration"),
        ({"depth": grey_fill}, "configuration"),
        ({"inpaint": "builtin"}, "configuration"),
        ({"disparity": AdaptiveDisparity(center=0.2)}, "configuration"),
        ({"view": ViewConfig(max_width=3)}, "configuration"),
        ({"synthesis": SynthesisConfig(dilate_px=2)}, "configuration"),
        ({"quality": QualityGate(max_hole_share=0.4)}, "configuration"),
        ({"augmentation": AugmentConfig.none()}, "configuration"),
        ({"epoch_size": 5}, "manifest"),
    ],
)
def test_a_state_of_another_stream_is_refused_by_field(tar, change, message):
    state = open_stream(tar).state_dict()
    with pytest.raises(ValueError, match=f"the state's {message} is"):
        open_stream(tar, **change).load_state_dict(state)


def test_views_of_a_photo_and_uses_of_a_pair_are_not_the_same(tar):
    views, uses = open_stream(tar, views_per_image=2, epoch_size=8), open_stream(tar, reuse=2, epoch_size=8)
    with pytest.raises(ValueError, match="the state's configuration is"):
        uses.load_state_dict(views.state_dict())


def test_a_state_of_other_names_quotas_or_swaps_is_refused(tar):
    def state(sources, **options):
        return open_stream(sources, **{"epoch_size": 6, **options}).state_dict()

    there = state({0: {"indoor": tar}, 5: tar})
    assert there == state({0: {"indoor": tar}, 5: tar})
    others = [
        state({0: {"outdoor": tar}, 5: tar}),
        state({0: {"indoor": tar}, 6: tar}),
        state({0: {"indoor": tar}}),
        state({0: {"indoor": tar}, 5: tar}, epoch_size=7),
    ]
    assert len({other["manifest"] for other in [there, *others]}) == 5
    seven, eight = (state(tar, views_per_image=2, epoch_size=size) for size in (7, 8))  # of as many photos
    assert seven["manifest"] != eight["manifest"]


def test_sources_that_are_swapped_twice_are_the_last_ones(tar, tmp_path):
    second, third = photo_tar(tmp_path / "b.tar", 4, first_seed=50), photo_tar(tmp_path / "c.tar", 5, first_seed=70)
    twice, once = open_stream(tar), open_stream(tar)
    twice.set_sources(second, epoch=2)
    for stream in (twice, once):
        stream.set_sources(third, epoch=2)
    assert [twice.epoch_size(epoch) for epoch in (1, 2, 9)] == [len(once), 5, 5]
    twice.load_state_dict(once.state_dict())


@pytest.mark.parametrize("state", [None, {}, {"version": 1}, {"epoch": 1, "extra": 2}])
def test_what_is_no_state_is_refused(tar, state):
    with pytest.raises(ValueError, match="state"):
        open_stream(tar).load_state_dict(state)


@pytest.mark.parametrize("value", [-1, 1.5, "3", True, None])
def test_a_state_with_a_bad_place_is_refused(tar, value):
    stream = open_stream(tar)
    with pytest.raises(ValueError, match="samples"):
        stream.load_state_dict({**stream.state_dict(), "samples": value})


@pytest.mark.parametrize(
    ("sources", "options", "error"),
    [
        ("nowhere.tar", {}, FileNotFoundError),
        ({}, {}, ValueError),
        ({5: "a.tar"}, {}, ValueError),
        ({"a": "a.tar", 0: "b.tar"}, {}, TypeError),
        (None, {"seed": -1}, ValueError),
        (None, {"seed": 1.5}, ValueError),
        (None, {"size": (384,)}, ValueError),
        (None, {"size": (8, 8)}, ValueError),
        (None, {"epoch_size": 0}, ValueError),
        (None, {"epoch_size": 2**63}, ValueError),
    ],
)
def test_arguments_that_cannot_work_are_refused_at_once(tar, sources, options, error):
    with pytest.raises(error):
        open_stream(tar if sources is None else sources, **options)


def test_problems_of_the_shards_are_said_and_counted(tmp_path, caplog):
    tar = write_tar(tmp_path / "a.tar", {"a.jpg": jpeg(photo(1)), "b.tif": b"II*\0"})
    with caplog.at_level(logging.WARNING, logger="zsdata"):
        stream = open_stream(tar)
    assert sum(stream.stats()["shard_problems"].values()) == 1
    assert "1 fault in the shards (not a JPEG, PNG or WebP: 1)" in caplog.text
    assert f'the first: {tar} "b": not a JPEG, PNG or WebP: .tif' in caplog.text


def test_a_swap_looks_at_the_folder_as_it_is_now(tar, tmp_path):
    folder = tmp_path / "shards"
    folder.mkdir()
    photo_tar(folder / "a.tar", 4)
    stream = open_stream(str(folder))
    photo_tar(folder / "b.tar", 3, first_seed=50)
    stream.set_sources(str(folder), epoch=1)
    assert [stream.epoch_size(epoch) for epoch in (0, 1)] == [4, 7]
    photo_tar(folder / "a.tar", 2, first_seed=90)
    stream.set_sources(str(folder), epoch=2)
    stream.set_epoch(2)
    assert len(list(stream)) == 5 and not stream.stats()["rejected"]


def test_a_swap_to_shards_that_are_the_same_does_not_walk_them_again(tar, monkeypatch):
    stream = open_stream(tar)
    monkeypatch.setattr("zsdata.sources.build_manifest", None)
    stream.set_sources({"other name": tar}, epoch=1)
    assert stream.epoch_size(1) == 12


def test_a_source_that_gives_no_photo_is_told(tar, tmp_path, caplog):
    few = photo_tar(tmp_path / "few.tar", 2)
    open_stream({"many": ImageSource(tar, weight=0.99), "few": ImageSource(few, weight=0.01)}, epoch_size=40)
    assert 'source "few"' in caplog.text and "no photo" in caplog.text
    caplog.clear()
    open_stream({"many": ImageSource(tar, weight=1), "few": ImageSource(few, weight=0)}, epoch_size=40)
    assert caplog.text == ""


def test_several_sources_need_names(tar):
    with pytest.raises(TypeError, match=r'a list holds urls, and several ImageSource are named: \{"indoor": ImageSource'):
        open_stream([ImageSource(tar), ImageSource(tar)])


def test_problems_of_swapped_shards_are_said_and_counted_too(tar, tmp_path, caplog):
    other = write_tar(tmp_path / "b.tar", {"a.jpg": jpeg(photo(1)), "b.tif": b"II*\0"})
    stream = open_stream(tar)
    with stream.loader(1) as loader:
        with caplog.at_level(logging.WARNING, logger="zsdata"):
            stream.set_sources(other, epoch=1)
        assert "1 fault in the shards" in caplog.text
        assert sum(stream.stats()["shard_problems"].values()) == sum(loader.stats()["shard_problems"].values()) == 1


def test_a_pair_says_which_photos_it_stands_in_for_in_any_process(tmp_path):
    tar = write_tar(tmp_path / "mixed.tar", {**{f"{i}.jpg": jpeg(photo(i)) for i in range(3)}, "page.jpg": b"<html>" * 20})
    pairs = list(DataLoader(open_stream(tar), batch_size=None, num_workers=1))
    replaced = [key for pair in pairs for _, _, key, _ in pair.meta["replaced"]]
    assert len(pairs) == 4 and set(replaced) == {"page"}


class CountingDepth:
    """A depth estimator that counts its calls and has a name in a cache."""

    cache_name = "layered v1"

    def __init__(self):
        self.calls = 0

    def __call__(self, images):
        self.calls += 1
        return layered_depth(images)


def test_several_views_of_a_photo_differ_and_cost_one_estimate(tar):
    depth = CountingDepth()
    stream = open_stream(tar, depth=depth, views_per_image=3)
    pairs = list(stream)
    assert len(pairs) == 36 == len({fingerprint(pair) for pair in pairs})
    assert depth.calls == 24, "each photo and its mirror image, once"
    for first in range(0, 36, 3):
        views = pairs[first : first + 3]
        assert len({pair.meta["key"] for pair in views}) == 1
        assert len({pair.meta["disparity_scale"] for pair in views}) == 3
    assert fingerprint(stream.replay(0, 17)) == fingerprint(pairs[17])


@pytest.mark.filterwarnings("ignore:This DataLoader will create")
@pytest.mark.parametrize("workers", [0, 2])
def test_several_views_are_the_same_however_they_are_made(tar, workers):
    plain = by_index(open_stream(tar, views_per_image=3))
    batches = list(DataLoader(open_stream(tar, views_per_image=3), batch_size=4, num_workers=workers))
    assert by_index(batch[i] for batch in batches for i in range(len(batch))) == plain
    with open_stream(tar, views_per_image=3).loader(4, num_workers=workers) as loader:  # batches that cut through a photo's views
        assert by_index(batch[i] for batch in loader for i in range(4)) == plain


def test_an_epoch_of_several_views_has_the_size_that_was_asked_for(tar):
    stream = open_stream(tar, views_per_image=4, epoch_size=10)
    assert len(list(stream)) == len(stream) == 10


@pytest.mark.parametrize("options", [{}, {"views_per_image": 2}], ids=["one view", "two views"])
def test_the_depth_cache_changes_no_byte_and_saves_the_estimates(tar, tmp_path, options):
    without = by_index(open_stream(tar, depth=CountingDepth(), **options))
    for epoch_is_cached in (False, True):
        depth = CountingDepth()
        assert by_index(open_stream(tar, depth=depth, depth_cache=tmp_path / "depth", **options)) == without
        assert depth.calls == (0 if epoch_is_cached else 24)


class NearerOnTheLeft:
    cache_name = "lopsided v1"

    def __call__(self, images):
        return layered_depth(images) * torch.linspace(1.0, 0.8, images.shape[-1])


def test_depth_with_and_without_confidence_lie_apart_in_a_depth_cache(tar, tmp_path):
    def confidence(flip, **options):
        stream = open_stream(tar, depth=NearerOnTheLeft(), synthesis=SynthesisConfig(flip_confidence=flip), **options)
        return next(iter(stream)).confidence

    without_cache = confidence(True)
    assert without_cache.min() < 0.5
    for flip in (False, True, False):
        assert torch.equal(confidence(flip, depth_cache=tmp_path / "depth"), without_cache if flip else torch.ones_like(without_cache))


def test_workers_share_the_depth_cache(tar, plain, tmp_path):
    depth = CountingDepth()
    for _ in range(2):
        with open_stream(tar, depth=depth, depth_cache=tmp_path / "depth").loader(3, num_workers=2) as loader:
            pairs = [batch[i] for batch in loader for i in range(3)]
        assert {(pair.meta["epoch"], pair.meta["index"]) for pair in pairs} == plain.keys()
        assert by_index(pairs) == plain
    entries = [path for path in (tmp_path / "depth").rglob("*") if path.is_file() and path.stat().st_size > 120 * 160 * 3]
    assert len(entries) == 12


def test_a_damaged_depth_cache_is_mended(tar, plain, tmp_path):
    list(open_stream(tar, depth=CountingDepth(), depth_cache=tmp_path))
    for path in tmp_path.rglob("*"):
        if path.is_file() and path.stat().st_size > 120 * 160 * 3:
            data = bytearray(path.read_bytes())
            data[len(data) // 2] ^= 1
            path.write_bytes(data)
    depth = CountingDepth()
    assert by_index(open_stream(tar, depth=depth, depth_cache=tmp_path)) == plain and depth.calls > 0
    depth = CountingDepth()
    assert by_index(open_stream(tar, depth=depth, depth_cache=tmp_path)) == plain and depth.calls == 0


def test_a_cache_for_an_estimator_without_a_name_is_refused(tar, tmp_path):
    with pytest.raises(ValueError, match="cache_name"):
        open_stream(tar, depth_cache=tmp_path)


def test_without_a_size_a_pair_is_the_whole_photo(tmp_path):
    sizes = [(120, 160), (90, 70), (64, 200)]
    tar = write_tar(tmp_path / "sizes.tar", {f"{i}.png": png(photo(i, *size)) for i, size in enumerate(sizes)})
    stream = open_stream(tar, size=None, augmentation=AugmentConfig.none())
    pairs = {pair.meta["key"]: pair for pair in stream}
    for i, (height, width) in enumerate(sizes):
        pair = pairs[str(i)]
        assert torch.equal(pair.left, torch.from_numpy(photo(i, height, width)).permute(2, 0, 1).float())
        assert pair.right.shape == (3, height, width) and pair.masks.inpaint.shape == (1, height, width)
        assert 0 < pair.disparity.max() <= 0.2 * width
    with stream.loader(1, num_workers=2) as loader:
        assert by_index(batch[0] for batch in loader) == by_index(open_stream(tar, size=None, augmentation=AugmentConfig.none()))
    with pytest.raises(ValueError, match="batch_size is 1; got 2"):
        stream.loader(2)


def test_photos_decoded_at_a_fraction_give_the_same_pairs_with_and_without_a_depth_cache(tmp_path):
    tar = photo_tar(tmp_path / "large.tar", 4, height=512, width=768)
    options = {"depth": CountingDepth(), "view": ViewConfig(min_scale=-3, max_scale=-2)}
    plain = by_index(open_stream(tar, **options))
    for _ in range(2):
        assert by_index(open_stream(tar, depth_cache=tmp_path / "depth", **options)) == plain


def pixels_of(pair: StereoBatch):
    return torch.cat([pair.left_clean, pair.right_clean, pair.disparity, pair.confidence, *pair.masks])


class CountingFill:
    """An inpainter that counts the pairs it fills."""

    def __init__(self):
        self.pairs = 0

    def __call__(self, right, inpaint_mask, generators):
        self.pairs += len(right)
        return grey_fill(right, inpaint_mask, generators)


@pytest.mark.parametrize("options", [{"reuse": 3}, {"reuse": 2, "views_per_image": 2}], ids=str)
@pytest.mark.parametrize("batch_size", [4, 6])
def test_a_reused_pair_is_filled_once_and_augmented_each_time(tar, options, batch_size):
    reuse, inpaint = options["reuse"], CountingFill()
    stream = open_stream(tar, inpaint=inpaint, **options)
    pairs = list(stream)
    assert len(pairs) == 12 * reuse * options.get("views_per_image", 1) and inpaint.pairs == len(pairs) // reuse
    for first in range(0, len(pairs), reuse):
        group = pairs[first : first + reuse]
        assert all(torch.equal(pixels_of(pair), pixels_of(group[0])) for pair in group)
        assert len({pair.left.numpy().tobytes() for pair in group}) == reuse
    inpaint.pairs = 0
    with stream.loader(batch_size, num_workers=2) as loader:
        batches = list(loader)
    made = by_index(batch[i] for batch in batches for i in range(batch_size))
    assert made == {place: value for place, value in by_index(pairs).items() if place in made}
    assert len(made) == len(pairs) // batch_size * batch_size and inpaint.pairs == -(-len(made) // reuse)
    assert fingerprint(stream.replay(0, 4)) == fingerprint(pairs[4])


@pytest.mark.parametrize("options", [{}, {"views_per_image": 2}, {"reuse": 2}, {"inpaint": "background"}], ids=str)
@pytest.mark.parametrize("workers", [0, 2])
def test_depth_on_the_device_gives_what_the_workers_give(tar, tmp_path, options, workers):
    plain = by_index(open_stream(tar, depth=CountingDepth(), **options))
    for cached in ({}, {"depth_cache": tmp_path}, {"depth_cache": tmp_path}):
        depth = CountingDepth()
        stream = open_stream(tar, depth=depth, depth_placement="device", **options, **cached)
        with stream.loader(3, num_workers=workers) as loader:
            assert by_index(batch[i] for batch in loader for i in range(3)) == plain
    assert depth.calls == 0, "the second time all depth was in the cache"


def test_a_pair_that_is_made_on_the_device_says_which_one_failed(tar):
    def fails(images):
        raise ValueError("no depth today")

    with pytest.raises(RuntimeError, match=r"sample \d+ of epoch 0 .*photos.tar.* failed: no depth today"):
        next(iter(open_stream(tar, depth=fails, depth_placement="device").loader(2)))


@pytest.mark.parametrize("device", ["cuda", "cuda:1"])
def test_a_gpu_that_is_not_there_is_told_when_the_loader_is_made(tar, device, monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    with pytest.raises(ValueError, match=rf'device="{device}", but PyTorch sees 0 GPUs here; device="cpu" needs none'):
        ZeroStereoStream(tar, depth=layered_depth, inpaint=grey_fill).loader(batch_size=1, num_workers=0, device=device)
