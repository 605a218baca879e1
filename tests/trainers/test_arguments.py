import argparse
from typing import Any

import pytest

from tests.scenes import photo_tar
from tests.small_depth_networks import save_small_network
from tests.small_pipeline import save_small_pipeline
from trainers.arguments import add_training_arguments, labels_are_trusted, leave_black, open_stream, train_config
from trainers.loop import TrainConfig
from zsdata import AdaptiveDisparity, AugmentConfig, DepthNetwork, DiffusionNetwork, UniformDisparity, ZeroStereoStream

diffusers = pytest.importorskip("diffusers")

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


def test_every_option_of_the_stream_is_handed_on(monkeypatch):
    monkeypatch.setattr("trainers.arguments.ZeroStereoStream", lambda schedule, **options: {"schedule": schedule, **options})
    words = "--sources a.tar --sources-from 5 b.tar --seed 7 --depth-placement device --commercial-safe --no-confidence --no-augmentation"
    told: Any = open_stream(parsed(*words.split(), "--disparity", "uniform", "--inpaint", "none"))
    assert told["schedule"].keys() == {0, 5} and told["seed"] == 7 and told["depth_placement"] == "device" and told["commercial_safe"]
    assert not told["synthesis"].flip_confidence and told["augmentation"] == AugmentConfig.none()
    assert told["disparity"] == UniformDisparity() and told["inpaint"] is leave_black
    plain: Any = open_stream(parsed("--sources", "a.tar"))
    assert plain["synthesis"].flip_confidence and plain["augmentation"] == AugmentConfig() and plain["disparity"] == AdaptiveDisparity()
    assert not plain["commercial_safe"] and plain["inpaint"] == "builtin"


def test_every_option_of_the_training_is_handed_on():
    words = "--sources a.tar --steps 11 --batch-size 12 --iterations 13 --evaluation-iterations 14 --learning-rate 0.15 --accumulate 16"
    more = "--workers 17 --mixed-precision bf16 --compile --channels-last --ema 0.18 --save-every 19 --evaluate-every 20 --evaluate-first"
    told = train_config(parsed(*words.split(), *more.split(), "--best-by", "d1", "--seed", "21"))
    assert told == TrainConfig(
        steps=11,
        batch_size=12,
        iterations=13,
        evaluation_iterations=14,
        learning_rate=0.15,
        accumulate=16,
        workers=17,
        mixed_precision="bf16",
        compile=True,
        channels_last=True,
        ema=0.18,
        save_every=19,
        evaluate_every=20,
        evaluate_first=True,
        best_by="d1",
        seed=21,
    )
    assert train_config(parsed("--sources", "a.tar")) == TrainConfig(), "the defaults are the paper's"


def test_labels_are_trusted_where_nothing_tells_their_confidence():
    trusted = [labels_are_trusted(parsed("--sources", "a.tar", *words)) for words in ((), ("--no-confidence",), ("--depth", "stored"))]
    assert trusted == [False, True, True]


def test_networks_take_their_options(tar, tmp_path):
    depth = save_small_network("depth_anything", tmp_path / "depth")
    pipeline, tiny = save_small_pipeline(tmp_path / "all" / "StereoGen").parent, tmp_path / "tiny"
    diffusers.AutoencoderTiny().save_pretrained(tiny)
    model = ["--depth", str(depth), "--inpaint", str(pipeline), "--inpaint-subfolder", "StereoGen"]
    options = ["--depth-resolution", "56", "--inpaint-steps", "4", "--inpaint-scheduler", "lcm", "--inpaint-autoencoder", str(tiny)]
    told, plain = (open_stream(parsed("--sources", tar, *model, *more)) for more in (options, []))
    expected = ZeroStereoStream(
        tar,
        depth=DepthNetwork(str(depth), resolution=56),
        inpaint=DiffusionNetwork(str(pipeline), steps=4, scheduler="lcm", subfolder="StereoGen", autoencoder=str(tiny)),
    )
    assert told.provenance() == expected.provenance() != plain.provenance()
    assert [record["id"] for record in told.provenance()["inpaint"]] == [str(pipeline), str(tiny)]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--inpaint-steps", "4"), "belongs to a diffusion network; --inpaint is builtin"),
        (("--depth-resolution", "518"), "--depth-resolution belongs to a depth network; --depth is builtin"),
        (("--depth", "stored", "--depth-resolution", "518"), "--depth-resolution belongs to a depth network; --depth is stored"),
        (("--depth", "owner/name", "--depth-resolution", "large"), "resolution"),
        (("--inpaint", "/no/such/folder"), '"/no/such/folder" is neither a folder nor a Hub id'),
        (("--depth", "depth-anything/Depth-Anything-V2-Large-hf", "--commercial-safe"), "no commercial use"),
        (("--depth", "/no/such/folder"), r'depth="/no/such/folder" is neither .* a folder that is there, nor a Hub id'),
        (("--views-per-image", "0"), "views_per_image is an integer, 1 or more"),
    ],
)
def test_options_that_do_not_fit_are_refused_in_words(tar, words, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        open_stream(parsed("--sources", tar, *words))
