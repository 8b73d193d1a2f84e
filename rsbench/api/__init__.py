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
    """Project world points (..., 3), metres, into a frame of a moving rolling-shutter camera.

    The equation of the row that sees a point is solved to 1e-9 px. ``frame`` counts from 0.

    Returns:
        ``pixels`` (..., 2); ``depth`` (...), z in the camera at that row's time; ``tau`` (...), that time;
        ``status`` (...): 0 seen, 1 never seen, 2 seen twice (the first time is returned), 3 not converged. NaN
        where no row sees the point.
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
    """Simulate matches of random points seen by a moving rig, with noise and outliers.

    Args:
        rig, shutter, motion: the cameras, their row times, and the motion of the rig.
        pairs: number of matches between frame 0 and frame 1 of each camera; each camera has points of its own.
        tracks: number of points that are matched through all four images.
        noise_px: standard deviation of every pixel coordinate.
        outlier_ratio: share of matches whose pixels in frame 1 are wrong, by up to 80 px.
        depth: least and largest depth of the points in frame 0, metres.
        shape: ``box``: random depths; ``plane``: all points on one slanted plane.
        seed: points and noise depend on the seed alone, not on the other arguments.

    Returns:
        ``correspondences``, and ``outliers``, a mask for each of ``left``, ``right`` and ``tracks``.

    Raises:
        ValueError: an argument is out of its range, or too few points stay in view.
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
    """Estimate the motion of a rig over one frame period from matches with outliers.

    Args:
        correspondences: matches, px.
        rig, shutter: the cameras and their row times.
        solver: a name of ``list_solvers``, the path of a card or of a Python file, a ``Solver``, or a function
            that ``rsbench.solver`` decorates.
        motion_model: a name, or ``auto`` for the most probable model; None: the model that the solver assumes.
        threshold_px: largest error of an inlier; None: it is adapted to the noise of the inliers.
        seed: seed of RANSAC's samples.

    Returns:
        ``estimate``, a ``MotionEstimate``: if no motion was found, its ``success`` is False and its ``reason``
        says why; ``inliers``, a mask for each of ``left``, ``right`` and ``tracks``; ``inlier_count`` and
        ``match_count``, which count each match once.

    Raises:
        RsbenchError: there is no such solver or motion model, or the solver supports only its own model.
        ValueError: an argument has a wrong type or is out of its range.
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
    """Compute the errors of an estimated motion, as defined in docs/explanation/conventions.md.

    Args:
        found: result of ``estimate_motion`` or of a solver.
        motion: true motion.
        rig: the cameras.
        reference_point: the point whose translation ``found`` contains: ``body`` or ``left`` (the left camera).
            None: the one named by the result of ``estimate_motion``; for a result of a solver, the body.

    Returns:
        ``e_R_deg``, ``e_T_deg`` (degrees) and ``e_s``. A failure scores 180, 180 and infinity. NaN: there is
        nothing to compare, as e_s of an estimate without metric scale, or e_T and e_s without a true translation.

    Raises:
        ValueError: there is no such reference point.
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
    """Match the four images of a rig over two frames: over time, left to right, and through all four images.

    Args:
        images: four images.
        features: name or card of the feature matcher.

    Raises:
        ValueError: there are not four images of equal size and type (uint8 or uint16).
        RsbenchError: there is no such feature matcher.
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
    """Compute the depth (H, W), metres, of one image of a rectified pair; 0: unknown.

    The pair may be a rolling-shutter one, since both cameras read the same row at the same time.

    Raises:
        ValueError: the images differ in size or type, or do not have the size of the rig's cameras.
        RsbenchError: there is no such matcher.
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
    """Open the sequences of a dataset on disk; images, depth and row poses are read when they are used.

    Raises:
        RsbenchError: the folder has no complete dataset, or a sequence cannot be read.
    """
    from rsbench.dataset import sequence

    return sequence.read_dataset(arguments.path("folder", folder))


def read_rig(
    path: AnyPath,
    size: tuple[int, int] | tuple[tuple[int, int], tuple[int, int]] | None = None,
    *,
    fps: float | None = None,
) -> KnownRig:
    """Read the cameras of a rig from a calibration of another tool, from rig.toml, or from a card by its name.

    ``correct(images, found.rig, found.readout_ratio, scanning=found.scanning)`` uses all values of the file.

    Args:
        path: a file of Kalibr, OpenVINS, OpenCV, ROS, Basalt, ZED, DepthAI, RealSense, COLMAP or EuRoC, or a
            folder of such files. The tool is recognised by the content.
        size: (width, height) of the images, or two of these, left and right; needed if the file has no size or
            several.
        fps: frames per second; needed if the file gives readout times in seconds.

    Returns:
        ``rig``; ``readout_ratio`` and ``scanning``, None if the file does not have them; ``notes``, sentences
        about what was assumed.

    Raises:
        RsbenchError: the file cannot be read or represented, or is for images of another size.
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
    """Render a dataset into a folder and open it. Sequences that the folder already has are not rendered again.

    Args:
        card: name of a dataset card (``rsbench list datasets``) or path to one.
        out: folder of the dataset.
        sequences: names of the sequences to render; None: all.
        workers: number of processes; each renders whole sequences.

    Raises:
        RsbenchError: there is no such card or sequence, or the folder has another dataset.
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
    """Check a dataset: its files and poses, depth maps and images against each other, and rows rendered again.

    Args:
        folder: folder of the dataset.
        stride: every n-th pixel in both directions is compared.
        rerender: rows to render again if the scene can be built here: "no", "auto" (takes seconds) or "all".
        scenes: cards of scenes that are not part of rsbench, and mesh files of moving objects.

    Returns:
        One report per sequence; a sequence without ``faults`` passed. If dataset.json itself has faults, the first
        report lists them.

    Raises:
        RsbenchError: the folder has no dataset.
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
    """Run solvers, stereo matching and correction on a dataset and score the results against its truth.

    Args:
        folder: folder of the dataset.
        out: folder of predictions and scores; predictions in it that are up to date are kept.
        solvers: names of ``list_solvers`` or paths of cards.
        correct_with: solver whose motion is used for the correction.
        matcher, features, corrector: names or cards.
        metrics: names or cards of further metrics.
        only: names of solvers and sequences; others are not predicted. All predictions are scored.
        force: repeat predictions that are up to date.
        rehash: read all data again, also files that seem unchanged.
        seeds: number of runs of each solver, with different RANSAC samples; each is a row of ``pose``.
        seed: first of these seeds.

    Returns:
        The tables ``pose``, ``depth``, ``correction``, ``failures`` and ``seconds``: ``rsbench docs score-files``.

    Raises:
        RsbenchError: the folder has no dataset, or there is no such component.
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
    """Estimate the trajectory of a rig in a sequence, as a continuous-time spline.

    Args:
        sequence: matches of frames 0 and 1, 1 and 2, and so on, with ``tracks`` and possibly outliers; or frames:
            for each time the left and the right image.
        rig: both cameras.
        shutter: row times; None: they are estimated, which needs four frames.
        features: name or card of the feature matcher, if frames are given.
        seed: seed of the search for motions of single windows.
        gyro: (n, 4) samples of a gyroscope, as in ``Correspondences``, with tau in frame periods of the sequence.
            Its bias, noise, clock offset (up to half a frame period), misalignment (some degrees) and scale errors
            (some per cent) are estimated. The shutter is estimated without it.

    Returns:
        ``motion``, with ``body_from_world(tau)`` at any time, frame periods; the world is the body at time 0.
        ``covariance(tau)`` and ``covariance_between(start, tau)`` (n, 6, 6) of small rotations about the body's
        axes, radians, and of its position, metres. ``shutter``; ``noise_px``. For each window ``inliers``, and
        ``supported``: False if too few of its matches agree and the spline is interpolated; ``depths``: False if
        disparities are below their noise, so that the covariances do not hold. ``gyro``, with
        ``bias``, ``shift``, ``matrix``, ``noise`` and ``used``, which is False if it contradicts the matches.

    Raises:
        ValueError: an argument has a wrong type or is out of its range, or there are no tracks.
        RsbenchError: there is no such feature matcher, or the matches do not determine the shutter or a motion.
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
    """Estimate the motion under the requested motion model, or under the most probable one (``auto``).

    Raises:
        RsbenchError: there is no such model, or the solver supports only its own model.
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
    """Correct rolling-shutter frames: return the frames that global-shutter cameras would have taken.

    For a stereo rig, give four images and ``rig``; for one camera, two or more images in order and ``camera``.

    Args:
        images: unrectified, with the rows as the sensor read them.
        rig: both cameras, with their lenses.
        readout_ratio: readout time divided by the frame period; None: it is estimated, with the scan direction.
        scanning: scan direction of the rig's cameras, and delay and readout ratio of the right one. None: from the
            top and both at once, or estimated with the readout ratio.
        camera: intrinsics of one camera, its horizontal field of view in degrees, or "unknown". For one camera,
            the other arguments are readout_ratio, target_row, inpaint, seed, gyro and gyro_clock_error.
        solver: estimates the motion in metres; as in ``estimate_motion``.
        motion_model: a name, or ``auto`` for the most probable model; None: ``auto`` if the solver supports it.
        matcher, features, corrector: names or cards of the stereo matcher, feature matcher and corrector.
        target_row: a corrected frame shows the scene at the time of this row.
        inpaint: True: fill all pixels that no frame shows; False: none; None: only specks and narrow slits.
        seed: seed of RANSAC's samples.
        gyro: (n, 4) samples of a gyroscope, as in ``Correspondences``. With a rig they are used by correctors that
            need them; with one camera they give its rotation, and tau 0 is the first row of the first frame.
        gyro_clock_error: largest error of the clock of ``gyro``, frame periods; above 0, the offset is estimated,
            which needs seven frames. For one camera. ``rsbench correct`` allows half a second.
        focal_sigma, k1_sigma: standard deviations of the given focal length, px, and of the lens parameter k1 of a
            rig. Above 0, both are estimated, and the result's ``rig`` has the estimates.

    Returns:
        For a rig: ``frames["left", 0]`` and so on, each with ``image``, ``depth`` and ``origin``; ``motion``,
        ``shutter`` and ``rig``. For one camera: a list of such frames; the unit of length is the translation of
        the camera over one frame period. A frame that cannot be corrected is returned as it was, and its
        ``reason`` says why.

    Raises:
        ValueError: images differ in type, or in size from the rig's cameras; a ratio or row is out of its range.
        RsbenchError: the frames contradict the arguments, there is no such component, or the frames do not
            determine a motion.
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
    """Raise ValueError if a component is given that one camera does not use."""
    names = ("solver", "motion_model", "matcher", "features", "corrector")
    for name, value, default in zip(names, components, _COMPONENTS, strict=True):
        if not isinstance(value, str | Path | None) or value != default:
            raise ValueError(
                f"{name} = {arguments.shown(value)}: is chosen for a stereo rig; leave it out with camera"
            )
