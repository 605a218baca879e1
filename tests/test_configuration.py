"""Whatever a stranger hands to the stream or its loader: it works, or one error says at once what is wrong."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.scenes import photo_tar
from tests.test_stream import open_stream
from zsdata import AdaptiveDisparity, ImageSource, UniformDisparity

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
