"""What ``rsbench correct`` makes of frames that other code traced: ``foreign_frames.py``.

Each case is corrected twice: told everything (readout ratio, scans, and the law of motion where rsbench knows it),
and told nothing but the cameras. Those of ``RIGS`` are corrected with rig.toml, with Kalibr's file, with a loose
calibration, and rectified as ``rectify_study.py`` does. Frames are compared with the traced global-shutter ones
on the pixels that the correction claims (mask above 0); the gain is over the uncorrected frames on the same ones.

Another rig has another view, whose textures may be harder to resample. Rigs are therefore compared by what they
lose to the same corrector fed with the true depth and motion, on the pixels that both claim.

    python benchmarks/foreign_table.py --data data/foreign --seeds 5 --rows twist lens
    python benchmarks/foreign_table.py --data data/foreign --seeds 5 --rows ideal printed --ways told rectified

Nothing is rendered or corrected twice; with --again, corrections are, as after a change of rsbench.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import foreign_case
import numpy as np
from foreign_frames import RIGS, ROWS, draw_case, grey, picture, write_case
from foreign_motion import Array, between
from foreign_rig import FRAME_SECONDS, SIDES, loosened, short_card
from foreign_rig import card as rig_card
from foreign_world import read_photographs
from numpy.typing import NDArray
from rectify_study import errors, psnr, rectified
from scipy.stats import chi2

from rsbench.components.motion_models import LinearMotion
from rsbench.core import so3
from rsbench.pipeline.footage import read_rig_card

_NAN = float("nan")
_LIMIT = 3.0
"""Deviations that a found readout ratio may err by."""
_LONGEST = 3600.0
"""Seconds of a command."""
WAYS = {
    "told": "all",
    "untold": "nothing",
    "kalibr": "Kalibr's file",
    "loose": "a loose calibration",
    "rectified": "all, rectified",
}
"""What the command gets."""
LIMITS = {"e_R": 0.01, "e_T": 0.05, "worst e_T": 0.2, "dB": 0.5}
"""Of the rows of rigs: degrees, medians but for one, and dB lost more than of the ideal rig with the same seed."""
HEAD = ("case", "told", "ratio", "sigma", "error / sigma", "e_R (deg)", "e_T (deg)", "PSNR", "gain", "s", "note")


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One run of the command; what it did not say is NaN."""

    row: str
    seed: int
    way: str
    frames: int
    message: str = ""
    """Why it failed, or its notes."""
    failed: bool = False
    ratio: float = _NAN
    sigma: float = _NAN
    true_ratio: float = _NAN
    turn_error: float = _NAN
    """e_R in degrees; the median over the periods of a sequence."""
    way_error: float = _NAN
    """e_T in degrees, likewise."""
    psnr: float = _NAN
    """Mean over the frames of both cameras; of a sequence, of the left camera."""
    gain: float = _NAN
    worst_gain: float = _NAN
    """Of one frame."""
    lost: float = _NAN
    """dB below the correction that is fed with the truth, mean over the frames."""
    square: float = _NAN
    """Squared error of the motion by its stated covariance: 6 on average if that is right."""
    off: tuple[float, ...] = ()
    """Errors of the calibration that was found, in stated deviations."""
    seconds: float = _NAN

    @property
    def deviations(self) -> float:
        """Error of the ratio over its stated deviation."""
        return abs(self.ratio - self.true_ratio) / self.sigma if self.sigma > 0.0 else _NAN


def run_case(folder: Path, way: str, again: bool, model: str | None = None) -> tuple[int, str, float]:
    """Correct a case; returns the exit code, what was said and the seconds.

    Args:
        folder: of the case.
        way: of ``WAYS``; ``told`` and those of rigs give the law too where rsbench knows it.
        again: even where it has been done.
        model: motion model where the law is not told.
    """
    record = folder / f"{way}.json"
    if record.is_file() and not again:
        code, message, seconds = json.loads(record.read_text("utf-8"))
        return int(code), str(message), float(seconds)
    truth = json.loads((folder / "truth.json").read_text("utf-8"))
    source = _resample(folder, truth["row"]) if way == "rectified" else folder
    if truth["frames"] == 2:
        frames = [str(picture(source, 2, side, frame)) for frame in (0, 1) for side in SIDES]
    else:
        frames = ["--left", str(folder / "left"), "--right", str(folder / "right")]
    shutil.rmtree(folder / f"corrected-{way}", ignore_errors=True)
    card = {"kalibr": "camchain.yaml", "untold": "untold.toml", "loose": "loose.toml"}.get(way, "told.toml")
    if way == "loose":
        (folder / card).write_text(_loose_card(truth["row"], truth["seed"]), "utf-8")
    arguments = [*frames, "--rig", str(source / card), "--out", str(folder / f"corrected-{way}")]
    arguments += ["--fps", str(1.0 / FRAME_SECONDS)] if way == "kalibr" else []
    law = None if way == "untold" else truth["motion_model"]
    code, message, seconds = _correct(arguments, law or model)
    if law and code == 2 and "--motion-model" in message:
        code, message, seconds = _correct(arguments, "auto")
        message = f"{law} cannot be asked for: auto. {message}".strip()
    record.write_text(json.dumps([code, message, seconds]), "utf-8")
    return code, message, seconds


def _loose_card(row: str, seed: int) -> str:
    return rig_card(loosened(RIGS[row], np.random.default_rng([seed, *b"loose"])), True)


def correct_by_truth(row: str, seed: int, folder: Path) -> Path:
    """The folder of frames that were corrected with the true depth and motion."""
    out = folder / "corrected-truth"
    if (out / "done").is_file():
        return out
    views = [(side, frame) for frame in (0, 1) for side in SIDES]
    paths = [picture(folder, 2, *view) for view in views]
    near = np.load(folder / "near.npz")
    depth = [np.float32(1.0) / near[path.stem] for path in paths]
    case, _ = draw_case(row, seed)
    law = LinearMotion(*between(case.law, 0.0, 1.0))
    frames = foreign_case.truth_fed(
        [grey(_read(path)) for path in paths], depth, *foreign_case.ours(case.rig), law
    )
    for kind in ("corrected", "mask"):
        (out / kind).mkdir(parents=True, exist_ok=True)
    for view, path in zip(views, paths, strict=True):
        cv2.imwrite(str(out / "corrected" / path.name), frames[view].image)
        cv2.imwrite(str(out / "mask" / path.name), np.where(frames[view].origin > 0, 255, 0).astype(np.uint8))
    (out / "done").touch()
    return out


def _lost(folder: Path, corrected: Path, fed: Path) -> float:
    """dB below the correction by the truth, mean over the four frames, on the pixels that both claim."""
    each = []
    for view in ((side, frame) for frame in (0, 1) for side in SIDES):
        name, truth = picture(folder, 2, *view).name, _read(picture(folder / "gs", 2, *view))
        mask = (_read(corrected / "mask" / name) > 0) & (_read(fed / "mask" / name) > 0)
        found, best = (psnr(_read(part / "corrected" / name)[mask], truth[mask]) for part in (corrected, fed))
        each.append(best - found)
    return float(np.mean(each))


def _resample(folder: Path, row: str) -> Path:
    """The folder of a rig's rectified frames, with their rig and truth."""
    new, out = rectified(RIGS[row]), folder / "rectified"
    for kind in (Path(), Path("gs")):
        (out / kind).mkdir(parents=True, exist_ok=True)
        for side in SIDES:
            for frame in (0, 1):
                image = new.resample(side, grey(_read(picture(folder / kind, 2, side, frame))))
                cv2.imwrite(str(picture(out / kind, 2, side, frame)), image)
    (out / "told.toml").write_text(short_card(new.rig, True), "utf-8")
    return out


def _correct(arguments: Sequence[str], model: str | None) -> tuple[int, str, float]:
    """Exit code, what was said and processor seconds of the command."""
    options = [] if model is None else ["--motion-model", model]
    command = [sys.executable, "-m", "rsbench", "correct", *arguments, *options]
    begin = _child_seconds()
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_LONGEST)
        code, message = done.returncode, _said(done.stderr, done.returncode)
    except subprocess.TimeoutExpired:
        code, message = 124, f"took more than {_LONGEST:.0f} s"
    return code, message, _child_seconds() - begin


def _child_seconds() -> float:
    """Processor seconds of all commands so far: what else the machine does counts little in them."""
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


def _said(text: str, code: int) -> str:
    """The lines of rsbench in what a command said; of one that failed otherwise, the last line."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    said = [line for line in lines if line.startswith("rsbench:")] or (lines[-1:] if code else [])
    return " ".join(said).replace("|", "/").removeprefix("rsbench: ")


def outcome(row: str, seed: int, folder: Path, way: str, again: bool, model: str | None = None) -> Outcome:
    """One run, compared with the truth."""
    code, message, seconds = run_case(folder, way, again, model)
    truth = json.loads((folder / "truth.json").read_text("utf-8"))
    known = {"row": row, "seed": seed, "way": way, "frames": truth["frames"], "true_ratio": truth["ratio"]}
    corrected = folder / f"corrected-{way}"
    if code != 0 and not (truth["frames"] > 2 and code == 1 and corrected.is_dir()):
        return Outcome(**known, failed=True, message=f"exit {code}: {message}", seconds=seconds)
    found = json.loads((corrected / "motion.json").read_text("utf-8"))
    new = rectified(RIGS[row]) if way == "rectified" else None
    e_R, e_T = _motion_errors(found, truth, None if new is None else new.body)
    shown = None if new is None else {side: new.shown(side) for side in SIDES}
    after, gains = _gains(folder if new is None else folder / "rectified", corrected, truth["frames"], shown)
    fair = row in RIGS and way != "rectified" and (folder / "near.npz").is_file()
    lost = _lost(folder, corrected, correct_by_truth(row, seed, folder)) if fair else _NAN
    estimated = found["readout_ratio_estimated"]
    square = _square(found["motion"], truth["motions"][0]) if truth["frames"] == 2 and new is None else _NAN
    return Outcome(
        **known,
        message=_remark(found, message, code),
        ratio=float(found["readout_ratio"]),
        sigma=float(found["readout_ratio_sigma"] or _NAN) if estimated else _NAN,
        turn_error=e_R,
        way_error=e_T,
        psnr=after,
        gain=float(np.mean(gains)),
        worst_gain=float(np.min(gains)),
        lost=lost,
        square=square,
        off=_calibration_errors(folder, found.get("rig_errors", {})) if way == "loose" else (),
        seconds=seconds,
    )


def _square(motion: dict[str, Any], truth: dict[str, Any]) -> float:
    """The error of w and d, squared and normalised by the stated covariance; NaN: none is stated."""
    if not motion.get("covariance_w_d"):
        return _NAN
    off = np.concatenate(_vectors(motion)) - np.concatenate(_vectors(truth))
    return float(off @ np.linalg.solve(np.array(motion["covariance_w_d"]), off))


def _calibration_errors(folder: Path, found: dict[str, dict[str, float]]) -> tuple[float, ...]:
    """Errors, in stated deviations, of the right camera's angles and both focal lengths; empty: none found."""
    sizes = {side: _read(picture(folder, 2, side, 0)) for side in SIDES}
    loose, true = (
        read_rig_card(folder / f"{name}.toml").rig_of(sizes["left"], sizes["right"]) for name in ("loose", "told")
    )
    turns = {side: so3.log(loose.own(side).R.T @ true.own(side).R) for side in SIDES}
    longer = {side: np.log(true.own(side).camera.fx / loose.own(side).camera.fx) for side in SIDES}
    expected = dict(zip(("right_x", "right_y", "right_z"), turns["right"] - turns["left"], strict=True))
    expected |= {f"focal_{side}": longer[side] for side in SIDES}
    return tuple((found[k]["value"] - value) / found[k]["sigma"] for k, value in expected.items() if k in found)


def _remark(found: dict[str, Any], message: str, code: int) -> str:
    """What the command said besides numbers: scans it found, the model it chose, messages."""
    parts = [f"exit {code}: {message}" if code else message]
    scan = found["scan"]
    if (scan["scan"], scan["right_scan"] or scan["scan"]) != ("top", "top"):
        parts.append(f"scan {scan['scan']}, {scan['right_scan'] or scan['scan']}")
    motion = found.get("motion")
    if motion and motion["model"] != "linear":
        parts.append(motion["model"])
    return "; ".join(part for part in parts if part)


def _motion_errors(found: dict[str, Any], truth: dict[str, Any], turn: Array | None = None) -> tuple[float, float]:
    """e_R and e_T in degrees, medians over the periods; ``turn`` (3, 3) from the found axes to the body's."""
    axes = np.eye(3) if turn is None else turn
    if truth["frames"] == 2:
        motions = {0: found["motion"]}
    else:
        motions = {int(frame["number"]): frame.get("motion") for frame in found["frames"][:-1]}
    pairs = [(truth["motions"][number], motion) for number, motion in motions.items() if motion]
    each = [
        list(errors(_vectors(true), tuple(axes @ vector for vector in _vectors(motion))).values())
        for true, motion in pairs
    ]
    if not each:
        return _NAN, _NAN
    e_R, e_T = np.median(np.array(each), axis=0)
    return float(e_R), float(e_T)


def _vectors(motion: dict[str, Any]) -> tuple[Array, Array]:
    return np.array(motion["w"]), np.array(motion["d"])


def _gains(
    folder: Path, corrected: Path, frames: int, shown: dict[str, NDArray[np.bool_]] | None = None
) -> tuple[float, Array]:
    """Mean PSNR, and the gains (n,) of the frames, in dB, on pixels that are shown, if not all."""
    found = []
    for frame in range(frames):
        for side in SIDES if frames == 2 else SIDES[:1]:
            name = f"{side}_{frame}" if frames == 2 else f"{side}_{frame:06d}"
            if not (corrected / "mask" / f"{name}.png").is_file():
                found.append((_NAN, 0.0))  # given back as it was
                continue
            mask = _read(corrected / "mask" / f"{name}.png") > 0
            mask = mask if shown is None else mask & shown[side]
            truth = _read(picture(folder / "gs", frames, side, frame))
            images = [_read(corrected / "corrected" / f"{name}.png"), _read(picture(folder, frames, side, frame))]
            after, before = (psnr(image[mask], truth[mask]) for image in images)
            found.append((after, after - before))
    values = np.array(found)
    return float(np.nanmean(values[:, 0])) if np.any(np.isfinite(values[:, 0])) else _NAN, values[:, 1]


def _read(path: Path) -> Array:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None, path
    return np.asarray(image, dtype=np.float64)


def table(outcomes: Sequence[Outcome]) -> str:
    """All cases, and below them a line for each row."""
    lines = [f"| {' | '.join(HEAD)} |", "|---|---|" + "---:|" * (len(HEAD) - 3) + "---|"]
    lines += [f"| {' | '.join(_cells(one))} |" for one in outcomes]
    plain, rigs = ([one for one in outcomes if (one.row in RIGS) == kind] for kind in (False, True))
    parts = (["", *_summary(plain)] if plain else []) + (["", *_of_rigs(rigs)] if rigs else [])
    return "\n".join([*lines, *parts])


def _of_rigs(outcomes: Sequence[Outcome]) -> list[str]:
    """Per row and way: how many failed, errors, dB lost and lost more than of the ideal rig; what is beyond
    ``LIMITS``."""
    ideal = {one.seed: one.lost for one in outcomes if (one.row, one.way) == ("ideal", "told")}
    head = (
        "row",
        "given",
        "runs",
        "failed",
        "e_R median",
        "worst",
        "e_T median",
        "worst",
        "PSNR",
        "below truth-fed",
        "more than ideal",
        "worst",
        "median s",
        "in 95 %",
        "axes",
        "calibration within 3 deviations",
        "",
    )
    lines = [f"| {' | '.join(head)} |", "|---|---|" + "---:|" * (len(head) - 3) + "---|"]
    for row, way in dict.fromkeys((one.row, one.way) for one in outcomes):
        runs = [one for one in outcomes if (one.row, one.way) == (row, way)]
        done = [one for one in runs if not one.failed]
        e_R, e_T = np.array([one.turn_error for one in done]), np.array([one.way_error for one in done])
        more = [one.lost - ideal[one.seed] for one in done if one.seed in ideal]
        cells = [row, WAYS[way], str(len(runs)), str(len(runs) - len(done))]
        if done:
            cells += [f"{np.median(e_R):.4f}", f"{np.max(e_R):.4f}", f"{np.median(e_T):.3f}", f"{np.max(e_T):.3f}"]
            cells += [_median([one.psnr for one in done], 2), _median([one.lost for one in done], 2)]
            cells += [_median(more, 2), _number(max(more, default=_NAN), 2), _median([o.seconds for o in done], 1)]
            squares = np.array([one.square for one in done if np.isfinite(one.square)])
            inside = np.count_nonzero(squares <= chi2.ppf(0.95, 6))
            off = np.array([each for one in done for each in one.off])
            cells.append(f"{inside} of {len(squares)}" if len(squares) else "-")
            cells.append(f"{np.sqrt(chi2.ppf(0.5, 6) / np.median(squares)):.2f}" if len(squares) else "-")
            cells.append(f"{np.count_nonzero(np.abs(off) <= 3.0)} of {len(off)}" if len(off) else "-")
            found = {"e_R": np.median(e_R), "e_T": np.median(e_T), "worst e_T": np.max(e_T)}
            beyond = [name for name, value in found.items() if value > LIMITS[name]]
            beyond += ["dB"] if more and np.median(more) > LIMITS["dB"] else []
        else:
            cells, beyond = [*cells, *["-"] * (len(head) - 5)], list[str]()
        lines.append(f"| {' | '.join([*cells, ', '.join(beyond)])} |")
    return lines


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "-"


def _cells(one: Outcome) -> list[str]:
    gain = _number(one.gain, 2)
    if one.frames > 2 and np.isfinite(one.gain):
        gain += f" (worst {one.worst_gain:.2f})"
    seconds = f"{one.seconds / one.frames:.1f} a frame" if one.frames > 2 else f"{one.seconds:.1f}"
    numbers = [
        (one.ratio, 4),
        (one.sigma, 4),
        (one.deviations, 1),
        (one.turn_error, 3),
        (one.way_error, 2),
        (one.psnr, 2),
    ]
    cells = [_number(value, digits) for value, digits in numbers]
    return [f"{one.row}-{one.seed}", WAYS[one.way], *cells, gain, seconds, one.message]


def _summary(outcomes: Sequence[Outcome]) -> list[str]:
    """Per row: ratios within the limit, the worst, medians, and what being told gains."""
    head = ("row", "runs", "failed", f"within {_LIMIT:g} sigma", "worst", "median e_R, e_T told", "untold")
    head = (*head, "median gain told", "untold", "worst gain untold", "PSNR told - untold", "median s")
    lines = [f"| {' | '.join(head)} |", "|---|" + "---:|" * (len(head) - 1)]
    for row in dict.fromkeys(one.row for one in outcomes):
        told, untold = (
            [one for one in outcomes if one.row == row and one.way == way] for way in ("told", "untold")
        )
        lines.append(f"| {' | '.join([row, *_row_cells(told, untold)])} |")
    return lines


def _row_cells(told: list[Outcome], untold: list[Outcome]) -> list[str]:
    deviations = np.array([one.deviations for one in untold])
    known = deviations[np.isfinite(deviations)]
    by_seed = {one.seed: one.psnr for one in told}
    more = [by_seed[one.seed] - one.psnr for one in untold if one.seed in by_seed]
    return [
        f"{len(told)} + {len(untold)}",
        f"{sum(one.failed for one in told)} + {sum(one.failed for one in untold)}",
        f"{np.count_nonzero(known <= _LIMIT)} of {len(untold)}",
        _number(float(np.max(known)) if len(known) else _NAN, 1),
        *(
            f"{_median([o.turn_error for o in kind], 3)}, {_median([o.way_error for o in kind], 2)}"
            for kind in (told, untold)
        ),
        *(_median([one.gain for one in kind], 2) for kind in (told, untold)),
        _number(min((one.worst_gain for one in untold if not one.failed), default=_NAN), 2),
        _median(more, 2),
        _median([one.seconds / (one.frames if one.frames > 2 else 1) for one in [*told, *untold]], 1),
    ]


def _median(values: Sequence[float], digits: int) -> str:
    finite = [value for value in values if np.isfinite(value)]
    return _number(float(np.median(finite)), digits) if finite else "-"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("data/foreign"))
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS), metavar="ROW", help=", ".join(ROWS))
    parser.add_argument("--photographs", type=Path, help="folder (default: those of scikit-image, if installed)")
    parser.add_argument("--again", action="store_true", help="correct again what has been corrected")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS), help="run these alone")
    parser.add_argument("--model", help="motion model where the law is not told, such as auto (default: none)")
    arguments = parser.parse_args()
    photographs = read_photographs(arguments.photographs)
    outcomes = []
    for row in arguments.rows:
        for seed in range(arguments.seeds):
            folder = arguments.data / f"{row}-{seed}"
            if not (folder / "truth.json").is_file():
                write_case(row, seed, folder, photographs)
            for way in ("told", "kalibr", "loose", "rectified") if row in RIGS else ("told", "untold"):
                if way in arguments.ways:
                    outcomes.append(outcome(row, seed, folder, way, arguments.again, arguments.model))
                    sys.stderr.write(f"| {' | '.join(_cells(outcomes[-1]))} |\n")
    sys.stdout.write(table(outcomes) + "\n")


if __name__ == "__main__":
    main()
