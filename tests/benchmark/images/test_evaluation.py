"""Evaluations: what is kept, and what is made again."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from evaluations import QUICK, cell, contents, evaluate, remade, times

from rsbench.benchmark.images.evaluation import columns_of, open_evaluation, read_scores
from rsbench.benchmark.images.score import TABLES
from rsbench.core.errors import RsbenchError
from rsbench.storage import files
from rsbench.storage.files import load_matches
from rsbench.storage.work_folder import work_folder


def solvers_of(out: Path) -> set[str]:
    return set(read_scores(out, "pose")["solver"])


# What is kept


def test_two_runs_write_the_same_bytes(smoke_dataset: Path, evaluated: Path, tmp_path: Path) -> None:
    evaluate(smoke_dataset, tmp_path)
    assert contents(tmp_path) == contents(evaluated)


def test_a_repeated_run_makes_nothing_and_reads_no_data_again(
    smoke_dataset: Path, copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "sha256", lambda path: pytest.fail(f"{path} is read again"))
    before = times(copy)
    evaluate(smoke_dataset, copy)
    assert remade(before, copy) == set()


def test_two_evaluations_do_not_share_a_folder(smoke_dataset: Path, copy: Path) -> None:
    with work_folder(copy), pytest.raises(RsbenchError, match=f"process {os.getpid()} on .* is at work there"):
        evaluate(smoke_dataset, copy)


def test_one_more_solver_redoes_and_deletes_nothing(smoke_dataset: Path, copy: Path) -> None:
    before, others = times(copy), read_scores(copy, "pose")
    evaluate(smoke_dataset, copy, solvers=("gs-poselib",))
    assert remade(before, copy) == {"castle/motion/gs-poselib", "room-twist/motion/gs-poselib"}
    pose = read_scores(copy, "pose")
    assert set(pose["solver"]) == {"gs-8pt", "gs-poselib", "rs-stereo-refined"}
    kept = pose[pose["solver"] != "gs-poselib"].reset_index(drop=True)
    pd.testing.assert_frame_equal(kept, others)


def test_an_interrupted_run_goes_on_where_it_stopped(smoke_dataset: Path, evaluated: Path, tmp_path: Path) -> None:
    def stop(word: str) -> None:
        if word == "room-twist: gs-8pt":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate(smoke_dataset, tmp_path, stop)
    before = times(tmp_path)
    assert "predictions/room-twist/motion/gs-8pt.json" in before
    evaluate(smoke_dataset, tmp_path)
    again = remade(before, tmp_path)
    assert not any(name.startswith("castle/") for name in again)
    assert not {"room-twist/matches", "room-twist/motion/gs-8pt"} & again
    assert contents(tmp_path) == contents(evaluated)


def test_half_an_artefact_is_made_again(smoke_dataset: Path, evaluated: Path, copy: Path) -> None:
    # As a run that was killed between the files of an artefact and its record leaves it.
    (copy / "predictions/castle/depth/sgm.json").unlink()
    (copy / "predictions/castle/depth/sgm.npz").write_bytes(b"half")
    evaluate(smoke_dataset, copy)
    assert contents(copy) == contents(evaluated)


def test_other_images_make_everything_stale(smoke_dataset: Path, copy: Path, tmp_path: Path) -> None:
    data = Path(shutil.copytree(smoke_dataset, tmp_path / "data"))
    image = data / "castle" / "rs" / "left_0.png"
    image.write_bytes((data / "castle" / "gs" / "left_0.png").read_bytes())
    before = times(copy)
    stale = evaluate(data, copy, only=("room-twist",))
    assert remade(before, copy) == set()
    assert "castle/motion/gs-8pt" in stale and set(read_scores(copy, "pose")["sequence"]) == {"room-twist"}
    evaluate(data, copy)
    again = {name for name in remade(before, copy) if "/motion/" in name}
    assert again == {"castle/motion/gs-8pt", "castle/motion/rs-stereo-refined"}


def card(path: Path, cls: str, **parameters: Any) -> Path:
    lines = [f'class = "{cls}"', "[parameters]"]
    lines += [f"{key} = {json.dumps(value)}" for key, value in parameters.items()]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_changed_card_inside_a_scaled_solver_is_seen(smoke_dataset: Path, copy: Path, tmp_path: Path) -> None:
    inner = card(tmp_path / "inner.toml", "rsbench.solvers.refined:RefinedSolver", shutter="global")
    outer = card(tmp_path / "outer.toml", "rsbench.solvers.zhuang:FlowScaledSolver", solver=str(inner))
    evaluate(smoke_dataset, copy, solvers=(str(outer),))
    before = times(copy)
    evaluate(smoke_dataset, copy, solvers=(str(outer),))
    assert remade(before, copy) == set()
    card(inner, "rsbench.solvers.refined:RefinedSolver", shutter="global", use_pairs=False)
    assert evaluate(smoke_dataset, copy, solvers=("gs-8pt",)) == ["castle/motion/outer", "room-twist/motion/outer"]
    assert "outer" not in solvers_of(copy)
    assert remade(before, copy) == set()
    evaluate(smoke_dataset, copy, solvers=(str(outer),))
    assert remade(before, copy) == {"castle/motion/outer", "room-twist/motion/outer"}


def test_a_record_makes_nobody_load_the_card_that_it_names(
    smoke_dataset: Path, copy: Path, tmp_path: Path
) -> None:
    planted = card(tmp_path / "planted.toml", "planted_solver:Planted")
    (tmp_path / "planted_solver.py").write_text(f"open({str(tmp_path / 'was-run')!r}, 'w')\n")
    folder = copy / "predictions" / "castle"
    for kind in ("motion", "depth", "corrected"):
        path = sorted((folder / kind).glob("*.json"))[0]
        record = json.loads(path.read_text()) | {"identity": "", "solver": "planted"}
        if kind == "depth":
            record = {key: value for key, value in record.items() if key != "solver"} | {"matcher": "planted"}
        if kind == "corrected":
            record["entries"] = dict.fromkeys(record["entries"], str(planted))
        else:
            record["entry"] = str(planted)
        (folder / kind / "planted.json").write_text(json.dumps(record))
    stale = evaluate(smoke_dataset, copy)
    assert {"castle/motion/planted", "castle/depth/planted"} < set(stale) and len(stale) == 3
    assert not (tmp_path / "was-run").exists()


def test_only_and_force_make_again_what_they_name(smoke_dataset: Path, copy: Path) -> None:
    before, was = times(copy), contents(copy)
    evaluate(smoke_dataset, copy, only=("gs-8pt",), force=True)
    assert remade(before, copy) == {"castle/motion/gs-8pt", "room-twist/motion/gs-8pt"}
    assert contents(copy) == was
    before = times(copy)
    evaluate(smoke_dataset, copy, only=("castle",), force=True)
    again = remade(before, copy)
    assert {"castle/matches", "castle/depth/sgm", "castle/motion/rs-stereo-refined"} < again
    assert not any(name.startswith("room-twist") for name in again)
    assert contents(copy) == was


def test_only_refuses_what_is_not_there(smoke_dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(RsbenchError, match=r"--only castel: is neither .* \(did you mean 'castle'\?\)"):
        evaluate(smoke_dataset, tmp_path, only=("castel",))


# Names


def test_two_entries_of_one_name_are_refused(smoke_dataset: Path, copy: Path, tmp_path: Path) -> None:
    twin = card(tmp_path / "gs-8pt.toml", "rsbench.solvers.refined:RefinedSolver")
    with pytest.raises(RsbenchError, match=rf"--solver gs-8pt and --solver {twin}: both have the name 'gs-8pt'"):
        evaluate(smoke_dataset, copy, solvers=("gs-8pt", str(twin)))
    was = contents(copy)
    with pytest.raises(RsbenchError, match=rf"of another 'gs-8pt', gs-8pt, not of {twin}; .* --force"):
        evaluate(smoke_dataset, copy, solvers=(str(twin),))
    assert contents(copy) == was
    evaluate(smoke_dataset, copy, solvers=(str(twin),), force=True, only=("gs-8pt",))
    record = json.loads((copy / "predictions/castle/motion/gs-8pt.json").read_text())
    assert (record["entry"], record["shutter"]) == (str(twin), "rolling")


def test_a_solver_without_metres_does_not_correct(smoke_dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(RsbenchError, match="--correct-with gs-8pt: gives no length of d in metres"):
        evaluate(smoke_dataset, tmp_path, correction_solver="gs-8pt")
    assert not (tmp_path / "predictions").exists()


# Files


def test_columns_are_the_planned_ones(smoke_dataset: Path, evaluated: Path) -> None:
    plan = open_evaluation(smoke_dataset, evaluated, QUICK).plan
    for table in TABLES:
        assert list(read_scores(evaluated, table)) == columns_of(table, plan)


def test_each_match_is_counted_once(evaluated: Path) -> None:
    pose = read_scores(evaluated, "pose")
    for sequence in ("castle", "room-twist"):
        matches = load_matches(evaluated / "predictions" / sequence / "matches.npz")
        left = {tuple(row) for row in matches.left} | {tuple(row) for row in matches.tracks[:, [0, 1, 4, 5]]}
        inliers, counted = (
            cell(pose, name, sequence=sequence, solver="gs-8pt") for name in ("inliers", "matches")
        )
        assert counted == len(left) and 0 < inliers <= counted
