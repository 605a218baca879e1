import io
import os
import signal
from functools import partial

import numpy as np
import psutil
import pytest
import torch

from tests.hub_cache import COMMITS, run_offline, save_to_hub
from tests.scenes import jpeg, layered_depth, photo, photo_tar, write_tar
from trainers.inpaint_data.batches import making, requests
from trainers.inpaint_data.examples import SYMMETRIC_COLOUR, Example, from_photo, from_stereo, hidden_from_left
from trainers.inpaint_data.sources import ExampleBatch, Examples, PhotoSource, StereoSource
from trainers.inpaint_data.stored_maps import StereoFrame
from zsdata import ZeroStereoStream
from zsdata.augment import AugmentConfig
from zsdata.faults import BadPhoto, NoUsablePhoto, WorkerLost
from zsdata.seeding import rng
from zsdata.source.manifest import build_manifest
from zsdata.source.photo import decode_rgb
from zsdata.synthesis.disparity import AdaptiveDisparity
from zsdata.synthesis.view import ViewConfig
from zsdata.synthesis.warp import forward_warp


def hidden_row(disparity):
    """The definition, in the right view's own columns: True where the left camera does not see right pixel u.

    Right pixel u with disparity d lands at u + d in the left view and covers half a pixel each way; neighbours whose disparities differ by
    at most 1 px are one surface and also cover what lies between them. u is seen if the left column nearest to u + d lies in the image
    and shows nothing that is nearer by more than 1 px.
    """
    width = len(disparity)
    shown = np.full(width, -np.inf)  # of the nearest surface, in each left column
    for x in range(width):
        for u, d in enumerate(disparity):
            if abs(u + d - x) <= 0.5:
                shown[x] = max(shown[x], d)
            if u + 1 < width and abs(disparity[u + 1] - d) <= 1:
                ends = sorted((u + d, u + 1 + disparity[u + 1]))
                if ends[0] <= x <= ends[1]:
                    share = (x - u - d) / (1 + disparity[u + 1] - d) if ends[1] > ends[0] else 0.0
                    shown[x] = max(shown[x], d + share * (disparity[u + 1] - d))
    nearest = np.rint(np.arange(width) + disparity).astype(int)
    return np.array([not (x < width and shown[x] <= d + 1) for x, d in zip(nearest, disparity, strict=True)])


def scene(random, width=48):
    """One row of disparity: a slanted background with things before it."""
    disparity = random.uniform(0, 3) + np.linspace(0, random.uniform(0, 2), width)
    for _ in range(random.integers(1, 4)):
        start, length = random.integers(width), random.integers(1, 14)
        disparity[start : start + length] = random.uniform(3, 15) + random.uniform(-0.2, 0.2) * np.arange(
            len(disparity[start : start + length])
        )
    return disparity.clip(0.01).astype(np.float32)


def test_hidden_pixels_are_those_of_the_definition():
    random = np.random.default_rng(0)
    rows = np.stack([scene(random) for _ in range(150)])
    hidden = hidden_from_left(torch.from_numpy(rows)[None, None])[0, 0].numpy()
    assert np.array_equal(hidden, np.stack([hidden_row(row.astype(np.float64)) for row in rows]))
    assert 0.1 < hidden.mean() < 0.6


def test_behind_the_right_edge_of_a_thing_as_wide_as_it_stands_out_and_at_the_right_border():
    disparity = torch.full((1, 1, 2, 40), 2.0)
    disparity[..., 10:18] = 7.0
    hidden = hidden_from_left(disparity)[0, 0, 0].nonzero().flatten().tolist()
    assert hidden == [18, 19, 20, 21, 22, 38, 39]


def test_the_masked_pixels_are_those_that_a_warp_of_the_left_view_leaves_open():
    """A scene of fronto-parallel things seen by both cameras: the holes of the left view's warp are what the right view has hidden."""
    random = np.random.default_rng(1)
    width = 160
    for _ in range(30):
        left, right = np.full(width, 3.0, np.float32), np.full(width, 3.0, np.float32)
        for nearness in sorted(random.integers(6, 20, 3)):
            start = random.integers(25, 110)
            left[start : start + 15] = right[start - nearness : start - nearness + 15] = nearness
        holes = forward_warp(torch.zeros(1, 1, 1, width), torch.from_numpy(left)[None, None, None]).inpaint_mask
        assert torch.equal(hidden_from_left(torch.from_numpy(right)[None, None, None]), holes)


def drawing(seed=0, step=0, index=0):
    return partial(rng, seed, step, index)


def plain(monkeypatch):
    monkeypatch.setattr("trainers.inpaint_data.examples.SYMMETRIC_COLOUR", AugmentConfig.none())


def stereo(seed=0, height=40, width=64, disparity=5.0, right_disparity=None):
    """A pair of a wall with a thing before it: the right image is what a camera sees, what the left one cannot included."""
    scene = photo(seed, height, width + 30)
    left, right = scene[:, 10 : 10 + width].copy(), scene[:, 15 : 15 + width].copy()
    near = photo(seed + 1, 12, 14)
    left[14:26, 30:44], right[14:26, 18:32] = near, near
    truth = np.full((height, width), disparity, np.float32)
    truth[14:26, 30:44] = 12
    return StereoFrame(left, right, truth, right_disparity)


def test_a_stereo_example_shows_the_right_image_through_the_holes_of_the_warp(monkeypatch):
    plain(monkeypatch)
    frame = stereo()
    right, warped, inpaint_mask = from_stereo(frame, (40, 64), drawing())
    assert torch.equal(right[0].permute(1, 2, 0), torch.from_numpy(frame.right).float())
    assert not warped[inpaint_mask.expand_as(warped)].any()
    error = (warped - right).abs().masked_fill(inpaint_mask, 0)
    edge = torch.zeros(40, 64, dtype=torch.bool)
    edge[13:27, 16:34] = True  # the thing has grown by a pixel
    assert error.masked_fill(edge, 0).max() == 0 and error[..., 15:25, 19:31].max() == 0
    columns = inpaint_mask[0, 0, 20].nonzero().flatten().tolist()
    assert columns == [33, 34, 35, 36, 37, 38, 39, *range(59, 64)]


def test_what_nobody_knows_is_a_hole(monkeypatch):
    plain(monkeypatch)
    frame = stereo()
    frame.disparity[5, 20:25] = np.nan
    inpaint_mask = from_stereo(frame, (40, 64), drawing()).inpaint_mask
    assert inpaint_mask[0, 0, 5].nonzero().flatten().tolist() == [*range(15, 20), *range(59, 64)]


def test_a_crop_is_the_same_part_of_the_whole_and_lies_everywhere(monkeypatch):
    plain(monkeypatch)
    frame = stereo()
    whole, places = from_stereo(frame, (40, 64), drawing()), set()
    for index in range(60):
        part = from_stereo(frame, (24, 32), drawing(index=index))
        matches = [
            (top, left)
            for top in range(17)
            for left in range(33)
            if torch.equal(part.right, whole.right[..., top : top + 24, left : left + 32])
        ]
        assert len(matches) == 1
        top, left = matches[0]
        places.add(matches[0])
        for cut, uncut in zip(part, whole, strict=True):
            assert torch.equal(cut, uncut[..., top : top + 24, left : left + 32]), "the margins count"
    tops, lefts = zip(*places, strict=True)
    assert len(places) > 50 and min(tops) == 0 and max(tops) == 16 and min(lefts) <= 1 and max(lefts) >= 31


def test_cameras_change_places_in_a_mirror_where_both_truths_are_known(monkeypatch):
    plain(monkeypatch)
    frame = stereo(right_disparity=np.full((40, 64), 5, np.float32))
    there = [from_stereo(frame, (40, 64), drawing(index=index)) for index in range(20)]
    mirrored = [not torch.equal(example.right[0].permute(1, 2, 0), torch.from_numpy(frame.right).float()) for example in there]
    assert 4 < sum(mirrored) < 16
    example = there[mirrored.index(True)]
    assert torch.equal(example.right[0].permute(1, 2, 0), torch.from_numpy(frame.left[:, ::-1].copy()).float())
    outside = (example.warped - example.right).abs()[..., :12, :59]
    assert outside.max() == 0 and not example.inpaint_mask[..., :12, :59].any()


def test_a_small_pair_is_enlarged_with_its_disparity(monkeypatch):
    plain(monkeypatch)
    right, warped, inpaint_mask = from_stereo(stereo(), (80, 128), drawing())
    assert right.shape == (1, 3, 80, 128)
    assert inpaint_mask[0, 0, 0].nonzero().flatten().tolist() == list(range(118, 128))
    assert (warped - right).abs()[..., :20, :118].mean() < 1


def test_both_images_get_the_same_colours():
    flat = np.full((40, 64, 3), (200, 60, 20), np.uint8)
    frame = StereoFrame(flat, flat, np.full((40, 64), 5, np.float32), None)
    seen = set()
    for index in range(20):
        right, warped, inpaint_mask = from_stereo(frame, (32, 32), drawing(index=index))
        assert torch.allclose(warped, right.masked_fill(inpaint_mask, 0), atol=1e-3)
        seen.add(tuple(right[0, :, 0, 0].round().tolist()))
    assert len(seen) > 15
    assert SYMMETRIC_COLOUR.asymmetric_probability == 0 and SYMMETRIC_COLOUR.brightness == (0.6, 1.4)


def test_a_photo_is_the_truth_of_what_a_left_view_hides(monkeypatch):
    plain(monkeypatch)
    image = photo(3, 64, 96)
    inverse_depth = torch.zeros(1, 1, 64, 96)
    inverse_depth[..., 20:40, 30:50] = 1.0
    shares = []
    for index in range(40):
        draw = drawing(index=index)
        right, warped, inpaint_mask = from_photo(image, inverse_depth, AdaptiveDisparity(), (64, 96), draw)
        mirrored = draw("view").random() < 0.5
        truth = image[:, ::-1] if mirrored else image
        assert torch.equal(right[0].permute(1, 2, 0), torch.from_numpy(truth.copy()).float())
        assert torch.equal(warped, right.masked_fill(inpaint_mask, 0))
        nearest_px = AdaptiveDisparity().draw_scale(draw("disparity"), 96) * 96
        first = 97 - 30 if mirrored else 51  # the thing, a pixel larger, ends before
        hidden = inpaint_mask[0, 0, 30].nonzero().flatten()
        hidden = hidden[hidden < 90]
        assert hidden.tolist() == list(range(first, first + len(hidden))) and abs(len(hidden) - nearest_px) <= 1
        assert not inpaint_mask[0, 0, 10, :90].any()
        shares.append(mirrored)
    assert 10 < sum(shares) < 30


class QuarterOfTheWidth:
    """How far the nearest point always shifts."""

    def draw_scale(self, generator, width):
        return 0.25


def test_a_soft_edge_of_a_photos_depth_hides_what_a_sharp_one_in_its_middle_hides(monkeypatch):
    plain(monkeypatch)
    sharp, soft = torch.zeros(2, 1, 1, 64, 96)
    sharp[..., 20:40, 30:54] = 1
    rise = torch.arange(1, 7) / 7
    soft[..., 20:40, 27:57] = torch.cat([rise, torch.ones(18), rise.flip(0)])
    for index in range(4):
        one, other = (
            from_photo(photo(3, 64, 96), depth, QuarterOfTheWidth(), (64, 96), drawing(index=index)).inpaint_mask[0, 0, 30, :88]
            for depth in (soft, sharp)
        )
        assert torch.equal(one, other) and one.sum() in (20, 21, 24)


def a_thing_far_away(width=256):
    """A small thing before a background at infinity: only crops of its rows can show a hole, and few of them do."""
    near = np.zeros((64, width), np.float32)
    near[8:24, 100:116] = 1
    return photo(5, 64, width), near


def wide_photo_example(size, draw):
    image, near = a_thing_far_away()
    return from_photo(image, torch.from_numpy(near)[None, None], AdaptiveDisparity(), size, draw)


def test_holes_of_a_large_photo_are_no_wider_than_the_stream_makes_them():
    """The stream takes a photo of eight crops' width for one of two."""
    image = photo(0, 512, 768)
    bars = torch.zeros(1, 1, 512, 768)
    bars[..., 192:384] = bars[..., 576:] = 1
    widest = 0
    for index in range(12):
        mask = from_photo(image, bars, AdaptiveDisparity(), (64, 96), lambda purpose, index=index: rng(0, 0, index, purpose)).inpaint_mask
        edges = torch.nn.functional.pad(mask[0, 0].int(), (1, 1)).diff().nonzero()[:, 1].view(-1, 2)
        widest = max(widest, int((edges[:, 1] - edges[:, 0]).max()))
    assert 0 < widest <= 0.2 * 192


def wide_stereo_example(size, draw):
    image, near = a_thing_far_away()
    return from_stereo(StereoFrame(image, image, 0.01 + 12 * near, None), size, draw)


@pytest.mark.parametrize("make", [wide_photo_example, wide_stereo_example])
def test_a_crop_without_a_hole_makes_way_for_another_of_its_rows(monkeypatch, make):
    plain(monkeypatch)
    monkeypatch.setattr("trainers.inpaint_data.examples.STREAM_VIEW", ViewConfig(max_width=8))  # the photo stays as wide as it is
    stayed, empty, moved = 0, 0, set()
    for index in range(150):
        whole, part = (make(size, drawing(index=index)) for size in ((64, 256), (24, 32)))
        _, *place = drawing(index=index)("view").random(3)
        top, left = (int(share * count) for share, count in zip(place, (64 - 24 + 1, 256 - 32 + 1), strict=True))
        rows = [field[..., top : top + 24, :] for field in whole]
        if rows[2].any() and not rows[2][..., left : left + 32].any():
            (left,) = (new for new in range(225) if torch.equal(part.right, rows[0][..., new : new + 32]))
            assert part.inpaint_mask.any()
            moved.add(left)
        else:
            stayed, empty = stayed + 1, empty + (not rows[2].any())
        for cut, uncut in zip(part, rows, strict=True):
            assert torch.equal(cut, uncut[..., left : left + 32])
    assert stayed > empty > 0 and len(moved) > 20 and max(moved) - min(moved) > 30, "as likely wherever a hole is seen"


class Pairs:
    """Three pairs, of which one is broken."""

    digest = "pairs"

    def __init__(self, broken=()):
        self.broken = broken

    def __len__(self):
        return 3

    def place(self, index):
        return "somewhere", f"pair {index}"

    def read(self, index):
        if index in self.broken:
            raise BadPhoto("damaged map: nothing")
        return stereo(10 * index)


def test_an_example_is_a_function_of_seed_step_and_index(tmp_path):
    tar = photo_tar(tmp_path / "photos.tar", 5, height=48, width=64)

    def make(seed=0, batch_size=4):
        photos = PhotoSource(build_manifest(tar), layered_depth, AdaptiveDisparity())
        return Examples({"photos": photos, "pairs": StereoSource(Pairs())}, (32, 48), seed, batch_size)

    one, other = make(), make()
    for request in ((0, 0), (3, 1), (70, 2)):
        first, again = one[request], other[request]
        assert all(torch.equal(getattr(first, name), getattr(again, name)) for name in ("right", "warped", "inpaint_mask"))
        assert first.requests == [request] and first.meta == again.meta and first.right.dtype == torch.uint8
    assert not torch.equal(one[0, 0].right, make(seed=1)[0, 0].right)
    # every pair and photo once an epoch, whatever the batch size
    for batch_size in (2, 4):
        examples = make(batch_size=batch_size)
        for epoch in range(2):
            numbers = range(8 * epoch, 8 * epoch + 8)
            assert len({examples[divmod(number, batch_size)].meta[0]["key"] for number in numbers}) == 8


def test_every_example_draws_numbers_of_its_own_and_keeps_its_brightness():
    drawn = []

    class Grey:
        digest, models = "grey", {}

        def __len__(self):
            return 3

        def place(self, index):
            return "somewhere", str(index)

        def make(self, index, size, draw):
            drawn.append(draw("view").random())
            image = torch.full((1, 3, *size), 100.7)
            return Example(image, image, torch.zeros(1, 1, *size, dtype=torch.bool))

    examples = Examples({"grey": Grey()}, (32, 48), 0, 4)
    made = [examples[divmod(number, 4)] for number in range(24)]
    assert len(set(drawn)) == 24
    assert all((image == 101).all() for example in made for image in (example.right, example.warped))


def test_a_photos_holes_lie_where_its_depth_and_the_drawn_scale_say(tmp_path):
    def block(images):
        depth = torch.zeros_like(images[:, :1])
        depth[..., 12:36, 56:72] = 1
        return depth

    tar = photo_tar(tmp_path / "photos.tar", 1, height=48, width=128)
    source = PhotoSource(build_manifest(tar), block, QuarterOfTheWidth())
    for index in range(4):
        inpaint_mask = source.make(0, (48, 128), drawing(index=index)).inpaint_mask
        hidden = inpaint_mask[0, 0, 24].nonzero().flatten().tolist()
        assert hidden == list(range(55 + 32, 73 + 32)) and not inpaint_mask[0, 0, 4].any()  # the block, a pixel larger, shifts by 32


def test_a_broken_pair_is_replaced_and_told(tmp_path):
    examples = Examples({"pairs": StereoSource(Pairs(broken=(1,)))}, (32, 48), 0, 4)
    made = [examples[divmod(number, 4)] for number in range(30)]
    rejected = [example.rejected for example in made if example.rejected]
    assert 5 < len(rejected) <= 15 and all(entry == [("pairs", "somewhere", "pair 1", "damaged map: nothing")] for entry in rejected)
    assert {meta["key"] for example in made for meta in example.meta} == {"pair 0", "pair 2"}
    with pytest.raises(NoUsablePhoto, match="nothing usable for example 0 of step 0: 3 of pairs were refused"):
        Examples({"pairs": StereoSource(Pairs(broken=(0, 1, 2)))}, (32, 48), 0, 4)[0, 0]


def test_a_photo_that_shows_no_scene_is_refused(tmp_path):
    tar = write_tar(tmp_path / "a.tar", {"0.jpg": jpeg(photo(0, 20, 64))})
    examples = Examples({"photos": PhotoSource(build_manifest(tar), layered_depth, AdaptiveDisparity())}, (32, 48), 0, 1)
    with pytest.raises(NoUsablePhoto, match="too small"):
        examples[0, 0]


def test_depth_stored_beside_the_photos_gives_the_examples_of_the_estimator_that_made_it(tmp_path):
    photos = {f"{number}.jpg": jpeg(photo(number, 48, 64)) for number in range(3)}
    maps = {}
    for name, data in photos.items():
        image = torch.from_numpy(decode_rgb(data)).permute(2, 0, 1)[None].float()
        stored = io.BytesIO()
        np.save(stored, layered_depth(image)[0, 0].numpy())
        maps[name.replace("jpg", "depth.npy")] = stored.getvalue()

    def made(depth, members):
        source = PhotoSource(build_manifest(write_tar(tmp_path / "a.tar", members)), depth, AdaptiveDisparity())
        examples = Examples({"photos": source}, (32, 48), 0, 4)
        return [examples[0, number] for number in range(4)]

    for one, other in zip(made("stored", photos | maps), made(layered_depth, photos), strict=True):
        assert torch.equal(one.warped, other.warped) and torch.equal(one.inpaint_mask, other.inpaint_mask)
    maps.pop("1.depth.npy")
    assert {reject[2:] for example in made("stored", photos | maps) for reject in example.rejected} == {
        ("1", "no stored depth: neither 1.depth.npy nor 1.depth.png; add one, or let depth be estimated")
    }
    with pytest.raises(ValueError, match="not one of the 3 photos"):
        made("stored", photos)


def test_the_depth_of_photos_stays_at_its_commit_and_a_run_is_not_resumed_with_another(tmp_path):
    small = pytest.importorskip("tests.small_depth_networks")
    main = save_to_hub(tmp_path, "somebody/depth", lambda number, path: small.save_small_network("depth_anything", path, seed=number))
    tar = photo_tar(tmp_path / "photos.tar", 2, height=64, width=96)
    program = f"""
from pathlib import Path
import torch
from trainers.inpaint_data.sources import Examples, PhotoSource
from zsdata import AdaptiveDisparity, DepthNetwork
from zsdata.position import Position
from zsdata.source.manifest import build_manifest

def examples(**options):
    depth = DepthNetwork("somebody/depth", **options)
    return Examples({{"photos": PhotoSource(build_manifest({str(tar)!r}), depth, AdaptiveDisparity())}}, (32, 48), 0, 2)

first = examples()
Path({str(main)!r}).write_text({COMMITS[1]!r})
second, again = examples(), examples(revision={COMMITS[0]!r})
masks = [[one[0, number].inpaint_mask for number in range(2)] for one in (first, second, again)]
assert all(map(torch.equal, masks[0], masks[2])) and not all(map(torch.equal, masks[0], masks[1]))
Position.from_state(first.position(1).to_state(), again.position(1))
try:
    Position.from_state(first.position(1).to_state(), second.position(1))
    raise SystemExit("another commit was taken")
except ValueError as error:
    assert "somebody/depth@{COMMITS[0]}" in str(error), error
"""
    run_offline(program, tmp_path)


def test_a_strip_is_replaced_before_a_depth_network_sees_it_enlarged(tmp_path):
    small = pytest.importorskip("tests.small_depth_networks")
    network = small.save_small_network("depth_anything", tmp_path / "network")
    members = {"a.jpg": jpeg(photo(1, 48, 64)), "strip.jpg": jpeg(photo(2, 48, 400))}
    source = PhotoSource(build_manifest(write_tar(tmp_path / "a.tar", members)), network, AdaptiveDisparity())
    examples = Examples({"photos": source}, (32, 48), 0, 2)
    rejected = [reject for number in range(2) for reject in examples[0, number].rejected]
    assert [(key, reason.split(":")[0]) for _, _, key, reason in rejected] == [("strip", "too long for the depth network")]


def test_a_crop_of_a_strip_that_is_more_hole_than_picture_is_refused(tmp_path):
    """The strip is enlarged seven times: what is hidden is wider than the crop."""
    depth = torch.zeros(1, 1, 32, 1600)
    depth[..., 800:] = 1
    refused = 0
    for index in range(30):
        try:
            mask = from_photo(photo(2, 32, 1600), depth, QuarterOfTheWidth(), (224, 96), drawing(index=index)).inpaint_mask
            assert mask.float().mean() <= 0.5
        except BadPhoto as fault:
            assert fault.reason.startswith("too many holes: ")
            refused += 1
    assert 0 < refused < 30


def test_depth_is_estimated_once_and_a_stream_may_have_done_it(tmp_path):
    tar, calls = photo_tar(tmp_path / "photos.tar", 3, height=64, width=96), []

    def estimator(images):
        calls.append(len(images))
        return layered_depth(images)

    estimator.cache_name = "layered"

    def made(cache=None, depth=estimator):
        examples = Examples({"photos": PhotoSource(build_manifest(tar), depth, AdaptiveDisparity(), cache)}, (32, 48), 0, 3)
        return [examples[step, number] for step in range(2) for number in range(3)]

    without, first, estimated = made(), made(tmp_path / "cache"), len(calls)
    again = made(tmp_path / "cache")
    assert estimated == 6 + 2 * 3 and len(calls) == estimated  # once per epoch without; once with, and mirrored
    for one, other, third in zip(without, first, again, strict=True):
        assert torch.equal(one.inpaint_mask, other.inpaint_mask) and torch.equal(other.right, third.right)
    for pair in ZeroStereoStream(tar, size=(32, 48), depth=estimator, depth_cache=tmp_path / "of a stream"):
        assert pair is not None
    estimated = len(calls)
    made(tmp_path / "of a stream")
    assert len(calls) == estimated
    with pytest.raises(ValueError, match="a depth cache would keep it a second time"):
        made(tmp_path / "cache", "stored")


def test_a_depth_network_that_is_nowhere_is_named_at_once(tmp_path):
    manifest = build_manifest(photo_tar(tmp_path / "a.tar", 1))
    with pytest.raises(FileNotFoundError, match='depth="/no/such" is neither'):
        PhotoSource(manifest, "/no/such", AdaptiveDisparity())


def test_an_error_names_its_example(tmp_path):
    def broken(images):
        raise ZeroDivisionError("no depth")

    source = PhotoSource(build_manifest(photo_tar(tmp_path / "a.tar", 1)), broken, AdaptiveDisparity())
    with pytest.raises(RuntimeError, match=r'example 1 of step 2 \("000000" in .*a.tar\) failed: no depth'):
        Examples({"photos": source}, (32, 48), 0, 4)[2, 1]


@pytest.mark.parametrize(("world_size", "micro_batch"), [(1, 1), (1, 8), (2, 2), (4, 2), (2, 4)])
def test_all_ranks_together_get_every_example_of_a_step_once(world_size, micro_batch):
    ranks = [list(requests(3, 5, 8, micro_batch, rank, world_size)) for rank in range(world_size)]
    assert all(len(batches) == 2 * 8 // (world_size * micro_batch) for batches in ranks)
    assert sorted(request for batches in ranks for batch in batches for request in batch) == [(s, i) for s in (3, 4) for i in range(8)]


def test_the_position_tells_other_data_and_other_options_apart(tmp_path):
    def place(size=(32, 48), seed=0, batch_size=4, pairs=None, step=7):
        return Examples({"pairs": StereoSource(pairs or Pairs())}, size, seed, batch_size).position(step)

    other = Pairs()
    other.digest = "other pairs"
    assert (place().epoch, place().samples) == (9, 1)
    assert place(seed=1).seed != place().seed
    assert place(pairs=other).manifest != place().manifest
    assert len({place().configuration, place(size=(48, 32)).configuration, place(batch_size=2).configuration}) == 3


def test_batches_stack_in_order():
    parts = [
        ExampleBatch(
            torch.full((1, 3, 2, 2), i, dtype=torch.uint8), torch.zeros(1, 3, 2, 2), torch.zeros(1, 1, 2, 2) > 0, [(0, i)], [{"key": i}], []
        )
        for i in range(3)
    ]
    batch = ExampleBatch.stack(parts)
    assert batch.right[:, 0, 0, 0].tolist() == [0, 1, 2] and batch.requests == [(0, 0), (0, 1), (0, 2)]
    assert [meta["key"] for meta in batch.meta] == [0, 1, 2]


@pytest.mark.parametrize("workers", [0, 2])
def test_batches_are_the_same_whoever_makes_them_and_come_in_the_order_of_their_steps(workers):
    examples = Examples({"pairs": StereoSource(Pairs())}, (32, 48), 0, 4)
    with making(examples, requests(1, 4, 4, 2, 0, 1), workers, torch.device("cpu")) as batches:
        made = list(batches)
    assert [batch.requests for batch in made] == [[(step, index), (step, index + 1)] for step in (1, 2, 3) for index in (0, 2)]
    for batch in made:
        assert torch.equal(batch.right, torch.cat([examples[request].right for request in batch.requests]))
    assert [(meta["epoch"], meta["index"]) for meta in made[0].meta] == [(1, 1), (1, 2)]  # the fifth example and the sixth


def test_what_goes_wrong_in_a_worker_arrives_as_itself_and_in_one_line():
    before = set(psutil.Process().children())  # of other tests: Python's fork server stays
    nothing = Examples({"pairs": StereoSource(Pairs(broken=(0, 1, 2)))}, (32, 48), 0, 4)
    with making(nothing, requests(0, 4, 4, 2, 0, 1), 1, torch.device("cpu")) as batches:
        with pytest.raises(NoUsablePhoto, match=r"^nothing usable for example 0 of step 0: 3 of pairs were refused, .*$"):
            next(batches)

    class Killing(Pairs):
        def read(self, index):
            os.kill(os.getpid(), signal.SIGKILL)

    killing = Examples({"pairs": StereoSource(Killing())}, (32, 48), 0, 4)
    with making(killing, requests(2, 4, 4, 2, 0, 1), 1, torch.device("cpu")) as batches:
        with pytest.raises(WorkerLost, match=r"worker 0 of 1 .* was killed by SIGKILL; it was at sample 2 of epoch 2.*memory runs out"):
            next(batches)
    assert set(psutil.Process().children()) <= before
