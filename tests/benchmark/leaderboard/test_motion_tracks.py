"""Tracks of motions and of the readout ratio: second protocols."""

from __future__ import annotations

import json
import lzma
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from commands import assert_refused, run_here
from hypothesis import given, settings
from hypothesis import strategies as st
from leaderboards import (
    entered,
    leaderboard,
    lines_of,
    named,
    oracle_scores,
    run_entries,
    scores_of,
    truth_lines,
    write,
)
from scipy.integrate import quad
from scipy.stats import norm

from rsbench.benchmark.leaderboard import publishing
from rsbench.benchmark.leaderboard.board import SUFFIX, add, entries_of, restore
from rsbench.benchmark.leaderboard.motion_tracks import CHOOSES, smooth
from rsbench.benchmark.leaderboard.publishing import drawn_split
from rsbench.benchmark.leaderboard.readout_tracks import best_constant, crps, spread_of
from rsbench.benchmark.leaderboard.splits import (
    KINDS,
    MODELS_DRAWN,
    POINTS_2,
    exact_problem,
    simulated_problem,
    truth_of,
)
from rsbench.benchmark.leaderboard.standings import standings, table
from rsbench.benchmark.leaderboard.track import ORACLE, Split
from rsbench.benchmark.leaderboard.tracks import TRACKS, track_of_name
from rsbench.benchmark.simulated.bound import motion_bound
from rsbench.cli.reproduce_leaderboard import SAME_METHOD, entries_of_laws
from rsbench.components.motion_models import TwistMotion
from rsbench.core import so3
from rsbench.core.errors import RsbenchError
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.dataset.card import load_dataset_card
from rsbench.dataset.secret_split import Secret
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.solvers.engine.base import load_solver_entry

ROOT = Path(__file__).parents[3]
LAWS_FOLDER = ROOT / "results" / "laws"
TRACK = TRACKS["points-2"]
needs_results = pytest.mark.skipif(not LAWS_FOLDER.is_dir(), reason="needs the committed results")


@pytest.fixture(scope="module")
def split() -> Split:
    return TRACK.split(None)


def test_each_kind_of_rig_moves_by_each_law_as_often(split: Split) -> None:
    assert split.name == "dev-7a998de4"  # as announced: other problems are another protocol
    counts = Counter((truth.facts["rig"], truth.facts["motion"]) for truth in split.truths)
    assert counts == {(kind, law): 12 for kind in KINDS for law in MODELS_DRAWN}
    for truth in split.truths:
        facts, kind = truth.facts, KINDS[str(truth.facts["rig"])]
        assert truth.motion.name == facts["motion"]
        for name, (low, high) in (
            ("rotation_deg", kind.rotation_deg),
            ("translation_m", kind.translation),
            ("baseline_m", kind.baseline),
            ("readout_ratio", (0.1, 0.95)),
        ):
            assert low * (1 - 1e-12) <= float(facts[name]) <= high * (1 + 1e-12), (truth.name, name)
        if kind.drives:  # forward and about the vertical, to four standard deviations
            ahead = truth.motion.d[2] / np.linalg.norm(truth.motion.d)
            assert ahead > 0.8 and abs(truth.motion.w[1]) > 0.8 * np.linalg.norm(truth.motion.w)
    order = [truth.facts["motion"] for truth in split.truths]
    assert order != [POINTS_2.kinds(2, number)["motion"] for number in range(len(order))]  # names tell no law


def test_outliers_are_wrong_in_all_four_images() -> None:
    """Beside the same problem without noise and outliers, each end of an outlier lies elsewhere, by its own."""
    number = next(n for n in range(240) if POINTS_2.setting(1, n).outlier_ratio == 0.5)
    setting = POINTS_2.setting(1, number)
    given = simulated_problem(1, number, POINTS_2).correspondences.tracks
    right = exact_problem(1, number, POINTS_2)[0].correspondences.tracks
    assert len(right) == len(given) - round(0.5 * len(given))
    distance = np.abs(given[:, None] - right[None]).max(axis=2).min(axis=1)
    wrong = given[distance > 8.0 * setting.noise_px]
    assert len(wrong) >= 0.9 * 0.5 * len(given)  # some lie near to another point by chance
    # Both cameras see a point in one row, to the noise: of outliers not even those of one frame do.
    apart = np.abs(wrong[:, [1, 5]] - wrong[:, [3, 7]])
    assert np.median(apart[:, 0]) > 10.0 and np.median(apart[:, 1]) > 10.0


def test_the_bound_of_a_shaken_motion_is_that_of_its_smooth_path() -> None:
    number = next(n for n in range(240) if POINTS_2.kinds(1, n) == {"motion": "spline", "rig": "phone"})
    problem, noise = exact_problem(1, number, POINTS_2)
    motion = POINTS_2.motion(1, number)
    near, exact = (
        motion_bound(problem.correspondences, problem.rig, problem.shutter, each, noise)
        for each in (smooth(motion), motion)
    )
    assert isinstance(smooth(motion), TwistMotion)
    assert near.rotation == pytest.approx(exact.rotation, rel=0.06)
    assert near.direction == pytest.approx(exact.direction, rel=0.06)


def test_the_score_is_that_of_the_protocol(split: Split, tmp_path: Path) -> None:
    """Of motions that err by known angles: their logarithm over the median error at the bound, drawn again."""
    few = replace(split, truths=split.truths[:8])
    lines = named(truth_lines(few), "mine", ("left", "right", "links", "readout"))
    turn = np.deg2rad(0.3)
    for line in lines[1:]:
        line["w"][0] += turn
    lines[-1] = {"name": few.truths[-1].name, "success": False}
    scores = scores_of(few, lines, tmp_path)
    rng = np.random.default_rng(0)
    for k, truth in enumerate(few.truths[:-1]):
        problem, noise = exact_problem(1, k, POINTS_2)
        bound = motion_bound(problem.correspondences, truth.rig, truth.shutter, smooth(truth.motion), noise)
        assert bound.covariance is not None
        errors = np.linalg.cholesky(bound.covariance) @ rng.standard_normal((6, 4000))
        R = np.median(rotation_error(truth.motion.w + errors[:3].T, truth.motion.w))
        T = np.median(translation_error(truth.motion.d + errors[3:].T, truth.motion.d))
        over = rotation_error(np.array(lines[k + 1]["w"]), truth.motion.w) / R
        expected = min(max(1.0 - math.log10(over) / 2.0, 0.0), 1.0)
        # Two medians of 4000 draws differ by up to some 6 %, whose logarithm is 0.025, and half of that here.
        assert scores["near_R"][k] == pytest.approx(expected, abs=0.02)
        assert scores["near_T"][k] == (1.0 if np.rad2deg(T) < 10.0 else scores["near_R"][k])
        assert scores["near_bound"][k] == pytest.approx(
            0.5 * (scores["near_R"][k] + scores["near_T"][k]), abs=1e-12
        )
    last = scores.iloc[-1]
    assert (last["near_bound"], last["near_R"], last["near_T"], last["failure"]) == (0.0, 0.0, 0.0, 1.0)


@pytest.mark.slow
def test_who_chooses_a_law_is_nearer_under_another(tmp_path: Path) -> None:
    """Of a problem under another law than the solver's own."""
    number = next(n for n in range(240) if POINTS_2.kinds(1, n) == {"motion": "inertial", "rig": "drone"})
    problem = simulated_problem(1, number, POINTS_2)
    entry = TRACK.entry_of(CHOOSES)  # pyrefly: ignore[missing-attribute]
    own = load_solver_entry("rs-stereo-refined")
    assert entry.solver == own.solver and entry.key != own.key
    with SolverRunner(single_thread=True) as runner:
        found = TRACK.answer(problem, entry, runner)  # pyrefly: ignore[missing-attribute]
        fixed = TRACK.answer(problem, own, runner)  # pyrefly: ignore[missing-attribute]
    true = POINTS_2.motion(1, number)
    error, other = (float(translation_error(np.array(each["d"]), true.d)) for each in (found, fixed))
    assert found["success"] and error < other
    models = {card: found.header["motion_model"] for card, found in TRACK.load([CHOOSES, "gs-8pt"]).items()}
    assert models == {CHOOSES: "chosen", "gs-8pt": "none"}
    assert_refused(
        run_here("leaderboard", "run", "points", "--entry", CHOOSES, "--board", tmp_path / "board"), CHOOSES
    )


def test_protocols_are_found_by_their_numbers() -> None:
    assert track_of_name("points-1") is TRACKS["points"] and track_of_name("points-2") is TRACK
    entries = entries_of_laws()["points-2"]
    assert not SAME_METHOD.keys() & set(entries) and set(SAME_METHOD.values()) <= set(entries)
    with pytest.raises(RsbenchError, match="points-3"):
        track_of_name("points-3")
    assert TRACKS["points"].split(None).truths[0].facts.keys().isdisjoint({"motion", "rig"})


# Readout ratios with their deviations


@pytest.mark.parametrize(("error", "sigma"), [(0.1, 0.02), (-0.3, 0.1), (0.0, 0.5), (0.01, 0.2)])
def test_the_crps_is_its_integral(error: float, sigma: float) -> None:
    def apart(x: float) -> float:
        return float((norm.cdf(x, error, sigma) - (x >= 0.0)) ** 2)

    low, high = min(error, 0.0) - 9.0 * sigma, max(error, 0.0) + 9.0 * sigma
    expected = sum(quad(apart, *ends, limit=200)[0] for ends in ((low, 0.0), (0.0, high)))
    assert crps(error, sigma) == pytest.approx(expected, rel=1e-7)  # the integral is known to 1e-8
    assert crps(error, 0.0) == abs(error) == pytest.approx(crps(error, 1e-9), abs=1e-9)


@settings(max_examples=200)
@given(
    st.lists(st.floats(0.0, 1.0), min_size=2, max_size=30, unique=True),
    st.floats(0.0, 1.0),
    st.just(0.0) | st.floats(1e-3, 1.0),
)
def test_nothing_that_is_stated_of_all_ratios_alike_beats_a_refusal(
    ratios: list[float], value: float, sigma: float
) -> None:
    blind = np.mean([crps(value - ratio, sigma) for ratio in ratios])
    assert blind >= spread_of(ratios) - 1e-12  # a refusal scores 0: 1 - spread / spread


def _read_out(split: Split, answers: Mapping[str, Mapping[str, Any]], folder: Path) -> pd.DataFrame:
    lines = ({"name": truth.name, **answers[truth.name]} for truth in split.truths)
    return scores_of(split, [_header(split), *lines], folder)


def _header(split: Split) -> dict[str, Any]:
    return {"protocol": split.track.id, "split": split.name, "method": "mine", "uses": ["left"]}


def test_a_wrong_ratio_with_a_small_deviation_is_the_worst_answer(tmp_path: Path) -> None:
    split = _without_frames("readout-3")
    true = {truth.name: truth.shutter.readout_ratio for truth in split.truths}
    kinds = {
        "sure and right": {name: {"readout_ratio": y, "readout_sigma": 0.01} for name, y in true.items()},
        "refused": {name: {"success": False} for name in true},
        "a blind guess with its deviation": {key: {"readout_ratio": 0.525, "readout_sigma": 0.25} for key in true},
        "a blind guess": {key: {"readout_ratio": 0.525} for key in true},
        "sure and wrong": {
            name: {"readout_ratio": y + (0.4 if y < 0.5 else -0.4), "readout_sigma": 0.01}
            for name, y in true.items()
        },
    }
    scores = {kind: _read_out(split, answers, tmp_path) for kind, answers in kinds.items()}
    means = [scores[kind]["skill"].mean() for kind in kinds]
    assert means == sorted(means, reverse=True) and means[1] == 0.0 and means[0] > 0.98
    assert scores["sure and wrong"]["wrong"].mean() == 1.0 and scores["sure and right"]["right"].mean() == 1.0
    # Squared errors over the stated variance: 0, and (0.4 / 0.01)^2.
    assert scores["sure and wrong"]["nees"].to_numpy() == pytest.approx(1600.0)
    assert scores["a blind guess"]["nees"].isna().all()


def test_a_score_that_is_no_number_is_damage(tmp_path: Path) -> None:
    split = _without_frames("readout-3")
    lines = [{"name": truth.name, "readout_ratio": 0.5} for truth in split.truths]
    path = write(tmp_path / "a.jsonl", [_header(split), *lines])
    file = add(tmp_path / "board", path, split, {}).folder / "scores.csv"
    table = pd.read_csv(file)
    for each in (table.assign(skill=-np.inf), table.assign(skill=np.nan), table.assign(nees="a"), table[:0]):
        each.to_csv(file, index=False)
        with pytest.raises(RsbenchError, match=r"scores\.csv: is damaged"):
            entries_of(tmp_path / "board", split.track.id, split.name)


# What is committed


def _without_frames(protocol: str) -> Split:
    """Of the card ``laws``, as it would be read, had it been rendered."""
    card = load_dataset_card("laws")
    pairs = [pair for sequence in publishing._sequences(card) for pair in sequence.pairs()]
    return Split(track=TRACKS[protocol], label=card.name, public=True, truths=tuple(map(truth_of, pairs)))


@pytest.mark.slow
@needs_results
@pytest.mark.parametrize("protocol", ["points-2", "pose-2", "readout-2", "readout-3"])
def test_stored_predictions_give_the_committed_table(protocol: str, split: Split, tmp_path: Path) -> None:
    split = split if protocol == TRACK.id else _without_frames(protocol)
    restore(LAWS_FOLDER / "predictions" / protocol, split, tmp_path / "board")
    found = table(standings(entries_of(tmp_path / "board", protocol, split.name)))
    (path,) = (LAWS_FOLDER / "site").glob(f"{protocol}--*.csv")
    stored = pd.read_csv(path)
    assert path.stem == f"{protocol}--{split.name}"
    assert list(found["method"]) == list(stored["method"]) and list(found.columns) == list(stored.columns)
    for name in found:
        if pd.api.types.is_numeric_dtype(stored[name]) and not pd.api.types.is_bool_dtype(stored[name]):
            # Another processor's sines differ in the last bits, and scores are kept with six digits.
            values = found[name].to_numpy(dtype=np.float64, na_value=np.nan)
            np.testing.assert_allclose(values, stored[name].to_numpy(dtype=np.float64), rtol=2e-5, atol=1e-9)
    made = json.loads((LAWS_FOLDER / "provenance.json").read_text("utf-8"))["entries"]
    names = {name.rpartition("/")[2] for name in made if name.startswith(f"{protocol}/")}
    assert names == set(found["method"])


@needs_results
@pytest.mark.parametrize("folder", ["leaderboard/predictions/points-1", "laws/predictions/points-2"])
def test_stored_entries_say_what_they_were_tuned_on(folder: str) -> None:
    """As their cards do today; whoever chooses adds what concerns its choice."""
    track = track_of_name(Path(folder).name)
    for file in (ROOT / "results" / folder).glob(f"*{SUFFIX}"):
        header = json.loads(lzma.decompress(file.read_bytes()).partition(b"\n")[0])
        if header["uses"] != [ORACLE]:
            assert header["tuned_on"] == track.runnable(header["method"]).header["tuned_on"] != ""
            assert "2026" in header["tuned_on"] or header["tuned_on"] == "nothing"


@pytest.mark.slow
@needs_results
def test_of_a_shaking_hand_no_ratio_is_stated(tmp_path: Path) -> None:
    """As the page of the readout ratio says, by the stored answers."""
    split = _without_frames("readout-3")
    restore(LAWS_FOLDER / "predictions" / "readout-3", split, tmp_path / "board")
    scores = entered(tmp_path / "board", split)[CHOOSES].scores.set_index("problem")
    hand = scores.index.str.contains("-spline-")
    assert np.count_nonzero(hand) == 36 and not np.any(scores["success"].astype(bool)[hand])


def test_damaged_predictions_are_named(split: Split, tmp_path: Path) -> None:
    with pytest.raises(RsbenchError, match="holds no predictions"):
        restore(tmp_path, split, tmp_path / "board")
    (tmp_path / f"a{SUFFIX}").write_bytes(b"nothing")
    with pytest.raises(RsbenchError, match="is no xz file"):
        restore(tmp_path, split, tmp_path / "board")


@pytest.fixture(scope="module")
def readouts() -> Split:
    """Of the card, from a secret: nothing is rendered."""
    return drawn_split(TRACKS["readout-2"], "laws", Secret("a text that nobody can guess"))


@pytest.mark.parametrize("limits", ["[0.9, 0.1]", "[0.1, 1.2]", "[0.5, 0.5]"])
def test_ranges_of_ratios_that_are_none_are_refused(limits: str, tmp_path: Path) -> None:
    text = (ROOT / "cards" / "datasets" / "laws.toml").read_text("utf-8")
    path = tmp_path / "wrong.toml"
    path.write_text(text.replace("[0.1, 0.95]", limits), "utf-8")
    assert_refused(run_here("generate", path, "--out", tmp_path / "out"), "readout_range")


def test_no_constant_wins_the_ratio(readouts: Split, tmp_path: Path) -> None:
    """The best of all constants, found by trying a thousand, has what the oracle has, and that is little."""
    found = oracle_scores(readouts, tmp_path)
    assert list(found) == ["truth", "constant"]
    scores = {name: each["auc_r10"] for name, each in found.items()}
    ratios = np.array([truth.shutter.readout_ratio for truth in readouts.truths])
    tried = [np.mean(np.clip(1.0 - np.abs(ratios - c) / 0.1, 0.0, None)) for c in np.linspace(0.0, 1.0, 1001)]
    assert scores["truth"].mean() == 1.0
    assert max(tried) - 1e-3 <= scores["constant"].mean() + 1e-12 and scores["constant"].mean() < 0.2
    assert best_constant([0.2, 0.21, 0.9]) in (0.2, 0.21)
    header, *answers = lines_of(tmp_path / "constant" / "predictions.jsonl")
    assert header["uses"] == ["truth"] and len({line["readout_ratio"] for line in answers}) == 1


def test_ratios_that_repeat_are_refused(smoke_dataset: Path, tmp_path: Path) -> None:
    counts = Counter(truth.shutter.readout_ratio for truth in TRACKS["pose"].split(smoke_dataset).truths)
    assert max(counts.values()) > 1
    ran = run_here("leaderboard", "template", "readout-2", "--data", smoke_dataset)
    assert_refused(ran, "sequences have the readout ratio")


def test_rotation_counts_apart(readouts: Split, tmp_path: Path) -> None:
    """Of motions whose rotation alone is wrong by 0.05 deg, and of the others."""
    split = replace(readouts, track=TRACKS["pose-2"])
    lines = named(truth_lines(split), "mine", ("left", "right"))
    for line in lines[1:]:
        turned = so3.exp(np.deg2rad([0.05, 0.0, 0.0])) @ so3.exp(np.array(line["w"]))
        line["w"] = so3.log(turned).tolist()
    scores = scores_of(split, lines, tmp_path)
    np.testing.assert_allclose(scores["auc_R"], 0.5, atol=1e-9)
    np.testing.assert_allclose(scores["auc_T"], 1.0, atol=1e-6)  # an angle from its sine and cosine
    np.testing.assert_allclose(scores["auc_apart"], 0.75, atol=1e-6)
    assert set(scores["motion"]) == {"linear", "twist", "inertial", "accelerated", "spline"}


def test_who_chooses_a_law_runs_on_frames(smoke_dataset: Path, tmp_path: Path) -> None:
    board = ("--board", tmp_path / "board", "--data", smoke_dataset)
    run_entries("pose-2", ["rs-stereo-auto"], *board)
    split = TRACKS["pose-2"].split(smoke_dataset)
    (entry,) = entered(tmp_path / "board", split).values()
    assert entry.header.motion_model == "chosen" and entry.scores["success"].all()
    assert np.all(entry.scores["e_R_deg"] < [float(truth.facts["rotation_deg"]) for truth in split.truths])
    leaderboard("build", *board[:2], "--out", tmp_path / "site")
    assert '<td class="text">chosen</td>' in (tmp_path / "site" / "index.html").read_text("utf-8")
