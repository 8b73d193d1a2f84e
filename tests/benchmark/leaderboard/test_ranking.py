"""Intervals and ranks hold as often as they say, on scores whose true means are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom, ttest_1samp, ttest_rel

from rsbench.benchmark.leaderboard.standings import better, mean_interval, ranks, scene_means, score_interval, ties

ANY = frozenset({"left"})


def test_scenes_count_alike() -> None:
    values = np.array([[1.0, 3.0, 10.0], [0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(scene_means(values, ["b", "b", "a"]), [[10.0, 2.0], [1.0, 0.0]])


@pytest.mark.parametrize(("scenes", "problems"), [(9, 24), (250, 1)])
def test_the_interval_of_a_mean_covers_it(scenes: int, problems: int) -> None:
    """Scores in [0, 1] with a part that is common to a scene, as skewed as those of tables."""
    rng = np.random.default_rng(scenes)
    trials, truth = 3000, 0.75
    ease = rng.beta(6.0 * truth, 6.0 * (1.0 - truth), (trials, scenes, 1))  # mean: truth
    scores = np.clip(rng.beta(4.0 * ease, 4.0 * (1.0 - ease), (trials, scenes, problems)), 0.0, 1.0)
    found = [mean_interval(means) for means in scores.mean(axis=2)]
    share = np.mean([low <= truth <= high for low, high in found])
    assert 0.93 <= share <= 0.97


def test_the_interval_of_a_mean_is_that_of_scipy() -> None:
    means = np.random.default_rng(3).random(7)
    expected = ttest_1samp(means, 0.0).confidence_interval(0.95)
    assert list(mean_interval(means)) == pytest.approx([expected.low, expected.high], rel=1e-12)


@pytest.mark.parametrize("share", [0.03, 0.5, 0.97])
def test_the_interval_of_a_share_covers_it(share: float) -> None:
    """All numbers of successes with their chances, no draws: never below 95 %, and near the ends above it."""
    n = 40
    names = [str(k) for k in range(n)]
    held = 0.0
    for successes in range(n + 1):
        _, low, high = score_interval(np.repeat([1.0, 0.0], [successes, n - successes]), names)
        held += float(binom.pmf(successes, n, share)) * (low <= share <= high)
    assert 0.95 <= held <= 0.995


def test_scores_of_few_scenes_keep_their_interval() -> None:
    """Nine scenes of 1 to 9 problems, yes or no, which agree in a scene: the mean over scenes is what is told."""
    rng = np.random.default_rng(4)
    scenes = [str(k) for k in range(9) for _ in range(k + 1)]
    size, trials, truth, held = np.arange(1, 10), 1500, 0.7, 0
    for ease in rng.beta(4.0 * truth, 4.0 * (1.0 - truth), (trials, 9)):
        values = (rng.random(45) < np.repeat(ease, size)).astype(np.float64)
        value, low, high = score_interval(values, scenes)
        assert 0.0 <= low <= value <= high <= 1.0
        held += low <= truth <= high
    assert 0.93 <= held / trials <= 0.97


def test_none_of_many_in_few_scenes_is_not_none_for_sure() -> None:
    """At least what as many independent problems leave open: here 1 - 0.025^(1 / 216)."""
    scenes = [str(k // 24) for k in range(216)]
    assert score_interval(np.zeros(216), scenes) == pytest.approx((0.0, 0.0, 1.0 - 0.025 ** (1 / 216)))
    assert score_interval(np.ones(216), scenes) == pytest.approx((1.0, 0.025 ** (1 / 216), 1.0))


def _tables(rng: np.random.Generator, truth: np.ndarray, scenes: int, trials: int) -> np.ndarray:
    """Scenes' means (trials, entries, scenes) with a difficulty that entries share."""
    common = 0.1 * rng.standard_normal((trials, 1, scenes))
    return truth[None, :, None] + common + 0.05 * rng.standard_normal((trials, len(truth), scenes))


def test_all_ranks_hold_at_once() -> None:
    """In 95 % of tables or more all intervals hold the true ranks: two true ties, and gaps of all sizes."""
    truth = np.array([0.5, 0.5, 0.53, 0.6, 0.7, 0.7, 0.9])
    lowest = np.array([1 + np.count_nonzero(truth > x) for x in truth])
    highest = np.array([np.count_nonzero(truth >= x) for x in truth])
    trials, held, told = 1000, 0, 0
    for means in _tables(np.random.default_rng(0), truth, 9, trials):
        found = ranks(means.mean(axis=1), better(means), [ANY] * len(truth))
        held += all(r.low <= a and r.high >= b for r, a, b in zip(found, lowest, highest, strict=True))
        told += sum(r.high - r.low < len(truth) - 1 for r in found)
    assert held / trials >= 0.95 - 3.0 * np.sqrt(0.95 * 0.05 / trials)
    assert told > 5 * trials  # they say something


@pytest.mark.parametrize("scenes", [6, 60])
def test_ranks_of_two_equal_entries_hold_as_often_as_they_say(scenes: int) -> None:
    """Of two entries nothing is corrected: the one test errs in 5 % of tables, and both ranks with it."""
    trials = 2000
    tables = _tables(np.random.default_rng(5), np.array([0.6, 0.6]), scenes, trials)
    found = [ranks(means.mean(axis=1), better(means), [ANY] * 2) for means in tables]
    held = np.mean([all(rank[1:] == (1, 2) for rank in each) for each in found])
    assert 0.93 <= held <= 0.97


def test_pairs_are_those_of_scipy_and_of_holm() -> None:
    means = _tables(np.random.default_rng(1), np.array([0.5, 0.52, 0.6, 0.62]), 8, 1)[0]
    pairs = [(i, j) for i in range(4) for j in range(4) if i < j]
    chances = {pair: ttest_rel(means[pair[0]], means[pair[1]]).pvalue for pair in pairs}
    falls = set()
    for k, pair in enumerate(sorted(pairs, key=lambda p: chances[p])):
        if chances[pair] > 0.05 / (len(pairs) - k):
            break
        falls.add(pair)
    beats = better(means)
    assert 0 < len(falls) < len(pairs)
    for i, j in pairs:
        assert (beats[i, j] or beats[j, i]) == ((i, j) in falls)
        assert not beats[i, j] or means[i].mean() > means[j].mean()


def test_a_copy_ties_and_one_scene_tells_nothing() -> None:
    rng = np.random.default_rng(2)
    one = rng.random(9)
    beats = better(np.stack([one, one, one - 0.2]))
    assert ties(beats, 0) == [1] and beats[0, 2] and beats[1, 2]
    assert not np.any(better(np.array([[0.1], [0.9]])))
    assert mean_interval(np.array([0.4])) == (-np.inf, np.inf)


def test_who_uses_less_is_not_ranked_below_who_uses_more() -> None:
    scores, beats = np.array([0.9, 0.5, 0.4]), np.array([[0, 1, 1], [0, 0, 1], [0, 0, 0]], dtype=np.bool_)
    uses = [frozenset({"left", "right"}), frozenset({"left"}), frozenset({"left", "gyro"})]
    assert ranks(scores, beats, uses) == [(1, 1, 1), (1, 1, 1), (2, 2, 2)]


@given(st.integers(1, 8), st.integers(1, 6), st.integers(0, 1000))
def test_a_place_lies_in_its_interval(entries: int, scenes: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    means = rng.random((entries, scenes))
    uses = [frozenset(rng.choice(["left", "right", "links"], 2)) for _ in range(entries)]
    for rank in ranks(means.mean(axis=1), better(means), uses):
        assert 1 <= rank.low <= rank.place <= rank.high <= entries
