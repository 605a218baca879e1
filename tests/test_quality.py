import pytest

from zsdata.quality import QualityGate

GOOD = {"hole_share": 0.1, "visible_share": 0.9, "disparity_range_px": 30.0, "drawn_px": 50.0, "flip_consistency": 0.95}


def test_an_ordinary_pair_passes():
    assert QualityGate().refuses(**GOOD) is None


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"hole_share": 0.51}, "too many holes: 51% of the right view would be invented"),
        ({"visible_share": 0.2}, "too little valid: the right view shows 20% of the left one"),
        ({"disparity_range_px": 0.0}, "flat depth: the disparities of the view differ by 0.00 of 50.00 px"),
        ({"flip_consistency": 0.5}, "depth changes in the mirror: a flip consistency of 0.50"),
        ({"flip_consistency": float("nan")}, "depth changes in the mirror: a flip consistency of nan"),
    ],
)
def test_each_fault_has_a_reason_that_it_is_counted_by(change, reason):
    assert QualityGate().refuses(**{**GOOD, **change}) == reason


def test_every_threshold_can_be_turned_off():
    off = QualityGate(max_hole_share=1, min_visible_share=0, min_depth_range=0, min_flip_consistency=0)
    assert off.refuses(hole_share=1, visible_share=0, disparity_range_px=0, drawn_px=50, flip_consistency=0) is None


@pytest.mark.parametrize("drawn_px", [0.0, 1e-6, 0.02, 0.5])
def test_a_sample_that_draws_next_to_no_disparity_does_not_refuse_every_photo(drawn_px):
    clamped = max(0.0, 0.5 * drawn_px - 0.01)  # what is left of a view that spans half of the photo's depth
    assert QualityGate().refuses(**{**GOOD, "disparity_range_px": clamped, "drawn_px": drawn_px}) is None


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("max_hole_share", 1.1),
        ("min_visible_share", -0.1),
        ("min_flip_consistency", float("nan")),
        ("min_depth_range", -1),
    ],
)
def test_thresholds_that_make_no_sense_are_refused_by_name(name, value):
    with pytest.raises(ValueError, match=f"{name} is .*; got {value}"):
        QualityGate(**{name: value})
