import numpy as np

from zsdata.plan import EpochPlan
from zsdata.seeding import rng


def test_seed_epoch_index_and_purpose_each_make_other_numbers():
    keys = [
        (1, 2, 3, "view"),
        (0, 2, 3, "view"),
        (1, 0, 3, "view"),
        (1, 2, 0, "view"),
        (1, 2, 3, "inpaint"),
        (2, 1, 3, "view"),
        (1, 3, 2, "view"),
    ]
    assert len({rng(*key).bytes(8) for key in keys}) == len(keys)
    assert np.array_equal(rng(*keys[0]).random(5), rng(*keys[0]).random(5))


def test_a_sample_is_what_it_was_in_earlier_releases():
    """States that were saved with them go on here. Where other numbers are meant, `zsdata.position.VERSION` must change too."""
    assert rng(7, 3, 40, "view").integers(0, 1000, 4).tolist() == [69, 480, 991, 896]
    plan = EpochPlan(7, ("indoor", "street"), (100, 1000), (10, 30), 2)
    assert [tuple(plan.choose(3, index)) for index in (0, 2, 4, 40, 79)] == [(0, 3), (1, 609), (1, 693), (1, 398), (1, 902)]
    assert [plan.spare(3, 40, attempt) for attempt in range(2)] == [(1, 515), (1, 740)]
