from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsdata.plan import EpochPlan, Shuffle, quotas_for


@given(st.integers(1, 400), st.integers(0, 2**40))
def test_a_shuffle_is_a_permutation(size, key):
    shuffle = Shuffle(size, key)
    assert sorted(shuffle(i) for i in range(size)) == list(range(size))


def test_shuffles_of_other_keys_differ_and_look_random():
    size = 1000
    orders = [[Shuffle(size, key)(i) for i in range(size)] for key in range(3)]
    assert orders[0] != orders[1] != orders[2]
    for order in orders:
        assert sum(order[i + 1] == order[i] + 1 for i in range(size - 1)) < 8  # about one by chance
        mean_of_first_half = sum(order[: size // 2]) / (size // 2)
        assert abs(mean_of_first_half - (size - 1) / 2) < 60  # five standard deviations


def test_every_order_of_a_few_photos_comes_up():
    orders = Counter(tuple(Shuffle(4, key)(i) for i in range(4)) for key in range(2400))
    assert len(orders) == 24 and min(orders.values()) > 50


def test_a_place_in_a_huge_source_costs_nothing():
    shuffle = Shuffle(10**12, "huge")
    assert len({shuffle(i) for i in range(1000)}) == 1000


def plans():
    return st.integers(1, 4).flatmap(
        lambda count: st.builds(
            lambda seed, sizes, quotas: EpochPlan(seed, tuple(f"source {i}" for i in range(count)), tuple(sizes), tuple(quotas)),
            st.integers(0, 2**63),
            st.lists(st.integers(1, 30), min_size=count, max_size=count),
            st.lists(st.integers(0, 50), min_size=count, max_size=count).filter(any),
        )
    )


@given(plans(), st.integers(0, 1000))
def test_every_source_gives_its_quota_of_photos_that_exist(plan, epoch):
    choices = [plan.choose(epoch, i) for i in range(plan.epoch_size)]
    counts = Counter(choice.source for choice in choices)
    assert [counts[i] for i in range(len(plan.sizes))] == list(plan.quotas)
    assert all(0 <= choice.member < plan.sizes[choice.source] for choice in choices)


@given(plans())
def test_a_source_shows_all_its_photos_before_it_repeats_one(plan):
    shown = [Counter() for _ in plan.sizes]
    for epoch in range(4):
        for i in range(plan.epoch_size):
            choice = plan.choose(epoch, i)
            shown[choice.source][choice.member] += 1
        for source, counts in enumerate(shown):
            often = [counts[member] for member in range(plan.sizes[source])]
            assert max(often) - min(often) <= 1


@given(st.lists(st.integers(1, 40), min_size=1, max_size=4), st.integers(0, 9))
def test_without_an_epoch_size_an_epoch_is_one_exact_pass(sizes, epoch):
    plan = EpochPlan(0, tuple(map(str, range(len(sizes)))), tuple(sizes), quotas_for(sizes, [None] * len(sizes), None))
    seen = Counter(plan.choose(epoch, i) for i in range(plan.epoch_size))
    assert set(seen.values()) == {1} and len(seen) == sum(sizes)


@given(plans(), st.integers(0, 5))
def test_spares_are_all_other_photos_of_the_source_once(plan, epoch):
    index = plan.epoch_size - 1
    chosen = plan.choose(epoch, index)
    spares, attempt = [], 0
    while (spare := plan.spare(epoch, index, attempt)) is not None:
        spares.append(spare)
        attempt += 1
    assert sorted(s.member for s in spares) == sorted(set(range(plan.sizes[chosen.source])) - {chosen.member})
    assert all(s.source == chosen.source for s in spares)


@given(st.lists(st.integers(1, 1000), min_size=1, max_size=5), st.integers(1, 10_000), st.data())
def test_quotas_add_up_and_follow_the_weights(sizes, epoch_size, data):
    weights = data.draw(st.lists(st.floats(0, 10), min_size=len(sizes), max_size=len(sizes)).filter(lambda w: sum(w) > 0.01))
    quotas = quotas_for(sizes, weights, epoch_size)
    assert sum(quotas) == epoch_size
    for quota, weight in zip(quotas, weights, strict=True):
        assert abs(quota - epoch_size * weight / sum(weights)) < 1 + 1e-6


@pytest.mark.parametrize("weights", [[1.0, None], [0.0, 0.0], [-1.0, 2.0], [float("nan"), 1.0]])
def test_weights_that_mean_nothing_are_refused(weights):
    with pytest.raises(ValueError, match="weight"):
        quotas_for([3, 3], weights, 10)


@pytest.mark.parametrize("index", [-1, 12])
def test_an_index_outside_the_epoch_is_refused(index):
    with pytest.raises(IndexError, match="epoch of 12"):
        EpochPlan(0, ("a",), (5,), (12,)).choose(0, index)


@given(st.integers(1, 5), st.integers(1, 60), st.integers(0, 3))
def test_the_views_of_a_photo_stand_together_and_every_photo_gives_as_many(views, samples, epoch):
    photos = -(-samples // views)
    plan = EpochPlan(0, ("a", "b"), (7, 30), quotas_for((7, 30), [0.5, 0.5], photos), views, samples)
    choices = [plan.choose(epoch, i) for i in range(plan.epoch_size)]
    assert len(choices) == samples
    groups = [choices[first : first + views] for first in range(0, samples, views)]
    assert all(len(set(group)) == 1 for group in groups)
    once = EpochPlan(0, ("a", "b"), (7, 30), plan.quotas)
    assert [group[0] for group in groups] == [once.choose(epoch, i) for i in range(photos)]
    assert len({plan.spare(epoch, index, 0) for index in range(min(views, samples))}) == 1
