"""``rsbench rig``: show how a calibration is understood, and convert it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rsbench.cli.console import echo, print_json
from rsbench.core.errors import RsbenchError

if TYPE_CHECKING:
    from rsbench.components.rig_tables import Size
    from rsbench.core.rig import StereoRig
    from rsbench.interop.readers.calibration_parts import Assumptions, Calibration

EPILOG = """[bold]Examples[/bold]

  rsbench rig camchain.yaml --picture rig.svg        [dim](Kalibr: what is understood)[/dim]

  rsbench rig stereo.yml --unit mm --size 1280x720 -o rig.toml        [dim](OpenCV: millimetres)[/dim]

  rsbench rig calibration/ -o rig.toml        [dim](intrinsics.yml and extrinsics.yml, or left and right)[/dim]

  rsbench rig SN10028.conf --size 1280x720 --to kalibr -o camchain.yaml        [dim](ZED)[/dim]

  rsbench rig zed2 --to ros -o camera_info           [dim](a card: rsbench list rigs; a folder of two files)[/dim]

FILE: Kalibr, OpenVINS, OpenCV FileStorage (yml, xml, json), ROS camera_info, Basalt, ZED, DepthAI, RealSense,
COLMAP (rig_config.json; cameras.txt with rigs.txt), EuRoC, rig.toml or camera.toml: found by its content. The
transform is X_right = R X_left + t.

Exit codes: 0 done, 2 the file cannot be read or represented.
More: [bold]rsbench docs calibrations[/bold]"""


def rig(
    file: Annotated[Path, typer.Argument(metavar="FILE|DIR|NAME", help="Calibration of one camera or of two.")],
    to: Annotated[
        str | None, typer.Option(metavar="FORMAT", help="Convert: rig.toml, kalibr, opencv, ros or colmap.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", metavar="PATH", help="Converted file.")] = None,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Size of the images, if the file does not have it.")
    ] = None,
    resize: Annotated[
        str | None, typer.Option(metavar="WxH", help="Convert for images scaled to this size.")
    ] = None,
    crop: Annotated[
        str | None,
        typer.Option(metavar="WxH+X+Y", help="Convert for images cropped to this size from column X and row Y."),
    ] = None,
    unit: Annotated[
        str | None,
        typer.Option(metavar="UNIT", help="Unit of lengths: m, cm, mm, inch, or metres, such as 0.025."),
    ] = None,
    lens: Annotated[
        str | None,
        typer.Option(metavar="MODEL", help="Lens model of four coefficients: brown-conrady or kannala-brandt."),
    ] = None,
    invert: Annotated[bool, typer.Option("--invert", help="The file's transform is the inverse.")] = False,
    exchange: Annotated[
        bool, typer.Option("--exchange", help="The file's second camera is the left one.")
    ] = False,
    fps: Annotated[
        float | None, typer.Option(help="Frames per second, to convert line delays to readout ratios.")
    ] = None,
    picture: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw the rig: .svg, .png or .pdf.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print what was understood as one JSON object.")] = False,
) -> None:
    """Show what is understood of a calibration, and convert it between the formats of tools."""
    from rsbench.interop.readers.calibration_parts import cropped, refuse_unseen, resized, with_size
    from rsbench.interop.readers.rig_files import calibration_of

    wanted = None if size is None else _size("--size", size)
    found = calibration_of(file, _assumptions(wanted, unit, lens, invert, exchange))
    found = found if wanted is None else with_size(found, wanted)
    found = found if resize is None else resized(found, _size("--resize", resize))
    found = found if crop is None else cropped(found, crop)
    refuse_unseen(found, file)
    if fps is not None:
        if not 0.0 < fps < 1e6:
            raise RsbenchError(f"--fps {fps:g}: must be a positive number of frames a second")
        found = dataclasses.replace(found, readout=found.readout | {"frame_period_s": 1.0 / fps})
    if out is None and to is not None:
        raise RsbenchError("--to: needs -o PATH, where the converted file goes")
    if json:
        print_json(_record(found))
    else:
        for line in _lines(found):
            echo(line)
    if picture is not None:
        if picture.suffix.lower() not in (".svg", ".png", ".pdf"):
            raise RsbenchError(f"--picture {picture}: must end in .svg, .png or .pdf")
        from rsbench.report.pictures import draw_rig

        drawn = _known_rig(found)
        if drawn is None:
            raise RsbenchError("--picture: needs two cameras and the size of their images; give --size")
        draw_rig(drawn, picture)
        echo(f"picture: {picture.resolve()}", err=json)
    if out is not None:
        _convert(found, to, out, json)


def _size(option: str, text: str) -> Size:
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit() and len(text) < 15 and int(width) and int(height)):
        raise RsbenchError(f"{option} {text!r}: must be width x height, such as 1280x720")
    return int(width), int(height)


def _assumptions(
    size: Size | None, unit: str | None, lens: str | None, invert: bool, exchange: bool
) -> Assumptions:
    """Parse the options. Raises RsbenchError for an unknown unit or lens."""
    from rsbench.interop.readers.calibration_parts import UNITS, Assumptions

    metres = None
    if unit is not None:
        try:
            metres = UNITS[unit] if unit in UNITS else float(unit)
        except ValueError:
            metres = 0.0
        if not 0.0 < metres < 1e6:
            raise RsbenchError(f"--unit {unit!r}: must be one of {', '.join(UNITS)}, or a number of metres")
    if lens not in (None, "brown-conrady", "kannala-brandt"):
        raise RsbenchError(f"--lens {lens!r}: must be brown-conrady or kannala-brandt")
    return Assumptions(
        unit=metres,
        fisheye=None if lens is None else lens == "kannala-brandt",
        invert=invert,
        exchange=exchange,
        frame_size=None if size is None else lambda: size,
    )


def _known_rig(found: Calibration) -> StereoRig | None:
    """Return the rig; None if there is one camera, or an image size is unknown."""
    from rsbench.interop.writers.calibrations import rig_of

    known = found.right is not None and "width" in found.left and "width" in found.right
    return rig_of(found) if known else None


def _convert(found: Calibration, to: str | None, out: Path, json: bool) -> None:
    from rsbench.components.cards import choices
    from rsbench.interop.writers.calibrations import WRITERS, write_calibration

    kind = to or ("rig.toml" if out.suffix == ".toml" else "")
    if kind not in WRITERS:
        wrong = f"--to {to!r}: no such format" if to else f"-o {out}: give --to FORMAT"
        raise RsbenchError(f"{wrong}{choices(kind, WRITERS)}")
    for path in write_calibration(found, kind, out):
        echo(f"written: {path}", err=json)


def _lines(found: Calibration) -> list[str]:
    """Describe the calibration as lines of text."""
    record = _record(found)
    names = ", ".join(path.name for path in found.files)
    lines = [f"{found.format}{f' ({names})' if names else ''}"]
    for side in ("left", "right"):
        if (own := record.get(side)) is None:
            continue
        size = f"{own['width']} x {own['height']} px" if "width" in own else "size not given"
        name = side if "right" in record else "camera"
        lines.append(
            f"{name}: {size}, focal length {own['fx']:.2f}, {own['fy']:.2f} px, "
            f"centre {own['cx']:.2f}, {own['cy']:.2f}"
        )
        lens = own.get("lens")
        values = [f"{key} {value:.6g}" for key, value in (lens or {}).items() if key != "model" and value]
        shown = "none" if lens is None else " ".join([lens["model"], *values])
        view = "" if "view_deg" not in own else "; sees {:.1f} x {:.1f} deg".format(*own["view_deg"])
        delay = own.get("line_delay_s")
        read = "" if delay is None else f"; {1e6 * delay:.4g} us a line" if delay else "; global shutter"
        lines.append(f"  lens {shown}{view}{read}")
    if "baseline_m" in record:
        lines.append(
            f"baseline {1e3 * record['baseline_m']:.2f} mm; the right camera stands at "
            + ", ".join(f"{1e3 * each:.2f}" for each in record["right_at_m"])
            + " mm in the left one's axes (right, down, ahead)"
        )
        lines.append(
            "the right camera is turned by {:.3f}, {:.3f}, {:.3f} deg about x, y, z: {:.3f} deg in all".format(
                *record["rotation_deg"], record["angle_deg"]
            )
        )
    if "rows_apart_px" in record:
        low, high = record["rows_apart_px"]
        lines.append(f"far points lie {low:.1f} to {high:.1f} rows lower in the right image: it is taken as it is")
    for key, value in record["readout"].items():
        lines.append(f"{key} = {value}")
    lines += [f"missing: {each}" for each in record["missing"]]
    return [*lines, *(f"note: {each}" for each in record["notes"])]


def _record(found: Calibration) -> dict[str, Any]:
    """Describe the calibration as a JSON object."""
    import numpy as np

    from rsbench.core import so3
    from rsbench.interop.writers.calibrations import cameras_of

    record: dict[str, Any] = {"format": found.format, "left": dict(found.left)}
    if found.right is not None:
        record["right"] = dict(found.right)
    missing = list[str]()
    if "width" in found.left and (found.right is None or "width" in found.right):
        for side, camera in cameras_of(found).items():
            ends = [
                [-0.5, camera.cy],
                [camera.width - 0.5, camera.cy],
                [camera.cx, -0.5],
                [camera.cx, camera.height - 0.5],
            ]
            rays = camera.unproject(ends)
            rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
            angles = np.degrees(np.arccos(np.sum(rays[::2] * rays[1::2], axis=-1)))
            record[side]["view_deg"] = angles.tolist()
    else:
        missing.append("the size of the images (--size; of frames it is theirs)")
    if found.right_from_left is not None:
        R, t = found.right_from_left
        record |= {"baseline_m": float(np.linalg.norm(t)), "right_at_m": (-(R.T @ t)).tolist()}
        record |= {"rotation_deg": np.degrees(so3.log(R)).tolist(), "angle_deg": float(np.degrees(so3.angle(R)))}
        record["right_from_left"] = {"rotation": R.tolist(), "translation": t.tolist()}
        if (rig := _known_rig(found)) is not None and not rig.rectified:
            record["rows_apart_px"] = _rows_apart(rig)
    if found.right_delay_s:
        record["right_delay_s"] = found.right_delay_s
    record["readout"] = found.readout
    delays = [(each or {}).get("line_delay_s") for each in (found.left, found.right or found.left)]
    if "readout_ratio" not in found.readout and None in delays:
        missing.append("the readout (--readout-ratio or --shutter of rsbench correct; else the frames show it)")
    elif any(delays) and "frame_period_s" not in found.readout:
        missing.append("the frames' rate, which makes the line delay a readout ratio (--fps)")
    return record | {"missing": missing, "notes": list(found.notes)}


def _rows_apart(rig: StereoRig) -> list[float] | None:
    """Return the range of row differences, right minus left, of points at infinity in both images; None if none is
    in both."""
    import numpy as np

    left, right = rig.sensor("left"), rig.sensor("right")
    x, y = (np.linspace(0.0, size - 1.0, 25) for size in (left.width, left.height))
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    seen = right.project(left.unproject(pixels) @ rig.right_from_left.R.T)
    good = right.contains(seen)
    if not np.any(good):
        return None
    apart = (seen[good, 1] - pixels[good, 1]).tolist()
    return [min(apart), max(apart)]
