"""The functions of ``import rsbench``: arrays in, arrays out, every option with a default.

Images are (H, W) or (H, W, 3), uint8 or uint16; four images are in the order left 0, right 0, left 1, right 1.
Angles are radians, lengths metres unless a name says otherwise; frames and times: ``rsbench docs conventions``.
"""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as Series
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rsbench.core import arguments
from rsbench.core.camera import PinholeCamera
from rsbench.core.correspondences import Correspondences, gyro_samples
from rsbench.core.geometry import check_image, check_motion, check_moving_rig, check_rows, check_view, four_images
from rsbench.core.motion import Motion
from rsbench.core.projection import RSProjection, rs_project
from rsbench.core.rig import SIDES, Side, StereoRig
from rsbench.core.shutter import RollingShutter, Scanning

if TYPE_CHECKING:
    import pandas as pd

    from rsbench.benchmark.simulated.simulation import Simulation
    from rsbench.capture.trajectory_estimate import Trajectory
    from rsbench.dataset.sequence import Sequence
    from rsbench.interop.readers.rig_files import KnownRig
    from rsbench.pipeline.chain import CorrectedFrames
    from rsbench.solvers.engine.base import MotionEstimate, Solver, SolverEntry
    from rsbench.solvers.engine.robust_motion import RobustEstimate, RobustOptions
    from rsbench.verification import Rerender, SequenceReport
    from rsbench.vision.fusion import Fused

AnyPath: TypeAlias = str | PathLike[str]
Image: TypeAlias = NDArray[Any]


def project(
    points: ArrayLike,
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    side: Side = "left",
    frame: int = 0,
) -> RSProjection:
    """Pixels at which a moving rolling-shutter camera sees world points (..., 3), metres.

    Exact: the row that sees a point is solved for, to 1e-9 px. ``frame`` counts from 0.

    Returns:
        ``pixels`` (..., 2), ``depth`` (...) z in the camera of that row, ``tau`` (...) its time, ``status`` (...):
        0 seen, 1 never seen, 2 seen twice (the first is given), 3 not converged. NaN where nothing was seen.
    """
    check_view(side, frame)
    check_moving_rig(rig, shutter, motion)
    return rs_project(rig, shutter, motion, side, frame, arguments.world_points(points))


def simulate(
    rig: StereoRig,
    shutter: RollingShutter,
    motion: Motion,
    *,
    pairs: int = 100,
    tracks: int = 100,
    noise_px: float = 0.3,
    outlier_ratio: float = 0.0,
    depth: tuple[float, float] = (2.0, 10.0),
    shape: Literal["box", "plane"] = "box",
    seed: int = 0,
) -> Simulation:
    """Matches of random points that the moving rig sees, with noise and outliers.

    Args:
        rig, shutter, motion: what sees, how it reads, how it moves.
        pairs: matches over time of each camera, with points of their own.
        tracks: points seen in all four images.
        noise_px: standard deviation of every pixel coordinate.
        outlier_ratio: share of matches whose pixels in frame 1 are wrong, by up to 80 px.
        depth: range of the points' depths in frame 0, metres.
        shape: points at random depths, or on one slanted plane.
        seed: the same seed gives the same points and noise whatever the other arguments are.

    Returns:
        ``correspondences``, and ``outliers`` with a mask for each of ``left``, ``right`` and ``tracks``.

    Raises:
        ValueError: an argument out of its range, or a motion that leaves too few points in view.
    """
    from rsbench.benchmark.simulated.simulation import SimulationOptions
    from rsbench.benchmark.simulated.simulation import simulate as simulate_points

    options = SimulationOptions(
        pairs=pairs, tracks=tracks, noise_px=noise_px, outlier_ratio=outlier_ratio, depth=depth, shape=shape
    )
    check_moving_rig(rig, shutter, motion)
    arguments.check_whole("seed", seed, 0)
    return simulate_points(rig, shutter, motion, options, np.random.default_rng(seed))


def estimate_motion(
    correspondences: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    solver: str | Path | Solver | Callable[..., Any] = "rs-stereo-refined",
    *,
    motion_model: str | None = None,
    threshold_px: float | None = None,
    seed: int = 0,
) -> RobustEstimate:
    """Motion of the rig over one frame period from matches that may hold outliers.

    Args:
        correspondences: matches, px.
        rig, shutter: the cameras and how they read their rows.
        solver: a name of ``list_solvers``, the path of a card or of a Python file, a ``Solver``, or a function
            that ``rsbench.solver`` decorates.
        motion_model: ``auto``, the one that the matches prefer, or a name; None: the one that the solver assumes.
        threshold_px: largest error of an inlier; None follows the noise that the inliers show.
        seed: of the samples that the robust loop draws.

    Returns:
        ``estimate``, a ``MotionEstimate`` whose ``success`` is False, with a ``reason``, when there is none; and
        ``inliers``, a mask for each of ``left``, ``right`` and ``tracks``; ``inlier_count`` of ``match_count``
        count each match once.

    Raises:
        RsbenchError: no such solver or motion model, or the solver can take no other than its own.
        ValueError: an argument of another type or out of its range.
    """
    from rsbench.solvers.engine.base import entry_of
    from rsbench.solvers.engine.robust_motion import RobustOptions
    from rsbench.solvers.engine.robust_motion import estimate_motion as estimate_robustly

    arguments.check_type("correspondences", correspondences, Correspondences)
    if motion_model is not None:
        arguments.name_or_path("motion_model", motion_model)
    check_rows(rig, shutter)
    arguments.check_whole("seed", seed, 0)
    options = RobustOptions()
    if threshold_px is not None:
        options = RobustOptions(threshold_px=threshold_px, adapt_threshold=False)
    entry, rng = entry_of(solver), np.random.default_rng(seed)
    if motion_model is not None:
        return _estimate_under(motion_model, entry, correspondences, rig, shutter, options, seed)
    return estimate_robustly(correspondences, rig, shutter, entry.solver, options, rng, entry.options.robust)


def pose_errors(
    found: RobustEstimate | MotionEstimate,
    motion: Motion,
    rig: StereoRig,
    *,
    reference_point: Literal["body", "left"] | None = None,
) -> dict[str, float]:
    """Errors of an estimate against the true motion, as docs/explanation/conventions.md defines them.

    Args:
        found: what ``estimate_motion`` returned, or a solver itself.
        motion: the truth.
        rig: whose left camera ``reference_point`` may mean.
        reference_point: the point whose translation ``found`` gives. None is what ``estimate_motion`` says, and
            the body for an answer of a solver itself, whose ``spec`` knows better.

    Returns:
        ``e_R_deg``, ``e_T_deg`` (degrees) and ``e_s``. A failure scores 180, 180 and infinity. NaN where there is
        nothing to compare: e_s of an estimate without metres, e_T and e_s where the true translation is zero.

    Raises:
        ValueError: no such reference point.
    """
    from rsbench.benchmark import scoring
    from rsbench.solvers.engine.base import MotionEstimate
    from rsbench.solvers.engine.robust_motion import RobustEstimate

    if not isinstance(found, RobustEstimate | MotionEstimate):
        raise ValueError(f"found: must be what estimate_motion returned or a MotionEstimate, got {type(found)}")
    check_motion(rig, motion)
    arguments.check_one_of("reference_point", reference_point, ("body", "left", None))
    estimate = found if isinstance(found, MotionEstimate) else found.estimate
    point = "body" if isinstance(found, MotionEstimate) else found.reference_point
    errors = scoring.pose_errors(
        estimate.w,
        estimate.d,
        true_w=motion.w,
        true_d=motion.d,
        rig=rig,
        success=estimate.success,
        metric=estimate.metric,
        reference_point=reference_point or point,
    )
    return {name: float(value) for name, value in errors.items()}


def match(images: Series[Image], *, features: str | Path = "dense") -> Correspondences:
    """Matches of the four images of a rig over two frames: over time, left to right, and through all four.

    Args:
        images: four images.
        features: name or card of the feature matcher.

    Raises:
        ValueError: not four images that are alike, uint8 or uint16.
        RsbenchError: no such feature matcher.
    """
    from rsbench.pipeline.frame_capture import find_matches
    from rsbench.pipeline.frame_depth import CorrectionOptions
    from rsbench.vision.feature_matcher import load_features

    return find_matches(
        four_images(images),
        CorrectionOptions(features=load_features(arguments.name_or_path("features", features))),
    )


def stereo_depth(
    left: Image, right: Image, rig: StereoRig, *, side: Side = "left", matcher: str | Path = "sgm"
) -> NDArray[np.float32]:
    """Depth (H, W), metres, on the pixels of one image of a rectified pair; 0 where it is unknown.

    Holds for rolling-shutter pairs too: both cameras read the same row at the same time.

    Raises:
        ValueError: the images do not fit each other or the rig.
        RsbenchError: no such matcher.
    """
    from rsbench.vision.stereo_matcher import find_disparities, load_matcher

    arguments.check_one_of("side", side, SIDES)
    arguments.check_type("rig", rig, StereoRig)
    left, right = check_image("left", left, rig), check_image("right", right, rig)
    disparity = find_disparities(load_matcher(arguments.name_or_path("matcher", matcher)), left, right, rig)[
        SIDES.index(side)
    ]
    return np.nan_to_num(rig.depth(disparity), nan=0.0).astype(np.float32)


def read_dataset(folder: AnyPath) -> list[Sequence]:
    """Sequences of a dataset on disk; their images, depth and row poses are read when they are used.

    Raises:
        RsbenchError: not a finished dataset, or a sequence that cannot be read.
    """
    from rsbench.dataset import sequence

    return sequence.read_dataset(arguments.path("folder", folder))


def read_rig(
    path: AnyPath,
    size: tuple[int, int] | tuple[tuple[int, int], tuple[int, int]] | None = None,
    *,
    fps: float | None = None,
) -> KnownRig:
    """The cameras of a rig from a calibration of another tool as it is, from rig.toml, or from a card by its name.

    ``correct(images, found.rig, found.readout_ratio, scanning=found.scanning)`` then takes all that the file says.

    Args:
        path: of Kalibr, OpenVINS, OpenCV, ROS, Basalt, ZED, DepthAI, RealSense, COLMAP or EuRoC: a file, or a
            folder of files that belong together. Its content says of which tool it is.
        size: (width, height) of the images, or those of the left and of the right ones, where the file does not
            say them or has several.
        fps: frames a second, for readouts that the file gives in seconds.

    Returns:
        ``rig``; ``readout_ratio`` and ``scanning``, None where the frames have to tell; ``notes``, sentences about
        what was assumed.

    Raises:
        RsbenchError: a file that cannot be read or represented, or another size than its own.
    """
    from rsbench.interop.readers.rig_files import known_rig

    sizes = None
    if size is not None:
        given = arguments.real_array("size", size)
        if given.shape not in ((2,), (2, 2)):
            raise ValueError(
                f"size = {arguments.shown(size)}: must be (width, height), or two of these, left and right"
            )
        for value in given.ravel():
            arguments.check_number("size", value, 1.0, arguments.LARGEST_SIZE)
        left, right = np.broadcast_to(given.astype(int), (2, 2)).tolist()
        sizes = (left[0], left[1]), (right[0], right[1])
    if fps is not None:
        arguments.check_positive("fps", fps, 1e6, "frames a second")
    return known_rig(arguments.path("path", path), sizes, fps)


def generate(card: str, out: AnyPath, *, sequences: Series[str] | None = None, workers: int = 1) -> list[Sequence]:
    """Render a dataset into a folder and open it; what was rendered before from the same card is kept.

    Args:
        card: name of a dataset card (``rsbench list datasets``) or path to one.
        out: folder.
        sequences: names of those to render; None renders all.
        workers: processes; each renders whole sequences.

    Raises:
        RsbenchError: no such card or sequence, or a folder with another dataset.
    """
    from rsbench.dataset.card import load_dataset_card
    from rsbench.dataset.generation import generate_dataset

    arguments.check_whole("workers", workers, 1)
    place = arguments.path("out", out)
    dataset = load_dataset_card(arguments.name_or_path("card", card))
    if sequences is not None:
        dataset = dataset.only(list(arguments.names("sequences", sequences)))
    generate_dataset(dataset, place, workers=workers)
    return read_dataset(out)


def verify(
    folder: AnyPath, *, stride: int = 1, rerender: Rerender = "auto", scenes: Series[AnyPath] = ()
) -> list[SequenceReport]:
    """Check a dataset: files and lists, poses, all depth maps and images against each other, rows rendered again.

    Returns one report per sequence, in order when its ``faults`` are empty; before them one of dataset.json if it
    has any. Raises RsbenchError for what is no dataset.

    Args:
        folder: of the dataset.
        stride: compare every n-th pixel in both directions.
        rerender: rows to render again where the scene can be built here: "no", "auto" (seconds) or "all".
        scenes: cards of scenes that are not rsbench's own, and mesh files of objects that move.
    """
    from rsbench.verification import verify_dataset

    cards = [arguments.path("scenes", each) for each in arguments.items("scenes", scenes)]
    return verify_dataset(arguments.path("folder", folder), stride, rerender=rerender, scenes=cards)


def evaluate(
    folder: AnyPath,
    out: AnyPath,
    *,
    solvers: Series[str] = ("rs-stereo-refined", "gs-8pt"),
    correct_with: str = "rs-stereo-refined",
    matcher: str = "sgm",
    features: str = "sift",
    corrector: str = "fusion",
    metrics: Series[str] = (),
    only: Series[str] = (),
    force: bool = False,
    rehash: bool = False,
    seeds: int = 1,
    seed: int = 0,
) -> dict[str, pd.DataFrame]:
    """Run solvers, depth and correction on a dataset and score them against its truth.

    Args:
        folder, out: of the dataset; of predictions and scores: current ones that it holds are kept, and scored.
        solvers: names of ``list_solvers`` or paths of cards.
        correct_with: solver whose motion the correction uses.
        matcher, features, corrector, metrics: names or cards; the metrics are further ones.
        only: names of solvers and sequences: predict nothing else. All is scored.
        force: predict again what is there already; rehash: read data again that seem unchanged.
        seeds: runs of each solver, with other RANSAC samples: one row each in ``pose``; seed: of every choice.

    Returns:
        The tables ``pose``, ``depth``, ``correction``, ``failures`` and ``seconds``: ``rsbench docs score-files``.

    Raises:
        RsbenchError: not a dataset, or no such component.
    """
    from rsbench.benchmark.images.evaluation import open_evaluation, read_scores
    from rsbench.benchmark.images.plan import EvaluationOptions
    from rsbench.benchmark.images.score import TABLES

    arguments.check_whole("seeds", seeds, 1, 1_000_000)
    arguments.check_whole("seed", seed, 0)
    options = EvaluationOptions(
        solvers=arguments.names("solvers", solvers),
        correction_solver=str(arguments.name_or_path("correct_with", correct_with)),
        features=str(arguments.name_or_path("features", features)),
        matcher=str(arguments.name_or_path("matcher", matcher)),
        corrector=str(arguments.name_or_path("corrector", corrector)),
        metrics=arguments.names("metrics", metrics),
        only=arguments.names("only", only),
        force=force,
        rehash=rehash,
        seeds=seeds,
        seed=seed,
    )
    data, place = arguments.path("folder", folder), arguments.path("out", out)
    open_evaluation(data, place, options).run("rsbench.evaluate", lambda word: None)
    return {table: read_scores(place, table) for table in TABLES}


def estimate_trajectory(
    sequence: Series[Correspondences] | Series[Series[NDArray[Any]]],
    rig: StereoRig,
    shutter: RollingShutter | None = None,
    *,
    features: str = "dense",
    seed: int = 0,
    gyro: ArrayLike | None = None,
) -> Trajectory:
    """The rig's trajectory through a sequence, one continuous-time spline, from matches with or without outliers.

    Args:
        sequence: the matches of frames 0 and 1, 1 and 2, ..., of which ``tracks`` must be there; or the frames: of
            each time the images of the left and the right camera, rectified.
        rig: both cameras.
        shutter: how they read; None has it found, of four frames and more.
        features: name or card of the feature matcher, where frames are given.
        seed: of the search for motions of single windows.
        gyro: (n, 4) samples of a gyroscope, as of ``Correspondences``, tau in frame periods of the sequence. Bias,
            noise, a clock that is off by up to half a frame period, and axes and scales that are off by some
            degrees and hundredths are found; the shutter is found without it.

    Returns:
        ``motion``: ``body_from_world(tau)`` at any times in frame periods, seen from the body at time 0;
        ``covariance(tau)`` and ``covariance_between(start, tau)`` (n, 6, 6) of turns about the body's axes,
        radians, and of its position, metres; ``shutter``; ``noise_px``; for each window ``inliers`` and
        ``supported``, False where its own matches do not carry it and the spline bridges it; ``gyro``: ``bias``,
        ``shift``, ``matrix``, ``noise`` and whether it is ``used``, which one is not that contradicts the matches.

    Raises:
        ValueError: an argument of another type or out of its range; no tracks.
        RsbenchError: no such feature matcher; a shutter that the matches do not tell; matches of no motion.
    """
    from rsbench.pipeline.arrays import matches_of, trajectory_of

    arguments.check_whole("seed", seed, 0)
    arguments.check_type("rig", rig, StereoRig)
    if shutter is not None:
        check_rows(rig, shutter)
    samples = gyro_samples(gyro)
    windows = [each for each in arguments.items("sequence", sequence) if isinstance(each, Correspondences)]
    if len(windows) != len(sequence):
        windows = matches_of(sequence, rig, str(arguments.name_or_path("features", features)))
    return trajectory_of(windows, rig, shutter, seed, samples)


def _estimate_under(
    requested: str,
    entry: SolverEntry,
    matches: Correspondences,
    rig: StereoRig,
    shutter: RollingShutter,
    options: RobustOptions,
    seed: int,
) -> RobustEstimate:
    """An estimate under the motion model that is requested or that the matches prefer (``auto``).

    Raises:
        RsbenchError: no such model, or the solver can take no other than its own.
        NoMotionError: the solver found only the direction of the translation.
    """
    from rsbench.pipeline.frame_motion import Matched, check_model, motion_of, under_model
    from rsbench.solvers.engine.robust_motion import estimate_motion

    def solve(entry: SolverEntry) -> RobustEstimate:
        rng = np.random.default_rng(seed)
        return estimate_motion(matches, rig, shutter, entry.solver, options, rng, entry.options.robust)

    check_model(requested, entry)
    given = Matched(matches, rig, shutter)
    found, entry, choice, motion = under_model(requested, entry, solve, given, options, seed)
    if found.estimate.success and isinstance(motion, str):
        motion_of(found.estimate, entry, rig)
    return found if choice is None else replace(found, motion_model=choice.used)


_COMPONENTS = ("rs-stereo-refined", None, "sgm", "dense", "fusion")
"""Defaults for a rig: solver, motion model, matcher, features and corrector."""


@overload
def correct(
    images: Series[NDArray[Any]],
    rig: StereoRig,
    readout_ratio: float | None = None,
    *,
    scanning: Scanning | None = None,
    solver: str | Path | Solver = "rs-stereo-refined",
    motion_model: str | None = None,
    matcher: str | Path = "sgm",
    features: str | Path = "dense",
    corrector: str | Path = "fusion",
    target_row: float = 0.0,
    inpaint: bool | None = None,
    seed: int = 0,
    gyro: ArrayLike | None = None,
    focal_sigma: float = 0.0,
    k1_sigma: float = 0.0,
) -> CorrectedFrames: ...


@overload
def correct(
    images: Series[NDArray[Any]],
    *,
    camera: PinholeCamera | float | Literal["unknown"],
    readout_ratio: float | None = None,
    target_row: float = 0.0,
    inpaint: bool | None = None,
    seed: int = 0,
    gyro: ArrayLike | None = None,
    gyro_clock_error: float = 0.0,
) -> list[Fused]: ...


def correct(
    images: Series[NDArray[Any]],
    rig: StereoRig | None = None,
    readout_ratio: float | None = None,
    *,
    scanning: Scanning | None = None,
    camera: PinholeCamera | float | Literal["unknown"] | None = None,
    solver: str | Path | Solver = "rs-stereo-refined",
    motion_model: str | None = None,
    matcher: str | Path = "sgm",
    features: str | Path = "dense",
    corrector: str | Path = "fusion",
    target_row: float = 0.0,
    inpaint: bool | None = None,
    seed: int = 0,
    gyro: ArrayLike | None = None,
    gyro_clock_error: float = 0.0,
    focal_sigma: float = 0.0,
    k1_sigma: float = 0.0,
) -> CorrectedFrames | list[Fused]:
    """The global-shutter frames that the cameras would have taken, from their rolling-shutter frames.

    Of a stereo rig, give four images and ``rig``; of one camera, two or more in order, and ``camera``.

    Args:
        images: as the sensor read them.
        rig: both cameras, with their lens where they have one.
        readout_ratio: readout time over frame period; None has it found, with the side that lines are read from.
        scanning: how the rig's cameras read their lines: from which side, the right one's delay and readout ratio.
            None: from the top, both at once, or found with the readout ratio.
        camera: one camera: its intrinsics, or its horizontal field of view in degrees, or "unknown". Of the other
            arguments one camera takes readout_ratio, target_row, inpaint, seed, gyro and gyro_clock_error.
        solver: finds the motion, in metres; as in ``estimate_motion``.
        motion_model: ``auto``, which the matches prefer, or a name; None is auto where the solver takes it.
        matcher, features, corrector: names or cards of what finds depth and matches, and corrects.
        target_row: the time of this row of a frame is that of its corrected image.
        inpaint: invent all pixels that no frame shows, or none; None closes specks and slits alone.
        seed: of the robust loop's samples.
        gyro: (n, 4) samples of a gyroscope, as of ``Correspondences``: of a rig for correctors that need them; of
            one camera they are its rotation, tau 0 the first row of the first frame.
        gyro_clock_error: frame periods by which the clock of ``gyro`` may be off, for one camera: its offset is
            then estimated from six pairs of frames and more. ``rsbench correct`` allows half a second.
        focal_sigma, k1_sigma: standard deviations of the rig's focal length, px, and of its lens's k1; both values
            are estimated first, and the result's ``rig`` has them. 0: exact.

    Returns:
        Of a rig ``frames["left", 0]`` and so on, with ``image``, ``depth`` and ``origin``; ``motion``,
        ``shutter`` and ``rig``. Of one camera a list of such frames, whose unit of length is the camera's
        translation over one frame period; a frame that cannot be corrected, and is given back as it was, has a
        ``reason``.

    Raises:
        ValueError: images of another type or size than the rig's cameras, a ratio or row out of its range.
        RsbenchError: frames that are not what they should be; no such component; no motion; no correction.
    """
    from rsbench.capture.calibration import CardSigma
    from rsbench.capture.hypotheses import KnownInputs
    from rsbench.pipeline import arrays as array_correction

    arguments.check_one_of("inpaint", inpaint, (None, True, False))
    if (rig is None) == (camera is None):
        raise ValueError("rig: give a StereoRig, or camera = a PinholeCamera, degrees or 'unknown'; one of both")
    sigmas = {"focal_sigma": focal_sigma, "k1_sigma": k1_sigma}
    for name, value in (*sigmas.items(), ("gyro_clock_error", gyro_clock_error)):
        arguments.check_number(name, value, 0.0)
    if scanning is not None:
        arguments.check_type("scanning", scanning, Scanning)
    if rig is None:
        if scanning is not None:
            raise ValueError("scanning: is that of a stereo rig; leave it out with camera")
        _check_own(solver, motion_model, matcher, features, corrector)
        for name in [name for name, value in sigmas.items() if value]:
            raise ValueError(f"{name}: is estimated for a stereo rig; leave it out with camera")
        if gyro_clock_error and gyro is None:
            raise ValueError("gyro_clock_error: has no effect without gyro; leave it out")
        known = None if isinstance(camera, str) and camera == "unknown" else camera
        return array_correction.of_one_camera(
            images, known, readout_ratio, target_row, inpaint, seed, gyro, float(gyro_clock_error)
        )
    arguments.check_type("rig", rig, StereoRig)
    if gyro_clock_error:
        raise ValueError("gyro_clock_error: is estimated for one camera; leave it out with rig")
    arguments.check_number("focal_sigma", focal_sigma, 0.0, 0.3 * abs(rig.camera.fx))
    arguments.check_number("k1_sigma", k1_sigma, 0.0, 0.3)
    sigma = CardSigma(focal=float(focal_sigma), k1=float(k1_sigma))
    inputs = KnownInputs(readout_ratio=readout_ratio, scanning=scanning, sigma=sigma)
    components = solver, motion_model, matcher, features, corrector
    options = array_correction.options_of(*components, target_row=target_row, inpaint=bool(inpaint), seed=seed)
    return array_correction.of_rig(images, rig, inputs, options, gyro, close=inpaint is None)


def _check_own(*components: object) -> None:
    """ValueError where a component is named that one camera does not have."""
    names = ("solver", "motion_model", "matcher", "features", "corrector")
    for name, value, default in zip(names, components, _COMPONENTS, strict=True):
        if not isinstance(value, str | Path | None) or value != default:
            raise ValueError(
                f"{name} = {arguments.shown(value)}: is chosen for a stereo rig; leave it out with camera"
            )
