"""``rsbench correct --camera``: correction of the frames of one camera."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rsbench.pipeline.footage import FrameSource
    from rsbench.pipeline.mono_sequence import MonoMoment, OneCameraCard

CameraFile = Annotated[Path | None, typer.Option(metavar="CAMERA.toml", help="Of one camera, in place of --rig.")]
Footage = Annotated[Path | None, typer.Option("--frames", metavar="DIR|VIDEO", help="Frames of one camera.")]
_PAGE_FRAMES = 6
_CAMERA = ("width", "height", "fx", "fy", "cx", "cy")


def correct_one_camera(
    frames: list[Path] | None, footage: Path | None, camera: Path, out: Path | None, target: str, inpaint: bool
) -> None:
    """Correct images, or a folder or video, of one camera; exit 1 where some of many frames are not corrected.

    Raises:
        RsbenchError: arguments that do not go together, or what ``correct_frames`` refuses.
    """
    from rsbench.cli.console import progress_bar
    from rsbench.core.errors import RsbenchError
    from rsbench.dataset.corrected_frames import fresh_folder, write_record
    from rsbench.pipeline.footage import FrameSource
    from rsbench.pipeline.mono_sequence import correct_frames, read_one_camera
    from rsbench.report.corrected_page import write_page

    if out is None:
        raise RsbenchError("--out: is required")
    if (frames is None) == (footage is None):
        raise RsbenchError("frames: with --camera give FRAME_0 FRAME_1 and so on, or --frames DIR|VIDEO")
    card = read_one_camera(camera)
    if card.readout_ratio is None:
        raise RsbenchError(f"{camera}: readout_ratio: must be given for one camera")
    source = FrameSource.of_files(frames) if frames is not None else FrameSource(footage or Path())
    with fresh_folder(out) as folder:
        with progress_bar("correcting", max(source.count, 1)) as advance:
            moments = correct_frames(source, card, _options(source, target, inpaint))
            record, cards = _write(folder, moments, card, source.count, advance)
        write_record(folder, record)
        facts = [("readout ratio", f"{card.readout_ratio:.3f} (given)"), ("focal length", _focal(card, record))]
        facts += [("unit of depth", "length of the translation over one frame period")]
        write_page(folder, f"rsbench correct: {out.name}", "Rolling shutter to global shutter", facts, cards)
    failed = [f"frame {each['number']} ({each['reason']})" for each in record["frames"] if "reason" in each]
    typer.echo(f"{len(record['frames']) - len(failed)} of {len(record['frames'])} frames corrected")
    typer.echo(f"report: {(out / 'report.html').resolve()}")
    if failed:
        typer.echo(f"rsbench: not corrected: {'; '.join(failed)}", err=True)
        raise typer.Exit(1)


def _options(source: FrameSource, target: str, inpaint: bool) -> Any:
    from rsbench.cli.correct_input import target_row
    from rsbench.pipeline.mono_correction import MonoFusionCorrector
    from rsbench.pipeline.mono_sequence import MonoOptions
    from rsbench.vision.mono_fusion import MonoFusionOptions

    height = next(iter(source)).shape[0]
    corrector = MonoFusionCorrector(fusion=MonoFusionOptions(inpaint=inpaint))
    return MonoOptions(corrector=corrector, target_row=target_row(target, height))


def _focal(card: OneCameraCard, record: dict[str, Any]) -> str:
    known = card.camera is not None or card.fov_deg is not None
    return f"{record['camera']['fx']:.1f} px ({'given' if known else 'assumed: the width of the image'})"


def _write(
    folder: Path, moments: Any, card: OneCameraCard, count: int, advance: Any
) -> tuple[dict[str, Any], list[Any]]:
    """Write every frame; returns what motion.json holds, and some frames for the page."""
    from rsbench.dataset.corrected_frames import MASK_VALUES, write_frame
    from rsbench.pipeline.mono_sequence import translation_record
    from rsbench.report.corrected_page import card_of

    units = "length of the translation over one frame period"
    record: dict[str, Any] = {
        "units": {"length": units, "angle": "rad", "time": "frame period", "depth": f"{units}, 0 = unknown"},
        "readout_ratio": card.readout_ratio,
        "focal_length_assumed": card.camera is None and card.fov_deg is None,
        "corrector": "mono-fusion",
        "mask_values": {origin.name.lower(): value for origin, value in MASK_VALUES.items()},
        "frames": [],
    }
    cards: list[Any] = []
    moment: MonoMoment
    for moment in moments:
        write_frame(folder, f"{moment.number:06d}", moment.fused)
        entry: dict[str, Any] = {"number": moment.number, **moment.fused.shares()}
        if moment.fused.reason:
            entry["reason"] = moment.fused.reason
        if moment.found is not None:
            entry["motion"] = translation_record(moment.found)
        record["frames"].append(entry)
        record["camera"] = {
            key: getattr(moment.camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")
        }
        if moment.number % max(count // _PAGE_FRAMES, 1) == 0 and len(cards) < _PAGE_FRAMES:
            cards.append(card_of(f"frame {moment.number}", moment.image, moment.fused))
        advance(f"frame {moment.number}")
    return record, cards
