"""Whatever a stranger hands to the stream or its loader: it works, or one error says at once what is wrong."""

from dataclasses import fields

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.scenes import photo_tar
from tests.test_stream import open_stream
from zsdata import AdaptiveDisparity, AugmentConfig, DepthNetwork, DiffusionNetwork, ImageSource, UniformDisparity
from zsdata.faults import FailureBudget
from zsdata.quality import QualityGate
from zsdata.sources import parse_sources
from zsdata.synthesis.synthesizer import SynthesisConfig
from zsdata.synthesis.view import ViewConfig

odd = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 5),
    st.integers(),
    st.floats(),
    st.text(max_size=5),
    st.binary(max_size=3),
    st.lists(st.integers(-1, 200), max_size=3),
    st.tuples(st.integers(-1, 200), st.integers(-1, 200)),
    st.dictionaries(st.text(max_size=2) | st.integers(-1, 2), st.text(max_size=3), max_size=2),
)


def some_of(*names):
    """One odd option, or several."""
    one = st.sampled_from(names).flatmap(lambda name: st.fixed_dictionaries({name: odd}))
    return one | st.fixed_dictionaries({}, optional=dict.fromkeys(names, odd))


stream_options = some_of("seed", "size", "epoch_size", "views_per_image", "reuse", "depth_placement", "depth_cache_bytes")
baselines = st.sampled_from([None, AdaptiveDisparity(), UniformDisparity()])
loader_options = some_of("batch_size", "num_workers", "rank", "world_size", "micro_batch", "multiprocessing_context", "timeout_seconds")
thorough = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=250)


@pytest.fixture(scope="module")
def tar(tmp_path_factory):
    return photo_tar(tmp_path_factory.mktemp("tar") / "photos.tar", 5)


@given(options=stream_options, disparity=baselines)
@thorough
def test_stream_options_work_or_are_refused_by_name(tar, options, disparity):
    try:
        stream = open_stream(tar, disparity=disparity, **options)
    except (ValueError, TypeError) as error:
        assert any(name in str(error) for name in (*options, "weight")), str(error)
    else:
        assert len(stream) >= 1 and stream.state_dict()["samples"] == 0


@given(options=loader_options)
@thorough
def test_loader_options_work_or_are_refused_by_name(tar, options):
    stream = open_stream(tar)
    try:
        with stream.loader(**{"batch_size": 1, **options}) as loader:
            assert 1 <= len(loader) <= len(stream)
    except (ValueError, TypeError) as error:
        assert any(name in str(error) for name in ("batch_size", *options)), str(error)


@given(sources=odd | st.dictionaries(st.text(max_size=2), st.builds(ImageSource, odd, odd), max_size=2))
@thorough
def test_sources_that_are_none_are_refused(sources):
    with pytest.raises((ValueError, TypeError, FileNotFoundError)):
        open_stream(sources)


CONFIGURATIONS = [
    ViewConfig,
    SynthesisConfig,
    AugmentConfig,
    QualityGate,
    FailureBudget,
    AdaptiveDisparity,
    UniformDisparity,
    DepthNetwork,
    DiffusionNetwork,
]


@pytest.mark.parametrize("configuration", CONFIGURATIONS)
@given(data=st.data())
@thorough
def test_each_field_of_a_configuration_takes_a_value_or_refuses_it_by_name(configuration, data):
    name = data.draw(st.sampled_from([field.name for field in fields(configuration) if field.init]))
    value = data.draw(odd | st.floats(-1, 2) | st.tuples(st.floats(-1, 2), st.floats(-1, 2)))
    needed = {"name": "folder"} if "name" in [field.name for field in fields(configuration)] else {}
    try:
        configuration(**{**needed, name: value})
    except (ValueError, TypeError) as error:
        assert any(word in str(error) for word in (name, *name.split("_"))), str(error)


specs = st.lists(st.text(alphabet="ab=@:/.0{}1 ", max_size=8) | st.sampled_from(["in=a.tar@0.5", "in=a.tar", "a.tar"]), max_size=3)


@given(specs=specs)
@thorough
def test_sources_of_a_command_line_are_parsed_or_refused_with_what_they_are(specs):
    try:
        parsed = parse_sources(specs)
    except ValueError as error:
        assert any(repr(spec) in str(error) or "://" in spec for spec in specs)  # of a url, what may be shown
    else:
        assert parsed == specs or (isinstance(parsed, dict) and len(parsed) == len(specs))


@given(
    epochs=st.dictionaries(st.integers(-2, 3) | st.sampled_from(["a", None, 1.5]), st.none(), max_size=3),
    swap=odd,
    epoch=st.integers(-2, 3),
)
@thorough
def test_schedules_begin_with_epoch_0_and_are_swapped_later(tar, epochs, swap, epoch):
    schedule = dict.fromkeys(epochs, tar)
    named, numbered = all(isinstance(key, str) for key in schedule), all(isinstance(key, int) for key in schedule)
    if not schedule or not (named or (numbered and min(schedule) == 0)):
        with pytest.raises((ValueError, TypeError), match="source"):
            open_stream(schedule)
        return
    stream = open_stream(schedule)
    before = stream.state_dict()
    with pytest.raises((ValueError, TypeError, FileNotFoundError)):
        stream.set_sources(swap if epoch > 0 else tar, epoch=epoch)
    with pytest.raises(ValueError, match="a schedule"):
        stream.set_sources({1: tar}, epoch=1)
    assert stream.state_dict() == before
    if epoch < 0:
        with pytest.raises(ValueError, match="an epoch is 0 or more"):
            stream.set_epoch(epoch)
    else:
        stream.set_epoch(epoch)
        assert stream.state_dict()["epoch"] == epoch


def test_no_epoch_comes_before_the_first(tar):
    stream = open_stream(tar)
    for refused in (lambda: stream.replay(epoch=-1, index=0), lambda: stream.set_epoch(-1), lambda: stream.set_sources(tar, epoch=0)):
        with pytest.raises((IndexError, ValueError), match=r"got (-1|0)"):
            refused()


def test_a_loop_ends_where_the_stream_is_sent_elsewhere(tar):
    stream = open_stream(tar)
    seen = []
    for pair in stream:
        seen.append((pair.meta["epoch"], pair.meta["index"]))
        stream.set_epoch(3)
    assert seen == [(0, 0)] and next(iter(stream)).meta["epoch"] == 3


@pytest.mark.parametrize(("world_size", "said"), [(1, []), (2, ["rank 1 of 2 stops: RuntimeError: sample 1 of epoch 0"])])
def test_a_rank_that_stops_says_which_one_it_is(tar, world_size, said, caplog):
    def broken(images):
        raise RuntimeError("out of luck")

    with open_stream(tar, depth=broken).loader(1, rank=world_size - 1, world_size=world_size) as loader, pytest.raises(RuntimeError):
        next(iter(loader))
    assert [record.getMessage()[: len(text)] for record, text in zip(caplog.records, said, strict=True)] == said
