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
stream_options = st.fixed_dictionaries(
    {},
    optional={
        "seed": odd,
        "size": odd,
        "epoch_size": odd,
        "views_per_image": odd,
        "reuse": odd,
        "depth_placement": odd,
        "depth_cache_bytes": odd,
        "disparity": st.sampled_from([None, AdaptiveDisparity(), UniformDisparity()]),
    },
)
loader_options = st.fixed_dictionaries(
    {"batch_size": st.just(1) | odd},  # so that the others are reached
    optional={
        "num_workers": odd,
        "rank": odd,
        "world_size": odd,
        "micro_batch": odd,
        "multiprocessing_context": odd,
        "timeout_seconds": odd,
    },
)
thorough = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=150)


@pytest.fixture(scope="module")
def tar(tmp_path_factory):
    return photo_tar(tmp_path_factory.mktemp("tar") / "photos.tar", 5)


@given(options=stream_options)
@thorough
def test_stream_options_work_or_are_refused_by_name(tar, options):
    try:
        stream = open_stream(tar, **options)
    except (ValueError, TypeError) as error:
        assert any(name in str(error) for name in (*options, "weight")), str(error)
    else:
        assert len(stream) >= 1 and stream.state_dict()["samples"] == 0


@given(options=loader_options)
@thorough
def test_loader_options_work_or_are_refused_by_name(tar, options):
    stream = open_stream(tar)
    try:
        with stream.loader(**options) as loader:
            assert 1 <= len(loader) <= len(stream)
    except (ValueError, TypeError) as error:
        assert any(name in str(error) for name in options), str(error)


@given(sources=odd | st.dictionaries(st.text(max_size=2), st.builds(ImageSource, odd, odd), max_size=2))
@thorough
def test_sources_that_are_none_are_refused(sources):
    with pytest.raises((ValueError, TypeError, FileNotFoundError)):
        open_stream(sources)
