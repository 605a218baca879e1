import json
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsdata.position import Position, require_one_place

EPOCH = 1_000  # samples
HERE = Position(seed=7, epoch=3, samples=40, manifest="a" * 64, configuration="b" * 64)
STATE = HERE.to_state()


def from_state(state, expected=HERE, epoch_size=EPOCH):
    return Position.from_state(state, expected, lambda epoch: epoch_size)


places = st.builds(
    Position,
    seed=st.integers(min_value=0),
    epoch=st.integers(0, 2**63 - 1),
    samples=st.integers(0, 2**63 - 1),
    manifest=st.text(min_size=1),
    configuration=st.text(min_size=1),
    models=st.dictionaries(st.text(), st.text(), max_size=3),
)
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=10,
)


@given(places)
def test_a_state_comes_back_through_json(place):
    assert from_state(json.loads(json.dumps(place.to_state())), place, 2**63) == place


@given(json_values)
def test_anything_else_is_refused_as_a_state(value):
    with pytest.raises(ValueError, match="state"):
        from_state(value)


@given(st.sampled_from(sorted(STATE)), json_values)
def test_an_edited_field_is_refused_by_name_or_is_a_place(name, value):
    state = {**STATE, name: value}
    if name in ("epoch", "samples") and type(value) is int and 0 <= value < (2**63 if name == "epoch" else EPOCH + 1):
        assert getattr(from_state(state), name) == value
    elif type(value) is type(STATE[name]) and value == STATE[name]:
        assert from_state(state) == HERE
    else:
        with pytest.raises(ValueError, match=f"the state's {name} "):
            from_state(state)


def test_the_end_of_an_epoch_is_a_place_and_one_sample_further_is_none():
    assert from_state({**STATE, "samples": EPOCH}).samples == EPOCH
    with pytest.raises(ValueError, match="samples is 1001, but epoch 3 has only 1000"):
        from_state({**STATE, "samples": EPOCH + 1})


@given(st.sampled_from(sorted(STATE)), st.text(min_size=1).filter(lambda name: name not in STATE))
def test_missing_and_unknown_fields_are_named(missing, unknown):
    with pytest.raises(ValueError, match=rf"missing \['{missing}'\]"):
        from_state({name: value for name, value in STATE.items() if name != missing})
    with pytest.raises(ValueError, match="unknown"):
        from_state({**STATE, unknown: 1})


def test_a_refusal_is_short_whatever_the_state_holds():
    long = "x" * 10**6
    for change in ({"version": long}, {"seed": long}, {"manifest": long}, {"models": {"depth": long}}, {long: 1}, {"epoch": 10**3000}):
        with pytest.raises(ValueError) as error:
            from_state({**STATE, **change})
        assert len(str(error.value)) < 500


def test_the_largest_state_is_small():
    models = dict.fromkeys(("depth", "inpaint", "autoencoder"), f"{'n' * 96}@{'f' * 40}")
    place = Position(seed=2**63 - 1, epoch=2**63 - 1, samples=2**63 - 1, manifest="f" * 64, configuration="f" * 64, models=models)
    assert len(json.dumps(place.to_state())) < 1000


def test_the_state_of_another_version_says_so_whatever_it_holds():
    with pytest.raises(ValueError, match="the state's version is 1; this zsdata reads version 2"):
        from_state({name: value for name, value in STATE.items() if name != "models"} | {"version": 1})


def test_a_model_that_has_moved_is_named_with_both_commits():
    then, now = (replace(HERE, models={"depth": f"depth-anything/Depth-Anything-V2-Small-hf@{digit * 40}"}) for digit in "ab")
    said = r"state's models is \{'depth': '[\w/-]+@a{40}'\}, this stream's is .*@b{40}.*: a model has moved on at the Hub; name it as"
    with pytest.raises(ValueError, match=said):
        from_state(then.to_state(), now)


def test_ranks_that_stand_elsewhere_are_named():
    require_one_place([STATE] * 3)
    with pytest.raises(ValueError, match="rank 2 differs from rank 0: its samples is 48, not 40: they stand at different places"):
        require_one_place([STATE, STATE, {**STATE, "samples": 48}])
    with pytest.raises(ValueError, match=r"rank 1 differs from rank 0: its manifest is 'c', not 'a+': the photos, their order"):
        require_one_place([STATE, {**STATE, "manifest": "c"}])
