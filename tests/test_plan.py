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


def photos_of(plan, epoch, source):
    choices = [plan.choose(epoch, i) for i in range(plan.epoch_size)]
    return {choice.member for choice in choices if choice.source == source}


def test_a_source_gives_an_epoch_the_same_photos_whatever_stands_beside_it():
    alone = EpochPlan(3, ("street",), (40,), (10,))
    beside = EpochPlan(3, ("indoor", "street"), (7, 40), (12, 10))
    assert all(photos_of(alone, epoch, 0) == photos_of(beside, epoch, 1) for epoch in range(8))


def test_seed_epoch_source_and_pass_each_have_an_order_of_their_own():
    plan, other_seed = (EpochPlan(seed, ("a", "b"), (40, 40), (10, 10)) for seed in (0, 1))
    mixtures = [[of.choose(epoch, i).source for i in range(20)] for of, epoch in ((plan, 0), (plan, 1), (other_seed, 0))]
    assert mixtures[0] != mixtures[1] and mixtures[0] != mixtures[2]
    assert photos_of(plan, 0, 0) != photos_of(other_seed, 0, 0)
    assert photos_of(plan, 0, 0) != photos_of(plan, 0, 1)
    assert photos_of(plan, 0, 0) != photos_of(plan, 4, 0)  # after all 40 photos were shown once


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


def test_spares_are_spread_over_the_source():
    plan = EpochPlan(0, ("a",), (1000,), (1000,))
    spares = [plan.spare(0, i, 0) for i in range(30)]
    assert len({spare.member for spare in spares if spare is not None}) > 25  # and no photo stands in for every bad one


def test_quotas_are_rounded_by_largest_remainder():
    assert quotas_for([9, 9, 9], [0.59, 0.29, 0.12], 10) == (6, 3, 1)
    assert quotas_for([9, 9], [None, None], 3) == (2, 1)  # of equal ones the first


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
