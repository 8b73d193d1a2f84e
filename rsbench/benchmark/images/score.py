"""Compute scores of stored predictions against the ground truth; no solver runs here.

Scores of depth and of corrected frames are stored and reused; those of motions take no time.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from functools import cache, cached_property, partial
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.images.plan import NONE, Places, Plan, stored_corrections, stored_depths, stored_motions
from rsbench.benchmark.images.predict import depth_of, load_disparities, true_pairs
from rsbench.benchmark.images.store import Artefact, identity_of, keep, kept, read_seconds
from rsbench.benchmark.provenance import numeric_version, package_version
from rsbench.benchmark.scoring import Case, DepthCase, ImageCase, PoseCase, answered, score
from rsbench.capture.hypotheses import KnownInputs
from rsbench.components.imports import hash_of_files
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import VIEWS, Side, View
from rsbench.dataset.corrected_frames import read_origin
from rsbench.dataset.sequence import Sequence
from rsbench.pipeline.chain import Given, correct_four
from rsbench.pipeline.frame_depth import CorrectionOptions, Pairs
from rsbench.storage.files import read_png, sha256
from rsbench.storage.work_folder import HIDDEN
from rsbench.vision.corrector import load_corrector
from rsbench.vision.fusion import Origin
from rsbench.vision.stereo_depth import seen_by_other

Row = dict[str, Any]
_PACKAGES = ("flip-evaluator", "matplotlib", "OpenEXR")
"""Packages that affect scores and pictures, in addition to those that affect predictions."""


def kept_scores(out: Path, sequence: str) -> Path:
    """Folder in which an evaluation in ``out`` stores the scores of a sequence."""
    return out / HIDDEN / "scores" / sequence


@cache
def scoring_version() -> dict[str, str]:
    """Return everything that determines a score apart from its inputs: the source of rsbench and the versions of
    its packages."""
    package = Path(str(resources.files("rsbench")))
    return {
        **numeric_version(),
        **{name: package_version(name) for name in _PACKAGES},
        "source": hash_of_files(package, sorted(package.rglob("*.py"))),
    }


def hash_of_prediction(files: Iterable[Path]) -> str:
    """Return a hash of the content of a prediction's files; a missing file changes it."""
    found = [f"{path.name} {sha256(path) if path.is_file() else 'is not there'}" for path in files]
    return hashlib.sha256("\n".join(found).encode()).hexdigest()


TABLES = ("pose", "depth", "correction", "failures", "seconds")
KEYS = {
    "pose": ("sequence", "solver", "seed", "shutter", "data_model", "assumed_model", "uses", "success"),
    "depth": ("sequence", "matcher", "side", "frame", "pixels", "success"),
    "correction": ("sequence", "corrector", "solver", "matcher", "side", "frame", "pixels", "success", "coverage"),
    "failures": ("sequence", "kind", "name", "reason"),
    "seconds": ("sequence", "prediction", "seconds"),
}
"""First columns of each table; the columns of the metrics follow."""
AFTER = {"pose": ("inliers", "matches", "iterations", "reason")}
"""Columns after those of the metrics."""
_SEES = "single-view"
"""Corrector that determines the pixels of a corrected frame that are visible in the rolling-shutter frame."""


class Scorer:
    """Rows of all tables for one sequence."""

    def __init__(self, places: Places, plan: Plan, kept: Path | None = None, rehash: bool = False) -> None:
        """
        Args:
            places: paths and identities of the predictions.
            plan: the evaluation.
            kept: folder in which scores are stored and reused, see ``kept_scores``; None: nothing is stored.
            rehash: whether stored scores are computed again.
        """
        self.places, self.plan, self.sequence = places, plan, places.sequence
        self._kept, self._rehash = kept, rehash
        self.rows: dict[str, list[Row]] = {table: [] for table in TABLES}
        self.stale: list[str] = []
        """Predictions on disk that are not current, and are not scored."""
        self._failing: list[Row] = []
        """Rows that the current part adds to the table of failures."""

    def score(self) -> None:
        """Fill ``rows`` from the stored current predictions."""
        self._score_matches()
        self._score_poses()
        self._score_depth()
        self._score_correction()
        seconds = read_seconds(self.places.folder).items()
        self._add("seconds", ({"prediction": name, "seconds": value} for name, value in seconds))

    def _add(self, table: str, rows: Iterable[Row]) -> None:
        self.rows[table] += [{"sequence": self.sequence.name, **row} for row in rows]

    def _add_part(
        self, table: str, name: str, files: list[Path], case: type[Case], rows: Callable[[], Iterable[Row]]
    ) -> None:
        """Add the rows of the prediction in ``files``: stored ones if none of their inputs has changed."""
        key = identity_of(
            code=scoring_version(),
            sequence=self.sequence.name,
            table=table,
            truth=self.places.scored_truth,
            prediction=hash_of_prediction(files),
            metrics=[[each.name, each.key] for each in self.plan.metrics if each.component.case is case],
            visible=load_corrector(_SEES).key,
        )
        path = None if self._kept is None else self._kept / f"{name}.json"
        part = None if path is None or self._rehash else kept(path, key)
        if part is None:
            self._failing = []
            part = {"rows": list(rows()), "failures": self._failing}
            if path is not None and all(row["kind"] != "metric" for row in self._failing):
                keep(path, key, part)
        else:
            for row in part["failures"]:
                self._fail(**row)
        self._add(table, part["rows"])

    def _fail(self, kind: str, name: str, reason: str) -> None:
        about = {"kind": kind, "name": name, "reason": reason}
        self._failing.append(about)
        row = {"sequence": self.sequence.name, **about}
        if row not in self.rows["failures"]:
            self.rows["failures"].append(row)

    def _metrics(self, case: Case | None, kind: type[Case]) -> dict[str, float]:
        """Return the columns of all metrics for this type of case; NaN if another package's metric failed."""
        row: dict[str, float] = {}
        for metric in self.plan.metrics:
            if metric.component.case is kind:
                try:
                    row |= score(metric, case)
                except RsbenchError as error:
                    self._fail("metric", metric.name, str(error))
                    row |= {column.name: np.nan for column in metric.component.columns}
        return row

    def _score_matches(self) -> None:
        record = self.places.matches().record()
        if record is not None and not record["success"]:
            self._fail("feature matcher", record["features"], record["reason"])

    def _score_poses(self) -> None:
        rows = []
        for record, solver in stored_motions(self.places, self.plan):
            if solver is None:
                self.stale.append(f"{self.sequence.name}/motion/{record.get('solver')}")
                continue
            case = self._pose_case(record)
            if case is None:
                self._fail("solver", record["solver"], record["reason"])
            rows.append(
                {
                    "solver": record["solver"],
                    "seed": record["seed"],
                    "shutter": record["shutter"],
                    "data_model": self.sequence.data_model,
                    "assumed_model": record["motion_model"],
                    "uses": "+".join(record["uses"]),
                    "success": case is not None,
                    **self._metrics(case, PoseCase),
                    "inliers": sum(record["inliers"].values()),
                    "matches": sum(record["matches"].values()),
                    "iterations": record["iterations"],
                    "reason": record["reason"],
                }
            )
        self._add("pose", rows)

    def _pose_case(self, record: Row) -> PoseCase | None:
        if not record["success"] or not answered(record["w"], record["d"]):
            return None
        return PoseCase(
            w=np.array(record["w"]),
            d=np.array(record["d"]),
            metric=record["metric"],
            reference_point=record["reference_point"],
            truth=self.sequence.motion,
            rig=self.sequence.rig,
            shutter=self.sequence.shutter,
        )

    def _score_depth(self) -> None:
        for record, matcher in stored_depths(self.places):
            if matcher is None:
                self.stale.append(f"{self.sequence.name}/depth/{record.get('matcher')}")
                continue
            artefact = self.places.depth(matcher)
            files = [artefact.file(".json"), artefact.file(".npz")]
            self._add_part("depth", artefact.name, files, DepthCase, partial(self._depth_part, record, files[1]))

    def _depth_part(self, record: Row, file: Path) -> Iterator[Row]:
        stored = None
        if record["success"]:
            stored = load_disparities(file, self.sequence.rig)
        else:
            self._fail("matcher", record["matcher"], record["reason"])
        for side, frame in VIEWS:
            rig, truth = self.sequence.rig, self.sequence.depth("rs", side, frame)
            other: Side = "right" if side == "left" else "left"
            seen = seen_by_other(truth, self.sequence.depth("rs", other, frame), rig, side)
            depth = None
            if stored is not None:
                depth = depth_of(stored[f"{side}_{frame}"], self.sequence, side, frame, timed=record["timed"])
            for name, part in (("all", np.ones_like(seen)), ("visible", seen), ("occluded", ~seen)):
                case = None if depth is None else DepthCase(depth=depth, truth=truth, pixels=part, rig=rig)
                keys: Row = {"matcher": record["matcher"], "side": side, "frame": frame, "pixels": name}
                yield keys | {"success": case is not None} | self._metrics(case, DepthCase)

    def _score_correction(self) -> None:
        recipes = list(stored_corrections(self.places))
        if recipes:
            self._add_part("correction", "corrected/none", [], ImageCase, self._uncorrected_part)
        for record, recipe in recipes:
            names = {name: str(record.get(name)) for name in ("corrector", "solver", "matcher")}
            if recipe is None:
                self.stale.append(f"{self.sequence.name}/corrected/{'+'.join(names.values())}")
                continue
            artefact = self.places.corrected(recipe)
            ends = [f"-{side}_{frame}{end}.png" for side, frame in VIEWS for end in ("", "-origin")]
            files = [artefact.file(end) for end in (".json", *ends)]
            rows = partial(self._corrected_part, record, names, artefact)
            self._add_part("correction", artefact.name, files, ImageCase, rows)

    def _uncorrected_part(self) -> Iterator[Row]:
        names = dict.fromkeys(("corrector", "solver", "matcher"), NONE)
        for view in VIEWS:
            rolling = self.sequence.image("rs", *view)
            yield from self._image_rows(names, view, rolling, np.ones(rolling.shape[:2], np.bool_))

    def _corrected_part(self, record: Row, names: dict[str, str], artefact: Artefact) -> Iterator[Row]:
        if not record["success"]:
            self._fail("correction", "+".join(names.values()), record["reason"])
        lost = record.get("failures", {})
        for view, reason in lost.items():
            self._fail("correction", "+".join(names.values()), f"{view}: {reason}")
        size = self.sequence.rig.camera.width, self.sequence.rig.camera.height
        for view in VIEWS:
            image = drawn = None
            end = f"-{view[0]}_{view[1]}"
            if record["success"] and end[1:] not in lost:
                image = read_png(artefact.file(f"{end}.png"), size)
                drawn = read_origin(artefact.file(f"{end}-origin.png"), size) != Origin.NOBODY
            yield from self._image_rows(names, view, image, drawn)

    def _image_rows(
        self, names: Row, view: View, image: NDArray[np.uint8] | None, drawn: NDArray[np.bool_] | None
    ) -> Iterator[Row]:
        truth, visible = self._truths[view], self._visible[view]
        for name, part in (("visible", visible), ("all", np.ones_like(visible))):
            case, coverage = None, 0.0
            if image is not None and drawn is not None:
                case = ImageCase(image=image, truth=truth, pixels=part)
                coverage = float(np.mean(drawn[part])) if np.any(part) else np.nan
            keys = {**names, "side": view[0], "frame": view[1], "pixels": name, "success": case is not None}
            yield keys | {"coverage": coverage} | self._metrics(case, ImageCase)

    @cached_property
    def _truths(self) -> dict[View, NDArray[np.uint8]]:
        return {view: self.sequence.image("gs", *view) for view in VIEWS}

    @cached_property
    def _visible(self) -> dict[View, NDArray[np.bool_]]:
        images = {view: self.sequence.image("rs", *view) for view in VIEWS}
        return visible_pixels(self.sequence, true_pairs(self.sequence, images), VIEWS)


def visible_pixels(
    sequence: Sequence, pairs: Pairs, views: tuple[View, ...], target_row: float = 0.0
) -> dict[View, NDArray[np.bool_]]:
    """Pixels (H, W) of corrected frames whose scene points the rolling-shutter frame saw, by true depth and
    motion.

    Args:
        pairs: the frames with their true depth.
        views: the requested frames.
        target_row: the row to whose time they are corrected.
    """
    images = {(side, frame): pairs[frame].images[side] for side, frame in VIEWS}
    given = Given(motion=sequence.motion, pairs=pairs)
    options = CorrectionOptions(corrector=load_corrector(_SEES), depth_from_motion=False, target_row=target_row)
    inputs = KnownInputs.of(sequence.shutter)
    found = correct_four(images, sequence.rig, inputs, options, given=given, views=views)
    return {view: fused.origin == Origin.HERE for view, fused in found.frames.items()}
