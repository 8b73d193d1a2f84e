"""What a change of the code's structure must leave as it is, and what it should make straight.

``digests`` writes hashes of corrected frames and figures of solvers, capture and trajectory, to compare two states
of the code; ``walk`` lists the modules that the correction of four frames with a given readout ratio enters.

    rsbench generate smoke --out data/smoke
    python benchmarks/refactoring.py digests data/smoke before.json
    python benchmarks/refactoring.py digests data/smoke after.json --compare before.json
    python benchmarks/refactoring.py walk data/smoke
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import rsbench
from rsbench.capture.calibration import offset_error
from rsbench.capture.hypotheses import KnownInputs
from rsbench.capture.rig_calibration import ERRORS, prior_of, refine_rig, with_errors
from rsbench.components.motion_models import make_motion
from rsbench.core import so3
from rsbench.core.correspondences import Correspondences
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import VIEWS
from rsbench.dataset.sequence import Sequence, read_dataset
from rsbench.pipeline.answer import solve_problem
from rsbench.pipeline.chain import correct_four
from rsbench.pipeline.frame_depth import CorrectionOptions
from rsbench.pipeline.isolated_components import SolverRunner
from rsbench.pipeline.problem import Problem
from rsbench.solvers.engine.base import list_solvers, load_solver_entry
from rsbench.solvers.engine.robust_motion import RobustOptions

RIG = rsbench.StereoRig(camera=rsbench.PinholeCamera.centred(640, 480, 500.0), baseline=0.3)
TURNED = rsbench.StereoRig.of_cameras(
    RIG.camera, RIG.camera, so3.exp(np.array([0.01, 0.02, -0.01])), (-0.3, 0.01, 0)
)
SHUTTER = rsbench.RollingShutter(height=480, readout_ratio=0.8)
MOTION = make_motion("linear", np.array([0.01, 0.03, -0.02]), np.array([0.1, -0.05, 0.25]))


def _matches(rig: rsbench.StereoRig, seed: int, outliers: float = 0.0, tracks: int = 120) -> Correspondences:
    found = rsbench.simulate(
        rig, SHUTTER, MOTION, pairs=120, tracks=tracks, noise_px=0.3, outlier_ratio=outliers, seed=seed
    )
    return found.correspondences


def _hash(*arrays: Any) -> str:
    return hashlib.sha256(b"".join(np.ascontiguousarray(each).tobytes() for each in arrays)).hexdigest()[:16]


def _four(sequence: Sequence, ratio: float | None, model: str | None, offset: float | None = None) -> Any:
    images, options = {view: sequence.image("rs", *view) for view in VIEWS}, CorrectionOptions(motion_model=model)
    errors = None if offset is None else offset_error(offset)
    found = correct_four(images, sequence.rig, KnownInputs(readout_ratio=ratio, calibration=errors), options)
    assert found.motion is not None
    frames = [_hash(each.image, each.origin, each.depth) for each in found.frames.values()]
    return [*found.motion.w, *found.motion.d, found.shutter.readout_ratio, *frames]


def _estimated(rig: rsbench.StereoRig, solver: str, model: str | None) -> Any:
    found = rsbench.estimate_motion(_matches(rig, 3, 0.2), rig, SHUTTER, solver, motion_model=model).estimate
    spread = 0.0 if found.covariance is None else float(np.trace(found.covariance))
    return [*found.w, *found.d, spread, found.reason] if found.success else found.reason


def _answer(rig: rsbench.StereoRig, known: bool, model: str | None) -> Any:
    problem = Problem(
        name="", correspondences=_matches(rig, 3, 0.2), rig=rig, known_shutter=SHUTTER if known else None
    )
    with SolverRunner() as runner:
        entry = load_solver_entry("rs-stereo-refined")
        answer = solve_problem(problem, entry, RobustOptions(), runner, 0, ("covariance", "noise"), model)
    return {name: value for name, value in answer.items() if name != "seconds"}


def _refined() -> Any:
    off = with_errors(TURNED, np.array([0.002, 0.001, -0.001, 0.0, 0.0, 0.003, -0.002, 0.0]))
    nothing = np.zeros(len(ERRORS))
    found = refine_rig([_matches(off, 6, tracks=250)], TURNED, SHUTTER, nothing, prior_of(nothing))
    return None if found is None else [*found.errors, *found.sigma]


def _trajectory() -> Any:
    found = rsbench.estimate_trajectory([_matches(RIG, 20 + k) for k in range(5)], RIG, SHUTTER)
    return [*found.motion.w, *found.motion.d, found.noise_px, float(np.sum(found.covariance(1.0)))]


def cases(folder: Path) -> dict[str, Callable[[], Any]]:
    """What is compared, by name."""
    out = dict[str, Callable[[], Any]]()
    for sequence in read_dataset(folder)[:2]:
        ratio = sequence.shutter.readout_ratio
        for name, given in {
            "ratio": (ratio, None),
            "auto": (ratio, "auto"),
            "unknown": (None, "auto"),
            "offset": (ratio, "auto", 0.3),
        }.items():
            out[f"{sequence.name} {name}"] = lambda sequence=sequence, given=given: _four(sequence, *given)
    for name in list_solvers():
        out[name] = lambda name=name: _estimated(RIG, name, None)
    for label, rig in (("ideal", RIG), ("turned", TURNED)):
        for model in (None, "auto", "twist"):
            out[f"{label} {model}"] = lambda rig=rig, model=model: _estimated(rig, "rs-stereo-refined", model)
            for known in (True, False) if label == "ideal" else (True,):
                name = f"solve {label} {model} {'known' if known else 'unknown'} shutter"
                out[name] = lambda rig=rig, known=known, model=model: _answer(rig, known, model)
    return {**out, "refined rig": _refined, "trajectory": _trajectory}


def digests(folder: Path, out: Path, before: Path | None) -> int:
    """Write the results; how many differ from those before."""
    found = dict[str, Any]()
    for name, work in cases(folder).items():
        try:
            found[name] = json.loads(json.dumps(work()))
        except RsbenchError as error:
            found[name] = str(error)
    out.write_text(json.dumps(found, indent=1))
    known = {} if before is None else json.loads(before.read_text())
    changed = [name for name in known if json.dumps(known[name]) != json.dumps(found.get(name))]
    for name in changed:
        sys.stdout.write(f"{name}\n  {known[name]}\n  {found.get(name)}\n")
    sys.stdout.write(f"{len(found)} results, {len(changed)} of them changed\n")
    return len(changed)


def walk(folder: Path) -> None:
    """Print calls from one module of ``pipeline`` to another one or to ``capture``, in order."""
    sequence, order = read_dataset(folder)[0], list[str]()
    _four(sequence, sequence.shutter.readout_ratio, "auto")

    def module(frame: Any) -> str:
        path = Path(frame.f_code.co_filename)
        return "/".join(path.with_suffix("").parts[-2:]) if "rsbench" in path.parts else ""

    def profile(frame: Any, event: str, _: object) -> None:
        if event != "call" or frame.f_code.co_name.startswith(("<", "_")):
            return
        name, caller = module(frame), "" if frame.f_back is None else module(frame.f_back)
        if name != caller and caller.startswith("pipeline/") and name.startswith(("pipeline/", "capture/")):
            order.append(f"{name}.{frame.f_code.co_name}")

    sys.setprofile(profile)
    _four(sequence, sequence.shutter.readout_ratio, "auto")
    sys.setprofile(None)
    sys.stdout.write("\n".join(order) + "\n")


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("digests", "walk"))
    parser.add_argument("data", type=Path, help="dataset folder")
    parser.add_argument("out", type=Path, nargs="?", help="of digests")
    parser.add_argument("--compare", type=Path, help="digests of another state of the code")
    arguments = parser.parse_args()
    if arguments.what == "walk":
        walk(arguments.data)
    elif digests(arguments.data, arguments.out, arguments.compare):
        sys.exit(1)


if __name__ == "__main__":
    main()
