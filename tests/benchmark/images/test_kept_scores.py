"""Scores that are kept: computed again when anything changes that they depend on, and only then."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from evaluations import QUICK, contents, evaluate

from rsbench.benchmark.images import score
from rsbench.benchmark.images.plan import Places, Plan, make_plan
from rsbench.benchmark.images.score import Row, Scorer, kept_scores
from rsbench.benchmark.scoring import DepthCase, ImageCase
from rsbench.core.errors import RsbenchError
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.report.evaluation_page import write_pictures
from rsbench.storage.files import read_png, sha256, write_png

RECIPES = 5
"""Pictures of a frame that are scored: uncorrected, and with motion, depth, both or none from the truth."""
ALL = {DepthCase: 4 * 3, ImageCase: 4 * 2 * RECIPES}
"""Cases of a sequence: four frames, in three sets of pixels and in two."""


class Bench:
    """A sequence that is its own to change, with predictions that stand and scores that are kept."""

    def __init__(self, data: Path, out: Path) -> None:
        self.data, self.out = data, out
        self.sequence: Sequence = read_dataset(data)[0]
        self.plan: Plan = make_plan(QUICK, [self.sequence])
        self.folder = out / "predictions" / self.sequence.name
        self.kept = kept_scores(out, self.sequence.name)

    def rows(self, kept: Path | None = None) -> dict[str, list[Row]]:
        scorer = Scorer(Places(self.sequence, self.folder, self.plan.chain), self.plan, kept)
        scorer.score()
        return scorer.rows


@pytest.fixture
def bench(smoke_dataset: Path, copy: Path, tmp_path: Path) -> Bench:
    data = tmp_path / "data"
    shutil.copytree(smoke_dataset / "castle", data / "castle")
    manifest = json.loads((smoke_dataset / "dataset.json").read_text())
    (data / "dataset.json").write_text(json.dumps(manifest | {"sequences": ["castle"]}))
    return Bench(data, copy)


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> Counter[Any]:
    """How many cases the first metric of each kind has been asked for."""
    asked, real = Counter[Any](), score.score

    def counted(metric: Any, case: Any) -> dict[str, float]:
        asked[type(case)] += metric.name in ("depth", "psnr")
        return real(metric, case)

    monkeypatch.setattr(score, "score", counted)
    return asked


def repaint(path: Path) -> None:
    """Another first pixel."""
    image = read_png(path)
    image[0, 0] ^= 1
    write_png(path, image)


def append(path: Path) -> None:
    """An empty line."""
    path.write_text(path.read_text() + "\n")


def other_version(name: str) -> Callable[[Bench, pytest.MonkeyPatch], None]:
    """Scores by other code: a function of ``score`` that identifies it returns something else."""

    def change(bench: Bench, patch: pytest.MonkeyPatch) -> None:
        patch.setattr(score, name, lambda *arguments: "other")
        score.scoring_version.cache_clear()

    return change


def other_metric(bench: Bench, patch: pytest.MonkeyPatch) -> None:
    metrics = (replace(each, key="other") if each.name == "psnr" else each for each in bench.plan.metrics)
    bench.plan = replace(bench.plan, metrics=tuple(metrics))


def other_number(bench: Bench, patch: pytest.MonkeyPatch) -> None:
    """In a stored score."""
    file = bench.kept / "corrected" / "none.json"
    head, key, tail = file.read_text().partition('"psnr": ')
    file.write_text(head + key + ("1" if tail[0] != "1" else "2") + tail[1:])


CHANGES: dict[str, tuple[Callable[[Bench, pytest.MonkeyPatch], object], dict[type, int]]] = {
    "nothing": (lambda bench, patch: None, {}),
    "a picture": (
        lambda bench, patch: repaint(bench.folder / "corrected/fusion+rs-stereo-refined+sgm-left_0.png"),
        {ImageCase: 8},
    ),
    "a record": (lambda bench, patch: append(bench.folder / "depth/sgm.json"), {DepthCase: 12}),
    "the true frames": (lambda bench, patch: repaint(bench.data / "castle/gs/right_1.png"), ALL),
    "a metric of images": (other_metric, {ImageCase: ALL[ImageCase]}),
    "the source": (other_version("hash_of_files"), ALL),
    "a package": (other_version("package_version"), ALL),
    "a stored score": (other_number, {ImageCase: 8}),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_of_anything_computes_what_depends_on_it(
    change: str, bench: Bench, computed: Counter[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    make, due = CHANGES[change]
    try:
        make(bench, monkeypatch)
        computed.clear()
        rows = bench.rows(bench.kept)
        assert {kind: computed[kind] for kind in ALL if computed[kind]} == due
        assert repr(rows) == repr(bench.rows())  # as text, in which NaN equals itself
    finally:
        monkeypatch.undo()
        score.scoring_version.cache_clear()


def test_a_metric_that_failed_is_asked_again(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(metric: Any, case: Any) -> dict[str, float]:
        raise RsbenchError("took too long")

    shutil.rmtree(bench.kept)
    with monkeypatch.context() as patch:
        patch.setattr(score, "score", failing)
        rows = bench.rows(bench.kept)
    assert {row["reason"] for row in rows["failures"]} == {"took too long"}
    assert bench.rows(bench.kept)["failures"] == []


def test_rehash_scores_again_to_the_same_bytes(
    smoke_dataset: Path, evaluated: Path, copy: Path, computed: Counter[Any]
) -> None:
    evaluate(smoke_dataset, copy)
    assert not computed[ImageCase] and contents(copy) == contents(evaluated)
    evaluate(smoke_dataset, copy, rehash=True)
    assert computed[ImageCase] == 2 * ALL[ImageCase] and contents(copy) == contents(evaluated)


def test_pictures_are_drawn_again_when_they_would_be_others(bench: Bench) -> None:
    chosen = {"corrector": "fusion", "solver": "rs-stereo-refined", "matcher": "sgm"}
    picture = bench.out / "pictures/castle/corrected.jpg"

    def drawn() -> bool:
        """Whether it was written, by another file of the name."""
        before = picture.stat().st_ino
        captions = write_pictures(bench.sequence, bench.out, chosen, sha256)
        assert captions.keys() == {path.stem for path in picture.parent.iterdir()}
        return picture.stat().st_ino != before

    write_pictures(bench.sequence, bench.out, chosen, sha256)
    assert not drawn()
    repaint(bench.folder / "corrected/fusion+rs-stereo-refined+sgm-left_1.png")
    assert drawn() and not drawn()
    picture.write_bytes(b"")
    assert drawn() and not drawn()
    repaint(bench.data / "castle/gs/left_1.png")
    assert drawn() and not drawn()
