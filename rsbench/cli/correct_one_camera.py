"""``rsbench correct --camera``: correction of the frames of one camera."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rsbench.core.camera import PinholeCamera
    from rsbench.pipeline.footage import FrameSource
    from rsbench.pipeline.mono_sequence import MonoMoment, MonoOptions
    from rsbench.pipeline.mono_shutter import FoundShutter
    from rsbench.pipeline.one_camera_card import OneCameraCard

CameraFile = Annotated[Path | None, typer.Option(metavar="CAMERA.toml", help="Of one camera, in place of --rig.")]
Footage = Annotated[Path | None, typer.Option("--frames", metavar="DIR|VIDEO", help="Frames of one camera.")]
_PAGE_FRAMES = 6
_UNIT = "length of the translation over one frame period"


def correct_one_camera(
    frames: list[Path] | None,
    footage: Path | None,
    camera: Path | None,
    out: Path | None,
    target: str,
    inpaint: bool,
    seed: int,
) -> None:
    """Correct images, or a folder or video, of one camera; exit 1 where some of many frames are not corrected.

    Raises:
        RsbenchError: arguments that do not go together, or what ``correct_frames`` refuses.
    """
    from rsbench.core.errors import RsbenchError
    from rsbench.pipeline.footage import FrameSource
    from rsbench.pipeline.one_camera_card import OneCameraCard, read_one_camera

    if out is None:
        raise RsbenchError("--out: is required")
    if (frames is None) == (footage is None):
        raise RsbenchError("frames: with --camera give FRAME_0 FRAME_1 and so on, or --frames DIR|VIDEO")
    card = OneCameraCard() if camera is None else read_one_camera(camera)
    source = FrameSource.of_files(frames) if frames is not None else FrameSource(footage or Path())
    record = _correct(source, card, out, _options(source, target, inpaint, seed))
    _say(record, out)


def _correct(source: FrameSource, card: OneCameraCard, out: Path, options: MonoOptions) -> dict[str, Any]:
    """What motion.json holds; exit 1 where the frames do not show how they were read."""
    from rsbench.capture.settle import NoMotionError
    from rsbench.cli.console import progress_bar
    from rsbench.dataset.corrected_frames import fresh_folder, write_record
    from rsbench.pipeline.mono_sequence import correct_frames
    from rsbench.pipeline.mono_shutter import WINDOWS, find_shutter
    from rsbench.report.corrected_page import write_page

    height, width = next(iter(source)).shape[:2]
    camera, corrector = card.camera_of(width, height), options.corrector
    with fresh_folder(out) as folder:
        try:
            pairs = WINDOWS if card.readout_ratio is None else 0
            with progress_bar("looking at the shutter", min(max(source.count - 1, 1), pairs)) as advance:
                found = find_shutter(source, source.count, card, corrector.robust, corrector.seed, advance)
        except NoMotionError as error:
            typer.echo(f"rsbench: not corrected: {error}", err=True)
            raise typer.Exit(1) from None
        record = _known(card, camera, found, options)
        with progress_bar("correcting", max(source.count, 1)) as advance:
            moments = correct_frames(source, camera, found.shutter, options)
            record["frames"], cards = _write(folder, moments, source.count, advance)
        write_record(folder, record)
        facts = [("readout ratio", _readout(record)), ("focal length", _focal(record))]
        facts += [("unit of depth", _UNIT)]
        write_page(folder, f"rsbench correct: {out.name}", "Rolling shutter to global shutter", facts, cards)
    return record


def _options(source: FrameSource, target: str, inpaint: bool, seed: int) -> MonoOptions:
    from rsbench.cli.correct_input import target_row
    from rsbench.pipeline.mono_correction import MonoFusionCorrector
    from rsbench.pipeline.mono_sequence import MonoOptions
    from rsbench.vision.mono_fusion import MonoFusionOptions

    height = next(iter(source)).shape[0]
    corrector = MonoFusionCorrector(fusion=MonoFusionOptions(inpaint=inpaint), seed=seed)
    return MonoOptions(corrector=corrector, target_row=None if target == "middle" else target_row(target, height))


def _known(
    card: OneCameraCard, camera: PinholeCamera, found: FoundShutter, options: MonoOptions
) -> dict[str, Any]:
    """What the correction assumed or found."""
    from rsbench.capture.settle import record_of
    from rsbench.dataset.corrected_frames import MASK_VALUES

    best = None if found.capture is None else found.capture.likeliest
    return {
        "units": {"length": _UNIT, "angle": "rad", "time": "frame period", "depth": f"{_UNIT}, 0 = unknown"},
        "camera": {key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")},
        "focal_length_assumed": card.camera is None and card.fov_deg is None,
        "scan": found.scan,
        "readout_ratio": found.shutter.readout_ratio,
        "readout_ratio_sigma": None if best is None else best.sigma,
        "readout_ratio_estimated": found.capture is not None,
        "capture": None if found.capture is None else record_of(found.capture),
        "corrector": "mono-fusion",
        "target_row": options.target_row,
        "mask_values": {origin.name.lower(): value for origin, value in MASK_VALUES.items()},
    }


def _readout(record: dict[str, Any]) -> str:
    text = f"{record['readout_ratio']:.3f}"
    if not record["readout_ratio_estimated"]:
        return f"{text} (given)"
    sure = f"{100.0 * record['capture']['probability']:.0f} % sure"
    return f"{text} +- {record['readout_ratio_sigma']:.3f}, from the {record['scan']} (found, {sure})"


def _focal(record: dict[str, Any]) -> str:
    how = "assumed: the width of the image" if record["focal_length_assumed"] else "given"
    return f"{record['camera']['fx']:.1f} px ({how})"


def _say(record: dict[str, Any], out: Path) -> None:
    """Exit 1 where some frames are not corrected."""
    told = {
        key: "; ".join(f"frame {each['number']} ({each[key]})" for each in record["frames"] if key in each)
        for key in ("skipped", "reason")
    }
    corrected = sum("reason" not in each for each in record["frames"])
    typer.echo(f"readout ratio {_readout(record)}")
    typer.echo(f"{corrected} of {len(record['frames'])} frames corrected")
    typer.echo(f"report: {(out / 'report.html').resolve()}")
    if told["skipped"]:
        typer.echo(f"rsbench: corrected with the frame after them: {told['skipped']}", err=True)
    if told["reason"]:
        typer.echo(f"rsbench: not corrected: {told['reason']}", err=True)
        raise typer.Exit(1)


def _write(folder: Path, moments: Any, count: int, advance: Any) -> tuple[list[dict[str, Any]], list[Any]]:
    """Write every frame; returns what motion.json says of each, and some for the page."""
    from rsbench.dataset.corrected_frames import write_frame
    from rsbench.pipeline.mono_sequence import translation_record
    from rsbench.report.corrected_page import card_of

    entries: list[dict[str, Any]] = []
    cards: list[Any] = []
    moment: MonoMoment
    for moment in moments:
        write_frame(folder, f"{moment.number:06d}", moment.fused)
        entry: dict[str, Any] = {"number": moment.number, **moment.fused.shares()}
        for key, words in (("reason", moment.fused.reason), ("skipped", moment.skipped)):
            if words:
                entry[key] = words
        if moment.found is not None:
            entry["motion"] = translation_record(moment.found)
        entries.append(entry)
        if moment.number % max(count // _PAGE_FRAMES, 1) == 0 and len(cards) < _PAGE_FRAMES:
            cards.append(card_of(f"frame {moment.number}", moment.image, moment.fused))
        advance(f"frame {moment.number}")
    return entries, cards
