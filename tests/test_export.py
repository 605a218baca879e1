"""Export: the published layout, and that no stop at any moment shows in the outcome."""

import fcntl
import io
import json
import multiprocessing
import os
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from zsdata import AugmentConfig, UniformDisparity, ZeroStereoStream, export, exported
from zsdata.export import export_pairs
from zsdata.exported import load_exported, pair_name, place_name, read_exported

from .hub_cache import COMMITS, run_offline, save_to_hub
from .scenes import grey_fill, jpeg, layered_depth, photo, photo_tar, write_tar

PUBLISHED_FOLDERS = {
    "left": ".jpg",
    "right": ".png",
    "disparity": ".npy",
    "confidence": ".npy",
    "mask_nocc": ".png",
    "mask_inpaint": ".png",
}
SIZE = (64, 96)


def stream_of(shard, **options):
    options = {"size": SIZE, "depth": layered_depth, "inpaint": grey_fill, "augmentation": AugmentConfig.none(), **options}
    return ZeroStereoStream(str(shard), **options)


@pytest.fixture
def shard(tmp_path):
    return photo_tar(tmp_path / "photos.tar", count=3)


@pytest.fixture
def stream(shard):
    return stream_of(shard)


def read_as_published(root, line):
    """One line of a file list, read as the published data set class does before it augments: all float32, masks and valid 0 or 1."""
    left, right, disparity, confidence, nonocclusion, inpaint = (os.path.join(root, name) for name in line.split(" "))
    images = [np.array(Image.open(path).convert("RGB")).astype(np.float32) for path in (left, right)]
    labels = [np.array(np.load(path)).astype(np.float32) for path in (disparity, confidence)]
    masks = [(np.array(Image.open(path).convert("L")) == 255).astype(np.float32) for path in (nonocclusion, inpaint)]
    return *images, *labels, *masks, (labels[0] > 0).astype(np.float32)


def tree(folder):
    """Every file below a folder, by path: its bytes."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(Path(folder).rglob("*")) if path.is_file()}


def lines_of(folder):
    text = (folder / "filelist.txt").read_text() if (folder / "filelist.txt").exists() else ""
    assert text == "" or text.endswith("\n")
    return text.splitlines()


def test_the_published_reader_gets_the_pairs_of_the_stream(stream, tmp_path):
    export_pairs(stream, tmp_path / "out")
    lines = lines_of(tmp_path / "out")
    assert len(lines) == 3
    for index, line in enumerate(lines):
        pair = stream.replay(0, index)
        left, right, disparity, confidence, nonocclusion, inpaint, valid = read_as_published(tmp_path / "out", line)
        difference = np.abs(left - pair.left_clean.permute(1, 2, 0).numpy())
        assert difference.mean() < 1 and difference.max() <= 11
        assert np.array_equal(right, pair.right_clean.round().permute(1, 2, 0).numpy())
        assert np.array_equal(disparity, pair.disparity[0].numpy())
        assert np.array_equal(confidence, pair.confidence[0].numpy())
        assert np.array_equal(nonocclusion, pair.masks.nonocclusion[0].float().numpy()) and 0 < nonocclusion.mean() < 1
        assert np.array_equal(inpaint, pair.masks.inpaint[0].float().numpy()) and 0 < inpaint.mean() < 1
        assert np.array_equal(valid, pair.masks.valid[0].float().numpy())


def test_the_published_photometric_mask_comes_out_of_the_written_masks(stream, tmp_path):
    """Where the reader's masks say "visible, and not invented", the right image shows the left pixel."""
    export_pairs(stream, tmp_path / "out", pairs=1)
    left, right, disparity, _, nonocclusion, inpaint, _ = read_as_published(tmp_path / "out", lines_of(tmp_path / "out")[0])
    y, x = np.nonzero(nonocclusion)
    target = np.rint(x - disparity[y, x]).astype(int)
    assert not inpaint[y, target].any()
    assert np.abs(left[y, x] - right[y, target]).mean() < 6 < np.abs(left[y, x] - right[y, x]).mean()


def test_files_are_stored_as_the_published_ones(stream, tmp_path):
    export_pairs(stream, tmp_path / "out", pairs=1)
    (line,) = lines_of(tmp_path / "out")
    files = line.split(" ")
    assert {file.partition("/")[0]: Path(file).suffix for file in files} == PUBLISHED_FOLDERS
    assert len({Path(file).stem for file in files}) == 1
    for file in files:
        path = tmp_path / "out" / file
        if path.suffix == ".npy":
            array = np.load(path, allow_pickle=False)
            assert (array.dtype, array.shape) == (np.float32, SIZE)
        else:
            with Image.open(path) as image:
                assert (image.size, image.mode) == ((96, 64), "L" if "mask" in file else "RGB")
                assert image.format == ("JPEG" if path.suffix == ".jpg" else "PNG")
                if "mask" in file:
                    assert set(np.unique(np.array(image))) == {0, 255}


def test_the_jpeg_keeps_full_colour_resolution(stream, tmp_path):
    export_pairs(stream, tmp_path / "out", pairs=1)
    (pair,) = read_exported(tmp_path / "out")
    with Image.open(pair.left) as image:
        assert [sampling[1:3] for sampling in image.layer] == [(1, 1)] * 3  # 4:4:4


def test_what_is_written_comes_back(stream, tmp_path):
    export_pairs(stream, tmp_path / "out")
    entries = read_exported(tmp_path / "out")
    assert len(entries) == 3
    for index, entry in enumerate(entries):
        pair = stream.replay(0, index)
        left, right, disparity, confidence, nonocclusion, inpaint = load_exported(entry)
        assert left.dtype == right.dtype == np.uint8 and disparity.dtype == confidence.dtype == np.float32
        assert nonocclusion.dtype == inpaint.dtype == bool
        assert np.abs(left - pair.left_clean.permute(1, 2, 0).numpy()).mean() < 1
        assert np.array_equal(right, pair.right_clean.round().byte().permute(1, 2, 0).numpy())
        for array, tensor in zip(
            (disparity, confidence, nonocclusion, inpaint),
            (pair.disparity, pair.confidence, pair.masks.nonocclusion, pair.masks.inpaint),
            strict=True,
        ):
            assert np.array_equal(array, tensor[0].numpy())
        torch.from_numpy(left)  # no negative stride


def test_each_pair_has_its_own_meta(shard, tmp_path):
    stream = stream_of(shard, seed=4)
    export_pairs(stream, tmp_path / "out", pairs=2, epoch=3)
    for index, entry in enumerate(read_exported(tmp_path / "out")):
        meta = json.loads((tmp_path / "out" / "meta" / f"{entry.left.stem}.json").read_text())
        expected = stream.replay(3, index).meta
        assert meta == {**expected, "shard": "photos.tar"}
        assert entry.left.stem == f"e003-i000000{index}-photos-photos-{expected['key']}"


def test_pairs_go_on_into_the_next_epoch_and_the_last_argument_is_one_pass(stream, tmp_path):
    assert export_pairs(stream, tmp_path / "one").pairs == 3
    export_pairs(stream, tmp_path / "more", pairs=7, epoch=1)
    assert [line[len("left/") :][:14] for line in lines_of(tmp_path / "more")] == [
        place_name(epoch, index)[:14] for epoch, index in ((1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2), (3, 0))
    ]
    assert stream.state_dict()["samples"] == 0


@pytest.mark.parametrize("workers", [0, 1])
def test_whole_photos_keep_their_own_sizes(tmp_path, workers):
    photos = {f"{height}x{width}": jpeg(photo(height, height, width)) for height, width in ((64, 96), (97, 63), (120, 160))}
    shard = write_tar(tmp_path / "a.tar", {f"{name}.jpg": data for name, data in photos.items()})
    export_pairs(stream_of(shard, size=None), tmp_path / "out", workers=workers)
    entries = read_exported(tmp_path / "out")
    assert len(entries) == 3
    for entry in entries:
        with Image.open(io.BytesIO(photos[json.loads(exported.meta_file(entry).read_text())["key"]])) as opened:
            original = np.array(opened)
        loaded = load_exported(entry)
        assert all(array.shape[:2] == original.shape[:2] for array in loaded)
        assert np.abs(loaded.left.astype(float) - original).mean() < 1


def test_workers_change_no_byte(shard, tmp_path):
    for workers in (0, 2):
        export_pairs(stream_of(shard), tmp_path / str(workers), workers=workers)
    assert tree(tmp_path / "0") == tree(tmp_path / "2")


class Killed(BaseException):
    """As if the process were gone."""


def kill_after(steps, monkeypatch):
    """Lets that many changes of the disk happen; the next one happens by half, and all later ones (the clean-up) do not at all."""
    changes = iter(range(steps))
    write_bytes, rename, add = Path.write_bytes, os.replace, export._FileList.add

    def step(half):
        if next(changes, None) is None:
            monkeypatch.setattr(Path, "unlink", lambda *args, **options: None)
            half()
            raise Killed

    def killed_write(path, content):
        step(lambda: write_bytes(path, content[: len(content) // 2]))
        return write_bytes(path, content)

    def killed_replace(source, target):
        step(lambda: None)
        rename(source, target)

    def killed_add(file_list, line):
        step(lambda: os.write(file_list._file.fileno(), line[: len(line) // 2].encode()))
        add(file_list, line)

    for owner, name, fake in ((Path, "write_bytes", killed_write), (os, "replace", killed_replace), (export._FileList, "add", killed_add)):
        monkeypatch.setattr(owner, name, fake)


def test_a_run_that_is_killed_at_any_moment_goes_on_where_it_stopped(shard, tmp_path):
    stream = stream_of(shard, size=(32, 32))
    export_pairs(stream, tmp_path / "unbroken", pairs=4)
    expected = tree(tmp_path / "unbroken")
    steps = 2 * len(expected) + 4 - 2  # a write and a rename per file but the list, and its four lines
    for first in range(steps):
        folder = tmp_path / f"killed-{first}"
        with pytest.MonkeyPatch.context() as patch, pytest.raises(Killed):
            kill_after(first, patch)
            export_pairs(stream, folder, pairs=4)
        left = tree(folder)
        final = {name: content for name, content in left.items() if not name.endswith(".partial") and name != "filelist.txt"}
        assert final.items() <= expected.items()  # no half file under a final name
        whole_lines = left.get("filelist.txt", b"").decode().splitlines(keepends=True)
        for line in whole_lines:
            if line.endswith("\n"):
                assert all(name in final for name in line.split())
        report = export_pairs(stream, folder, pairs=4)
        assert tree(folder) == expected
        assert report.already_there == sum(line.endswith("\n") for line in whole_lines)
    with pytest.MonkeyPatch.context() as patch:
        kill_after(steps, patch)
        export_pairs(stream, tmp_path / "survivor", pairs=4)  # there were no more moments than these


def test_a_second_run_of_a_finished_export_changes_nothing(stream, tmp_path):
    export_pairs(stream, tmp_path / "out")
    written = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("e*-i*")}
    before = tree(tmp_path / "out")
    report = export_pairs(stream, tmp_path / "out")
    assert (report.pairs, report.already_there) == (3, 3)
    assert {path: path.stat().st_mtime_ns for path in written} == written and len(written) == 21
    assert tree(tmp_path / "out") == before


def test_the_report_counts_bytes_and_replaced_photos_of_all_runs(tmp_path):
    good = jpeg(photo(0))
    shard = write_tar(tmp_path / "a.tar", {"0.jpg": good, "1.jpg": good[:900], "2.jpg": b"<html>", "3.jpg": good})
    stream = stream_of(shard)
    report = export_pairs(stream, tmp_path / "out")
    assert (report.pairs, report.already_there) == (4, 0) and len(list(stream)) == 4
    assert report.replaced == stream.stats()["rejected"] and report.replaced.keys() == {"truncated", "not a JPEG, PNG or WebP"}
    assert report.bytes == sum(len(data) for name, data in tree(tmp_path / "out").items() if "/" in name)
    again = export_pairs(stream, tmp_path / "out")
    assert (again.replaced, again.bytes) == (report.replaced, report.bytes)


@pytest.mark.parametrize(
    ("options", "arguments", "named"),
    [
        ({"seed": 1}, {}, "seed was 0 and is 1"),
        ({}, {"pairs": 2}, "pairs was 3 and is 2"),
        ({}, {"epoch": 1}, "epoch was 0 and is 1"),
        ({"size": (64, 64)}, {"settings": {"size": (64, 64)}}, "size was [64, 96] and is [64, 64]"),
        ({"disparity": UniformDisparity()}, {}, "an option of the stream is another"),
    ],
)
def test_an_export_made_with_other_arguments_is_refused_with_the_difference(shard, tmp_path, options, arguments, named):
    settings = {"size": SIZE}
    export_pairs(stream_of(shard), tmp_path / "out", settings=settings)
    before = tree(tmp_path / "out")
    with pytest.raises(ValueError, match="other arguments") as raised:
        export_pairs(stream_of(shard, **options), tmp_path / "out", **{"settings": settings, **arguments})
    assert f"other arguments: {named}. " in str(raised.value).replace(" (size, depth, inpaint, disparity, view, augmentation, ...)", "")
    assert tree(tmp_path / "out") == before


def test_an_export_does_not_go_on_with_a_model_that_has_moved(shard, tmp_path):
    small = pytest.importorskip("tests.small_depth_networks")
    main = save_to_hub(tmp_path, "somebody/depth", lambda number, path: small.save_small_network("depth_anything", path, seed=number))
    program = f"""
from pathlib import Path
from zsdata import AugmentConfig, ZeroStereoStream
from zsdata.export import export_pairs

def export(pairs, name="somebody/depth"):
    stream = ZeroStereoStream({str(shard)!r}, size={SIZE}, depth=name, augmentation=AugmentConfig.none())
    return export_pairs(stream, {str(tmp_path / "out")!r}, pairs=pairs)

export(2)
Path({str(main)!r}).write_text({COMMITS[1]!r})
try:
    export(2)
    raise SystemExit("two models in one export")
except ValueError as error:
    assert "{COMMITS[0]}" in str(error) and "{COMMITS[1]}" in str(error) and "owner/name@commit" in str(error), error
assert export(2, "somebody/depth@{COMMITS[0]}").already_there == 2
"""
    run_offline(program, tmp_path)


def test_an_export_of_other_photos_or_by_another_version_is_refused(shard, tmp_path, monkeypatch):
    export_pairs(stream_of(shard), tmp_path / "out", pairs=1)
    other = photo_tar(tmp_path / "other.tar", count=3)
    with pytest.raises(ValueError, match="other arguments: the photos, or their order, are others"):
        export_pairs(stream_of(other), tmp_path / "out", pairs=1)
    monkeypatch.setattr("zsdata.__version__", "9.9")
    with pytest.raises(ValueError, match=r'zsdata was "[0-9.]+" and is "9.9"'):
        export_pairs(stream_of(shard), tmp_path / "out", pairs=1)


def test_the_same_shards_elsewhere_give_and_continue_the_same_export(shard, tmp_path):
    export_pairs(stream_of(shard), tmp_path / "out")
    (tmp_path / "moved").mkdir()
    os.rename(shard, tmp_path / "moved" / "photos.tar")
    moved = stream_of(tmp_path / "moved" / "photos.tar")
    assert export_pairs(moved, tmp_path / "out").already_there == 3
    export_pairs(moved, tmp_path / "again")
    assert tree(tmp_path / "again") == tree(tmp_path / "out")
    assert str(tmp_path).encode() not in b"".join(tree(tmp_path / "out").values())


def test_foreign_files_stay_as_they_are(stream, tmp_path):
    foreign = {"notes.txt": b"mine", "holiday/left/0.jpg": b"a photo", "right.png": b"also mine"}
    for name, content in foreign.items():
        (tmp_path / "out" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "out" / name).write_bytes(content)
    export_pairs(stream, tmp_path / "out", pairs=1)
    (tmp_path / "out" / "left" / "later.jpg").write_bytes(b"later")
    export_pairs(stream, tmp_path / "out", pairs=1)
    assert {**foreign, "left/later.jpg": b"later"}.items() <= tree(tmp_path / "out").items()


@pytest.mark.parametrize("name", ["filelist.txt", "left/0.jpg", "meta/0.json", "export.json"])
def test_a_folder_with_another_data_set_in_it_is_refused(stream, tmp_path, name):
    (tmp_path / "out" / name).parent.mkdir(parents=True)
    (tmp_path / "out" / name).write_bytes(b"a data set")
    before = tree(tmp_path / "out")
    with pytest.raises((FileExistsError, ValueError), match="choose another folder"):
        export_pairs(stream, tmp_path / "out")
    assert tree(tmp_path / "out") == before
    with pytest.raises(NotADirectoryError, match="not a folder"):
        export_pairs(stream, tmp_path / "out" / name)


@pytest.mark.parametrize("damage", ["missing", "empty"])
def test_a_listed_pair_that_lost_a_file_is_made_again(stream, tmp_path, damage):
    export_pairs(stream, tmp_path / "out")
    before = tree(tmp_path / "out")
    right = read_exported(tmp_path / "out")[1].right
    right.unlink()
    if damage == "empty":
        right.write_bytes(b"")
    assert export_pairs(stream, tmp_path / "out").already_there == 1
    assert tree(tmp_path / "out") == before


def test_a_list_that_was_changed_by_hand_is_refused(stream, tmp_path):
    export_pairs(stream, tmp_path / "out")
    path = tmp_path / "out" / "filelist.txt"
    first, second, third = path.read_text().splitlines(keepends=True)
    for lines in ((second, third), (first, first, third), (first.replace("right/", "left/"), second, third), (first, "\n", third)):
        path.write_text("".join(lines))
        with pytest.raises(ValueError, match=r"filelist\.txt, line \d"):
            export_pairs(stream, tmp_path / "out")
        assert path.read_text() == "".join(lines)


def _hold(folder, held, done):
    with open(folder / "filelist.txt", "a+b") as file:
        fcntl.lockf(file, fcntl.LOCK_EX)
        held.set()
        done.wait(60)


def test_two_exports_do_not_write_into_one_folder(stream, tmp_path):
    export_pairs(stream, tmp_path / "out", pairs=1)
    context = multiprocessing.get_context("fork")
    held, done = context.Event(), context.Event()
    process = context.Process(target=_hold, args=(tmp_path / "out", held, done))
    process.start()
    try:
        assert held.wait(60)
        with pytest.raises(BlockingIOError, match="another process is exporting"):
            export_pairs(stream, tmp_path / "out", pairs=1)
    finally:
        done.set()
        process.join()
    assert export_pairs(stream, tmp_path / "out", pairs=1).already_there == 1


def test_a_disk_that_fills_up_leaves_only_whole_pairs_in_the_list(stream, tmp_path, monkeypatch):
    export_pairs(stream, tmp_path / "out", pairs=1)
    (line,) = lines_of(tmp_path / "out")
    with export._FileList(tmp_path / "out") as file_list:

        class Full:
            def __getattr__(self, name):
                return getattr(file, name)

            def write(self, content):
                return file.write(content[:7])

        file, file_list._file = file_list._file, Full()
        with pytest.raises(OSError, match="No space left") as raised:
            file_list.add(line)
    assert raised.value.filename.endswith("filelist.txt") and lines_of(tmp_path / "out") == [line]


@given(
    st.dictionaries(st.sampled_from(["source", "shard", "key"]), st.text(max_size=400), min_size=3),
    st.integers(0, 10**5),
    st.integers(0, 10**9),
)
def test_a_name_is_safe_whatever_the_key_is(parts, epoch, index):
    name = pair_name({**parts, "epoch": epoch, "index": index})
    assert re.fullmatch(r"[A-Za-z0-9_-]{1,230}", name) and name.startswith(place_name(epoch, index))
    assert len(exported.file_list_line(name).split(" ")) == 6


def test_the_name_of_a_long_key_ends_as_the_key_does():
    meta = {"source": "photos", "shard": "a.tar", "epoch": 0, "index": 0}
    folder = "a-folder-of-a-long-name/" * 10
    names = [pair_name({**meta, "key": f"{folder}{number:06d}"}) for number in range(2)]
    assert [name[-7:] for name in names] == ["_000000", "_000001"]


def test_colours_between_two_levels_are_rounded(stream):
    pair = next(iter(stream))
    colours = pair.right_clean.round().clamp(1, 254)
    files = exported.encode_pair(replace(pair, right_clean=colours - 0.4))
    (png,) = [content for path, content in files.items() if path.startswith("right/")]
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(png))), colours.permute(1, 2, 0).byte().numpy())


def test_settings_that_a_later_run_does_not_name_are_refused(stream, tmp_path):
    export_pairs(stream, tmp_path / "pairs", pairs=1, settings={"size": [64, 96]})
    with pytest.raises(ValueError, match=r"size was \[64, 96\] and is null"):
        export_pairs(stream, tmp_path / "pairs", pairs=1)


def test_a_file_that_cannot_be_finished_leaves_nothing_behind(tmp_path, monkeypatch):
    def fails(*paths):
        raise OSError("out of luck")

    monkeypatch.setattr("os.replace", fails)
    with pytest.raises(OSError, match="out of luck"):
        export.write_whole(tmp_path / "a.png", b"content")
    assert not any(tmp_path.iterdir())


def test_a_key_that_is_a_path_out_of_the_folder_stays_inside(tmp_path):
    shard = write_tar(tmp_path / "a b.tar", {"../../ev il\n'$x.jpg": jpeg(photo(0))})
    stream = stream_of(shard)
    export_pairs(stream, tmp_path / "deep" / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a b.tar", "deep"]
    (entry,) = read_exported(tmp_path / "deep" / "out")
    assert load_exported(entry).left.shape == (*SIZE, 3)
    assert json.loads(exported.meta_file(entry).read_text())["key"] == stream.replay(0, 0).meta["key"]


def test_the_reader_says_in_words_what_is_wrong(stream, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"filelist\.txt does not exist"):
        read_exported(tmp_path)
    export_pairs(stream, tmp_path / "out", pairs=1)
    (entry,) = read_exported(tmp_path / "out")
    entry.right.write_bytes(b"no image")
    with pytest.raises(ValueError, match=r"right.*damaged"):
        load_exported(entry)
    entry.right.unlink()
    with pytest.raises(FileNotFoundError, match=r"right.*does not exist"):
        load_exported(entry)
    (tmp_path / "filelist.txt").write_text("left/a.jpg right/a.png\n")
    with pytest.raises(ValueError, match=r"filelist\.txt, line 1: a pair has 6 paths"):
        read_exported(tmp_path)


def test_a_pair_too_large_for_a_jpeg_is_refused_in_words(stream):
    pair = stream.replay(0, 0)
    wide = torch.zeros(3, 1, 65_501)
    with pytest.raises(ValueError, match=r"65,501 x 1 px .*--size"):
        exported.encode_pair(replace(pair, left_clean=wide))


def test_opencv_writes_what_pillow_reads_in_colour(stream):
    """A swap of red and blue would look plausible and be wrong."""
    pair = stream.replay(0, 0)
    red = torch.zeros(3, *SIZE)
    red[0] = 255
    files = exported.encode_pair(replace(pair, left_clean=red, right_clean=red))
    for content in list(files.values())[:2]:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        assert (image[..., 2] > 250).all() and (image[..., :2] < 5).all()
