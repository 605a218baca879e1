import argparse

import pytest

from tests.scenes import photo_tar
from trainers.arguments import add_training_arguments, labels_are_trusted, open_stream

pytestmark = pytest.mark.filterwarnings("ignore:The built-in depth")


def parsed(*words):
    parser = argparse.ArgumentParser()
    add_training_arguments(parser)
    return parser.parse_args([*words, "--output", "run"])


@pytest.fixture
def tar(tmp_path):
    return photo_tar(tmp_path / "photos.tar", 3)


def test_the_streams_options_reach_the_stream(tar, tmp_path):
    stream = open_stream(parsed("--sources", tar, "--views-per-image", "2", "--reuse", "3", "--size", "64", "96"))
    assert len(stream) == 18
    named = open_stream(parsed("--sources", f"indoor={tar}@0.5", f"street={tar}@1.5", "--epoch-size", "8"))
    assert len(named) == 8 and named.state_dict() != stream.state_dict()
    cached = open_stream(parsed("--sources", tar, "--depth-cache", str(tmp_path / "depth")))
    assert len(cached) == 3 and (tmp_path / "depth").is_dir()


def test_labels_are_trusted_where_nothing_tells_their_confidence():
    trusted = [labels_are_trusted(parsed("--sources", "a.tar", *words)) for words in ((), ("--no-confidence",), ("--depth", "stored"))]
    assert trusted == [False, True, True]


def test_a_diffusion_network_takes_its_steps_and_its_subfolder(tar):
    model = ("--inpaint", "Windsrain/ZeroStereo", "--inpaint-subfolder", "StereoGen", "--inpaint-steps", "4")
    record = open_stream(parsed("--sources", tar, *model)).provenance()
    assert record["inpaint"][0]["id"] == "Windsrain/ZeroStereo"
    assert record["configuration"] == open_stream(parsed("--sources", tar, *model)).provenance()["configuration"]
    assert record["configuration"] != open_stream(parsed("--sources", tar, *model[:4])).provenance()["configuration"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--inpaint-steps", "4"), "belongs to a diffusion network; --inpaint is builtin"),
        (("--depth-resolution", "518"), "depth_resolution belongs to a network"),
        (("--depth", "depth-anything/Depth-Anything-V2-Large-hf", "--commercial-safe"), "no commercial use"),
        (("--depth", "/no/such/folder"), r'depth="/no/such/folder" is neither .* a folder that is there, nor a Hub id'),
        (("--views-per-image", "0"), "views_per_image is an integer, 1 or more"),
    ],
)
def test_options_that_do_not_fit_are_refused_in_words(tar, words, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        open_stream(parsed("--sources", tar, *words))
