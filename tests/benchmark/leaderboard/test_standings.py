"""Ranks, calibration of covariances, and entries in doubt."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commands import assert_refused, run_here
from hypothesis import given
from hypothesis import strategies as st
from leaderboards import Line, entered, handed_in, leaderboard, named, small_split, truth_lines, write
from scipy.stats import binom, chi2, multivariate_normal, multivariate_t, ttest_1samp, ttest_rel

from rsbench.benchmark.leaderboard.board import ORACLES, RUN, accept, merge, rescore
from rsbench.benchmark.leaderboard.deviations import (
    LEVELS,
    VAGUE,
    calibration,
    log_score,
    named_numbers,
    stated,
    vague_log_densities,
)
from rsbench.benchmark.leaderboard.motion_tracks import bound_text
from rsbench.benchmark.leaderboard.standings import Standing, better, ranks, standings, table, ties
from rsbench.benchmark.leaderboard.track import Split
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.benchmark.statistics import mean_interval, score_interval
from rsbench.components.motion_models import LinearMotion
from rsbench.core.errors import RsbenchError
from rsbench.core.pose_errors import translation_of_offset
from rsbench.report.board_page import build_site
from rsbench.storage.files import read_json, write_json

ANY = frozenset({"left"})


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


def _scores(nees: np.ndarray, scenes: int = 0) -> pd.DataFrame:
    names = [f"s{k % scenes}" if scenes else f"s{k}" for k in range(len(nees))]
    return pd.DataFrame({"scene": names, "nees": nees})


def test_right_covariances_are_told_right() -> None:
    """Intervals hold in 95 % of boards: exact ones in at least so many; 150 boards."""
    rng = np.random.default_rng(0)
    errors = rng.standard_normal((150, 40, 6))
    found = [calibration(_scores(nees), 6) for nees in np.sum(errors**2, axis=2)]
    held = np.zeros(4)
    for each in found:
        assert each is not None and each.stated == 40
        held[0] += each.spread[1] <= 1.0 <= each.spread[2]
        held[1:] += [low <= level <= high for level, (_, low, high) in zip(LEVELS, each.covers, strict=True)]
    assert np.all(held / len(found) >= 0.95 - 3.0 * np.sqrt(0.95 * 0.05 / 150)), held


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_wrong_covariances_are_told_wrong(factor: float) -> None:
    """Errors that are ``factor`` times as large as stated: shares are those of chi-squared."""
    nees = factor**2 * np.sum(np.random.default_rng(1).standard_normal((500, 6)) ** 2, axis=1)
    found = calibration(_scores(nees), 6)
    assert found is not None
    assert found.spread[0] == pytest.approx(factor**2, rel=0.15)
    assert found.mean == pytest.approx(factor**2, rel=0.1)  # 500 values: standard deviation 2.6 %
    for level, (share, low, high) in zip(LEVELS, found.covers, strict=True):
        expected = chi2.cdf(chi2.ppf(level, 6) / factor**2, 6)
        assert low < expected < high and (share > level) == (factor < 1.0)


def test_nothing_stated_is_nothing_told() -> None:
    assert calibration(_scores(np.full(5, np.nan)), 6) is None
    assert calibration(pd.DataFrame({"scene": ["a"]}), 6) is None
    assert all(np.isnan(triple).all() for triple in named_numbers(None, True).values())
    some = calibration(_scores(np.array([np.nan, 1.0, np.inf]), scenes=2), 6)
    assert some is not None and some.stated == 2 and some.mean == np.inf
    assert list(named_numbers(some, False)) == ["nees_ratio", "covers_50", "covers_90", "covers_95"]


@given(st.integers(1, 6), st.integers(0, 10_000))
def test_a_stated_density_is_that_of_scipy(size: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    root, error = rng.standard_normal((size, size + 2)), rng.standard_normal(size)
    covariance = root @ root.T
    nees, log_density = stated(error, covariance)
    assert nees == pytest.approx(error @ np.linalg.solve(covariance, error), rel=1e-6)
    assert log_density == pytest.approx(multivariate_normal(np.zeros(size), covariance).logpdf(error), rel=1e-6)
    assert stated(error, covariance - 1e9 * np.eye(size)) == (np.inf, -np.inf)


def _motions(count: int, rng: np.random.Generator) -> list[LinearMotion]:
    return [LinearMotion(0.03 * rng.standard_normal(3), 0.2 * rng.standard_normal(3)) for _ in range(count)]


def test_the_vague_density_is_two_cauchy_densities() -> None:
    motions = _motions(7, np.random.default_rng(0))
    expected = np.zeros(7)
    for vectors in (np.array([each.w for each in motions]), np.array([each.d for each in motions])):
        scale = np.median(np.linalg.norm(vectors, axis=1))
        expected += multivariate_t(np.zeros(3), scale**2 * np.eye(3), df=1).logpdf(vectors)
    np.testing.assert_allclose(vague_log_densities(motions), expected, rtol=1e-12)


def test_the_log_score_has_its_closed_form_and_its_limits() -> None:
    # A density of 100 times the vague one; nothing stated; a truth that the Gaussian excludes, however far away.
    assert log_score(np.log(100.0) - 3.0, -3.0) == pytest.approx(np.log(99.0 + VAGUE), rel=1e-12)
    assert log_score(np.nan, -3.0) == 0.0
    assert log_score(-1e9, -3.0) == log_score(-np.inf, -3.0) == np.log(VAGUE)


@pytest.mark.parametrize("factor", [0.25, 0.5, 0.8, 1.25, 2.0, 4.0])
def test_the_log_score_is_largest_for_the_right_covariance(factor: float) -> None:
    """On the same 4000 errors of known deviations; in closed form, without the vague share, the mean loses
    6 ln(factor) + 3 (1 / factor^2 - 1) nats, and that share only softens what small deviations lose."""
    rng = np.random.default_rng(7)
    motions = _motions(4000, rng)
    sigma = np.array([*(3 * [1e-3]), *(3 * [2e-2])])
    errors, vague = sigma * rng.standard_normal((4000, 6)), vague_log_densities(motions)

    def mean(f: float) -> float:
        own = np.diag((f * sigma) ** 2)
        return float(np.mean([log_score(stated(e, own)[1], v) for e, v in zip(errors, vague, strict=True)]))

    loss, expected = mean(1.0) - mean(factor), 6.0 * np.log(factor) + 3.0 * (1.0 / factor**2 - 1.0)
    assert 0.0 < loss < 1.02 * expected + 0.1
    assert factor < 0.5 or loss == pytest.approx(expected, rel=0.2)


def test_entries_that_state_deviations_are_ranked_by_their_log_score(tmp_path: Path, at_bound: list[Line]) -> None:
    """Right deviations, halved ones, and none: the errors are the same, so the first rank is shared by all."""
    uses = ("left", "right", "links", "readout")
    for name, factor in (("right", 1.0), ("halved", 0.25), ("silent", None)):
        lines = named(at_bound, name, uses)
        for line in lines[1:]:
            stated_too = line.pop("covariance", None)
            if factor is not None and stated_too is not None:
                line["covariance"] = (factor * np.array(stated_too)).tolist()
        handed_in(tmp_path / "board", lines, SPLIT)
    lines = lines_by_name(tmp_path / "board")
    assert {line.rank.place for line in lines.values() if line.rank} == {1}
    assert lines["right"].stated_words["log rank"] == "1 [1, 1] of 2"
    assert lines["halved"].log_rank == (2, 2, 2)
    assert lines["silent"].log_rank is None and list(lines["silent"].stated_words.values()) == ["-", "-", "-"]
    numbers = table(list(lines.values())).set_index("method")["log_score"].to_dict()
    assert numbers["right"] > numbers["halved"] > 10.0 and np.isnan(numbers["silent"])


SPLIT, SMALL = small_split(60), small_split()


def lines_by_name(board: Path, split: Split = SPLIT) -> dict[str, Standing]:
    return {line.scored.header.method: line for line in standings([*entered(board, split).values()])}


@pytest.fixture(scope="module")
def at_bound() -> list[Line]:
    """Motions that err as the bound of all links allows."""
    return list(map(json.loads, bound_text(SPLIT, Path()).splitlines()))


def test_a_method_at_its_bound_is_believed_and_one_below_it_is_not(tmp_path: Path, at_bound: list[Line]) -> None:
    board = tmp_path / "board"
    honest = named(at_bound, "honest", ("left", "right", "links", "readout"))
    scored = handed_in(board, honest, SPLIT)
    assert scored.doubt == ""
    for name, medians in SPLIT.track.medians_at_bound(honest[0]["uses"], SPLIT).items():
        # A draw from the bound is below its median in half of the problems: of 60, in 17 to 43, at 1 in 1000.
        assert 17 <= np.count_nonzero(scored.scores[name].to_numpy() < medians) <= 43
    # The same answers, said to be of less: twice too near where one camera's matches are all that it saw.
    scored = handed_in(board, named(at_bound, "boasting", ("left",)), SPLIT)
    assert scored.doubt.startswith("e_R_deg is below the median at the Cramer-Rao bound of left in ")
    lines = lines_by_name(board)
    assert lines["boasting"].rank is None and lines["boasting"].rank_words == "in doubt"
    assert lines["honest"].rank is not None and lines["honest"].rank_words == "alone"
    assert rescore(board, SPLIT) == {}, "doubts are found again"
    page = build_site(board, tmp_path / "site", ()).read_text("utf-8")
    assert page.count('class="entry oracle handed-in doubt"') == 1 and page.count("handed in</span>") == 2
    assert accept(board, "points-1", SPLIT.name, "boasting", "seen by us") == scored.doubt
    assert all(line.rank is not None for line in lines_by_name(board).values())
    with pytest.raises(RsbenchError, match="no doubts about it"):
        accept(board, "points-1", SPLIT.name, "honest", "why not")


def test_the_truth_under_another_name_is_in_doubt(tmp_path: Path) -> None:
    lines = named(truth_lines(SMALL), "mine", ("left",))
    scored = handed_in(tmp_path / "board", lines, SMALL)
    assert scored.doubt.startswith("e_R_deg is below 1e-05, exact but for rounding, in 1.00 ")
    numbers = table([*lines_by_name(tmp_path / "board", SMALL).values()])
    assert numbers["rank"].isna().all() and numbers["handed_in"].all() and numbers["doubt"].notna().all()


@pytest.mark.parametrize("uses", ["left", "truth"])
@pytest.mark.parametrize(
    "name", ["rs-stereo-refined", "RS-Stereo-Refined", "rs_stereo.ref1ned", "gs-8pt", "sgm", "cramer-rao", "truth"]
)
def test_names_of_rsbench_are_its_own(tmp_path: Path, name: str, uses: str) -> None:
    lines = named(truth_lines(SMALL), name, (uses,))
    with pytest.raises(RsbenchError, match=f"method = '{name}': is the name of a method of rsbench"):
        handed_in(tmp_path / "board", lines, SMALL, "rsbench leaderboard submit")
    assert not handed_in(tmp_path / "own", lines, SMALL, RUN).handed_in


def test_the_truth_is_used_by_no_stranger(tmp_path: Path) -> None:
    lines = named(truth_lines(SMALL), "mine", ("left", "truth"))
    with pytest.raises(RsbenchError, match="uses = 'truth': only oracles of rsbench know the truth"):
        handed_in(tmp_path / "board", lines, SMALL, "rsbench leaderboard submit")
    assert not handed_in(tmp_path / "board", lines, SMALL, ORACLES).handed_in


def _erring(lines: list[Line], name: str, size: float, share: float = 1.0) -> list[Line]:
    """The answers with a random error of ``w`` or ``d``, in a share of the problems."""
    random = np.random.default_rng(3)
    changed = [line | {name: (np.array(line[name]) + size * random.normal(size=3)).tolist()} for line in lines[1:]]
    keep = random.random(len(changed)) < share
    return [lines[0], *(new if use else old for new, old, use in zip(changed, lines[1:], keep, strict=True))]


@pytest.mark.parametrize("point", ["left", "body"])
def test_a_true_translation_is_found_beside_a_rotation_that_errs(tmp_path: Path, point: str) -> None:
    """As attacked: exact directions of "left", with an error of the rotation of some 0.1 deg."""
    lines = named(truth_lines(SPLIT), "mine", ("left",))
    if point == "left":
        for line, truth in zip(lines[1:], SPLIT.truths, strict=True):
            d = translation_of_offset(truth.motion.w, truth.motion.d, truth.rig.offset("left"))
            line |= {"d": d.tolist(), "reference_point": "left", "metric": False}
    exact = _erring(lines, "w", 2e-3)
    scored = handed_in(tmp_path / "board", exact, SPLIT)
    assert scored.scores["auc_5"].mean() > 0.9 and scored.doubt.startswith("e_T_deg is below 1e-05")
    # With 1e-5 of noise nothing is exact, but no camera alone is so near.
    nearly = named(_erring(exact, "d", 1e-6), "other", ("left",))
    scored = handed_in(tmp_path / "board", nearly, SPLIT)
    assert scored.doubt.startswith("e_T_deg is below the median at the Cramer-Rao bound of left in 1.00")


def test_every_error_is_judged_and_a_tenth_is_enough(tmp_path: Path) -> None:
    uses = ("left", "right", "links", "readout")
    lines = named(truth_lines(SPLIT), "mine", uses)
    directions = np.random.default_rng(4).normal(size=(len(lines) - 1, 3))
    for line, direction in zip(lines[1:], directions, strict=True):
        line["w"] = (np.array(line["w"]) + 0.01 * direction).tolist()
        line["d"] = (np.linalg.norm(line["d"]) * direction / np.linalg.norm(direction)).tolist()
    scored = handed_in(tmp_path / "board", lines, SPLIT)
    assert scored.doubt.startswith("e_s is below 1e-07, exact but for rounding, in 1.00")
    few = _erring(named(truth_lines(SPLIT), "few", uses), "w", 0.03, share=0.8)
    few = _erring(few, "d", 0.03)
    scored = handed_in(tmp_path / "board", few, SPLIT)
    assert scored.doubt.startswith("e_R_deg is below 1e-05, exact but for rounding, in 0.")


def test_the_truth_of_the_last_problems_is_in_doubt_too(tmp_path: Path) -> None:
    """As attacked: bad motions in the first 50 of 250 problems, and errors of 1e-4 deg in all others."""
    split = small_split(250)
    lines = named(truth_lines(split), "mine", ("left", "right", "links", "readout"))
    bad, near = (_erring(_erring(lines, "w", size), "d", size) for size in (0.03, 2e-6))
    scored = handed_in(tmp_path / "board", [*bad[:51], *near[51:]], split)
    assert np.mean(scored.scores["e_R_deg"] < 1e-5) < 0.1 and scored.scores["auc_5"].mean() > 0.8
    assert scored.doubt.startswith("e_R_deg is below the median at the Cramer-Rao bound of left + right + links")


def test_no_other_board_accepts_an_entry(tmp_path: Path) -> None:
    """A stranger's board: the truth, a doubt that was removed, and an acceptance that its author wrote."""
    theirs, ours = tmp_path / "theirs", tmp_path / "ours"
    scored = handed_in(theirs, named(truth_lines(SMALL), "mine", ("left",)), SMALL)
    path = scored.folder / "entry.json"
    write_json(path, read_json(path) | {"doubt": "", "accepted": "believe me"})
    assert merge(theirs, ours) == [f"points-1/{SMALL.name}/mine"]
    assert rescore(ours, SMALL) == {}
    line = lines_by_name(ours, SMALL)["mine"]
    assert line.rank is None and line.rank_words == "in doubt"
    assert merge(theirs, ours) == []


def test_links_alone_are_not_all_that_a_method_uses(tmp_path: Path) -> None:
    """As attacked: an entry that names links alone would have no peers, and the loosest of all bounds."""
    lines = named(truth_lines(SMALL), "mine", ("links", "readout"))
    with pytest.raises(RsbenchError, match=r"jsonl:1: uses = 'links' without 'left' or 'right': .* the matches"):
        handed_in(tmp_path / "board", lines, SMALL)


def test_the_commands_say_it(tmp_path: Path) -> None:
    file = write(tmp_path / "a.jsonl", named(truth_lines(TRACKS["points"].split(None)), "mine"))
    board = tmp_path / "board"
    shown = leaderboard("submit", file, "--board", board)
    assert "in doubt, and not ranked: e_R_deg is below 1e-05" in shown
    where = ("--board", board, "--protocol", "points-1", "--split", TRACKS["points"].split(None).name)
    assert_refused(run_here("leaderboard", "accept", "mine", *where, "--reason", " "), "--reason")
    shown = leaderboard("accept", "mine", *where, "--reason", "a test of ours")
    assert shown.startswith("mine: ranked all the same: e_R_deg")
