"""``rsbench.correct``: of a stereo rig, and of one camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

from numpy.typing import ArrayLike, NDArray

from rsbench.core import arguments
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import Scanning

if TYPE_CHECKING:
    from rsbench.pipeline.chain import CorrectedFrames
    from rsbench.solvers.engine.base import Solver
    from rsbench.vision.fusion import Fused

_COMPONENTS = ("rs-stereo-refined", None, "sgm", "dense", "fusion")
"""Defaults for a rig: solver, motion model, matcher, features and corrector."""


@overload
def correct(
    images: Sequence[NDArray[Any]],
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
    images: Sequence[NDArray[Any]],
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
    images: Sequence[NDArray[Any]],
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
    components = solver, motion_model, matcher, features, corrector
    options = array_correction.options_of(*components, target_row=target_row, inpaint=bool(inpaint), seed=seed)
    return array_correction.of_rig(
        images, rig, readout_ratio, options, gyro, scanning=scanning, sigma=sigma, close=inpaint is None
    )


def _check_own(*components: object) -> None:
    """ValueError where a component is named that one camera does not have."""
    names = ("solver", "motion_model", "matcher", "features", "corrector")
    for name, value, default in zip(names, components, _COMPONENTS, strict=True):
        if not isinstance(value, str | Path | None) or value != default:
            raise ValueError(
                f"{name} = {arguments.shown(value)}: is chosen for a stereo rig; leave it out with camera"
            )
