"""Pictures of an evaluation: a frame of each sequence with what was predicted of it, beside the truth.

They are kept, like scores: what has not changed is not drawn again.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsbench.benchmark.images.kept_scores import hash_of_prediction, scoring_version
from rsbench.benchmark.images.plan import SCORED, HashOf, hash_of_data
from rsbench.benchmark.images.predict import depth_of, load_disparities
from rsbench.benchmark.images.store import identity_of, read_record
from rsbench.core.rig import View
from rsbench.dataset.corrected_frames import read_origin
from rsbench.dataset.sequence import Sequence
from rsbench.report import pictures
from rsbench.report.pictures import Image
from rsbench.storage.files import load_arrays, load_matches, read_png, write_bytes, write_json
from rsbench.storage.work_folder import HIDDEN
from rsbench.vision.fusion import Origin

_LONGEST = 640
"""Pixels of a picture in the page; enough to see a shift of two pixels at 900."""
_SHOWN: View = ("left", 1)
"""The frame that is drawn."""
_DEPTH_ERROR_M = 2.0
"""End of the scale of depth errors: the paper's limit of a good depth."""

_NAMES = {"rolling", "global", "rolling-over-global", "corrected", "corrected-over-global", "matches"} | {
    *("depth-truth", "depth", "depth-error"),
}

Drawn = dict[str, tuple[Image, str]]


def write_pictures(sequence: Sequence, out: Path, chosen: dict[str, str], hash_of: HashOf) -> dict[str, str]:
    """Write pictures/<sequence>/NAME.jpg below ``out``; returns the captions by NAME.

    Args:
        sequence: with the truth.
        out: folder of the evaluation.
        chosen: names of corrector, solver and matcher whose predictions are drawn.
        hash_of: gives the SHA-256 of a file of the sequence.
    """
    predictions, folder = out / "predictions" / sequence.name, out / "pictures" / sequence.name
    kept = out / HIDDEN / "pictures" / f"{sequence.name}.json"
    key = identity_of(
        code=scoring_version(),
        sequence=sequence.name,
        chosen=chosen,
        data=hash_of_data(sequence, SCORED, hash_of),
        predictions=hash_of_prediction(_files_drawn(predictions, chosen)),
    )
    captions = _kept_captions(read_record(kept) or {}, key, folder)
    if captions is not None:
        return captions
    drawn = draw_sequence(sequence, predictions, chosen)
    folder.mkdir(parents=True, exist_ok=True)
    for name, (image, _) in drawn.items():
        write_bytes(folder / f"{name}.jpg", pictures.encode_jpeg(pictures.shrink(image, _LONGEST)))
    captions = {name: caption for name, (_, caption) in drawn.items()}
    kept.parent.mkdir(parents=True, exist_ok=True)
    made = hash_of_prediction(_jpegs(folder, captions))
    write_json(kept, {"key": key, "pictures": made, "captions": captions})
    return captions


def _kept_captions(record: dict[str, Any], key: str, folder: Path) -> dict[str, str] | None:
    """Those of pictures that are as they were written, from what they would be drawn of today; else None."""
    captions = record.get("captions")
    if not isinstance(captions, dict) or not captions.keys() <= _NAMES:
        return None
    same = record.get("key") == key and record.get("pictures") == hash_of_prediction(_jpegs(folder, captions))
    return {str(name): str(caption) for name, caption in captions.items()} if same else None


def _jpegs(folder: Path, names: Any) -> list[Path]:
    return [folder / f"{name}.jpg" for name in names]


def _corrected_stem(folder: Path, chosen: dict[str, str]) -> Path:
    return folder / "corrected" / ("+".join(chosen.values()) + f"-{_SHOWN[0]}_{_SHOWN[1]}")


def _files_drawn(folder: Path, chosen: dict[str, str]) -> list[Path]:
    """Predictions that pictures come from."""
    stem, depth = _corrected_stem(folder, chosen), folder / "depth" / f"{chosen['matcher']}.npz"
    corrected = [stem.with_name(f"{stem.name}{end}.png") for end in ("", "-origin")]
    inliers = folder / "motion" / f"{chosen['solver']}-inliers.npz"
    return [folder / "matches.npz", inliers, depth, depth.with_suffix(".json"), *corrected]


def draw_sequence(sequence: Sequence, folder: Path, chosen: dict[str, str]) -> Drawn:
    """Pictures of the left camera's frame 1, as far as there are predictions: name to image and caption."""
    rolling, truth = sequence.image("rs", *_SHOWN), sequence.image("gs", *_SHOWN)
    drawn: Drawn = {
        "rolling": (rolling, "Rolling-shutter frame (left, frame 1); hover: global-shutter truth"),
        "global": (truth, "Global-shutter truth at row 0's pose"),
        "rolling-over-global": (
            pictures.overlay(rolling, truth),
            "Rolling-shutter frame (red) over the truth (cyan): colours show the distortion",
        ),
    }
    return (
        drawn
        | _draw_corrected(folder, chosen, truth)
        | _draw_motion(sequence, folder, chosen)
        | _draw_depth(sequence, folder, chosen["matcher"])
    )


def _draw_corrected(folder: Path, chosen: dict[str, str], truth: Image) -> Drawn:
    stem = _corrected_stem(folder, chosen)
    if not stem.with_name(f"{stem.name}.png").is_file():
        return {}
    size = truth.shape[1], truth.shape[0]
    corrected = read_png(stem.with_name(f"{stem.name}.png"), size)
    mask = read_origin(stem.with_name(f"{stem.name}-origin.png"), size) != Origin.NOBODY
    return {
        "corrected": (
            pictures.masked(corrected, mask),
            "Corrected frame (dark: seen by nobody); hover: global-shutter truth",
        ),
        "corrected-over-global": (
            pictures.overlay(corrected, truth, mask),
            "Corrected frame (red) over the truth (cyan)",
        ),
    }


def _draw_motion(sequence: Sequence, folder: Path, chosen: dict[str, str]) -> Drawn:
    if not (folder / "matches.npz").is_file():
        return {}
    matches = load_matches(folder / "matches.npz").left
    stored = folder / "motion" / f"{chosen['solver']}-inliers.npz"
    inliers = load_arrays(stored).get("left") if stored.is_file() else None
    keep = np.ones(len(matches), dtype=np.bool_)
    if inliers is not None and inliers.shape == keep.shape and inliers.dtype == keep.dtype:
        keep = inliers
    image = pictures.draw_matches(sequence.image("rs", "left", 0), matches, keep)
    return {"matches": (image, "Left matches over time; orange: rejected")}


def _draw_depth(sequence: Sequence, folder: Path, matcher: str) -> Drawn:
    truth = sequence.depth("rs", *_SHOWN)
    surface = truth > 0
    low, high = np.percentile(1.0 / truth[surface], [1, 99]) if np.any(surface) else (0.0, 1.0)

    def inverse(depth: NDArray[np.float32]) -> Image:
        return pictures.colour_map(np.where(depth > 0, 1.0 / np.where(depth > 0, depth, 1.0), np.nan), low, high)

    drawn: Drawn = {"depth-truth": (inverse(truth), "True depth of the rolling-shutter frame")}
    stored = folder / "depth" / f"{matcher}.npz"
    if stored.is_file():
        found = load_disparities(stored, sequence.rig)
        timed = bool((read_record(stored.with_suffix(".json")) or {}).get("timed"))
        depth = depth_of(found[f"{_SHOWN[0]}_{_SHOWN[1]}"], sequence, *_SHOWN, timed=timed)
        error = np.where(surface & (depth > 0), np.abs(depth - truth), np.nan)
        drawn["depth"] = (inverse(depth), f"Depth by {matcher} (dark: invalid)")
        drawn["depth-error"] = (
            pictures.colour_map(error, 0.0, _DEPTH_ERROR_M, "inferno"),
            f"Depth error, 0 to {_DEPTH_ERROR_M:g} m (dark grey: no depth)",
        )
    return drawn
