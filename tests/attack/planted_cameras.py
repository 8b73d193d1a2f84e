"""Faults planted into sequences of cameras with a lens, of other scans and of a late right camera.

The dataset of each camera holds one sequence of ``planting.VICTIM``'s name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import frame_faults
import numpy as np
from numpy.typing import NDArray

from attack.planted_faults import depth_faults, every_depth, image_faults, rendered_as, twin_at
from attack.planting import (
    RNG,
    VICTIM,
    Fault,
    Plant,
    depth_of,
    drop,
    image_of,
    in_victim,
    manifest_of,
    noised,
    other_geometry,
    poses_of,
    put,
    removed,
    renumbered,
    shifted,
    swapped,
    times,
)
from attack.wet_castle import WET_CASTLE
from rsbench.components.cards import parse_card
from rsbench.components.rig_tables import RigTables, tables_of
from rsbench.core import so3
from rsbench.core.camera import Lens, PinholeCamera
from rsbench.core.projection import row_poses
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.dataset.card import CameraCard, DatasetCard, load_dataset_card
from rsbench.dataset.clock_channels import write_timing
from rsbench.dataset.sequence import Sequence, read_sequence
from rsbench.dataset.views import IMAGE_VIEWS, ImageView
from rsbench.renderers.image import Sensor, compressed, expose, linear_of_codes, processed, rows_needed
from rsbench.storage.files import (
    read_depth,
    read_mask,
    read_png,
    write_depth,
    write_exr,
    write_mask,
    write_png,
    write_poses,
)

Pixels = NDArray[Any]
CAMERA = Sensor(
    full_well=6000,
    gain=4,
    photon_noise=True,
    read_noise=2.5,
    bit_depth=10,
    mosaic="RGGB",
    right_mosaic="none",
    right_jpeg_quality=80,
)


def _made_by(view: str, **changes: Any) -> Plant:
    """A frame as another sensor makes it of the clean twin, with noise of its own."""

    def plant(folder: Path) -> None:
        home, (side, _, frame) = folder / VICTIM, view.partition("_")
        sensor = replace(read_sequence(home).sensor or Sensor(), **changes).of(side, int(frame))
        clean = read_png(home / f"rs_clean/{view}.png")
        rows = range(len(clean))
        needed = rows_needed(sensor, rows, len(clean))
        read = expose(linear_of_codes(clean).astype(np.float32), sensor, RNG, len(clean), needed)
        write_png(home / f"rs/{view}.png", processed(read, sensor, len(clean), needed, rows))

    return plant


def _everywhere(key: str, value: Any) -> Plant:
    """Another sensor in sequence.json and in the card."""

    def plant(folder: Path) -> None:
        manifest_of(f"{VICTIM}/sequence.json", put("sensor", key, value))(folder)
        manifest_of("dataset.json", put("card", "sensor", key, value))(folder)

    return plant


def _in_rows(change: Callable[[Pixels], Pixels]) -> Callable[[Pixels], Pixels]:
    def changed(image: Pixels) -> Pixels:
        image[40:60] = change(image.copy())[40:60]
        return image

    return changed


def _smooth(image: Pixels) -> Pixels:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.7), dtype=np.uint8)


def _sensor_faults() -> Iterator[Fault]:
    left, right = "rs/left_1.png", "rs/right_0.png"
    mosaic, jpeg = "mosaic RGGB", "no JPEG image of quality 80"
    for name, plant, words in (
        ("no mosaic", _made_by("left_1", mosaic="none"), "looks like no mosaic"),
        ("another mosaic", _made_by("left_1", mosaic="GBRG"), "looks like GBRG"),
        ("shifted by a row", image_of("rs", "left_1", lambda image: np.roll(image, 1, axis=0)), mosaic),
        ("compressed", image_of("rs", "left_1", lambda image: compressed(image, 90)), mosaic),
        ("three times the gain", _made_by("left_1", gain=12), "the variance of the sensor's"),
        ("upside down", image_of("rs", "left_1", np.flipud), "beyond 5 sigma"),
        ("smoothed rows", image_of("rs", "left_1", _in_rows(_smooth)), mosaic),
    ):
        yield Fault(f"{left} {name}", plant, (left, words))
    for name, plant, words in (
        ("not compressed", _made_by("right_0", right_jpeg_quality=0), jpeg),
        ("of quality 60", _made_by("right_0", right_jpeg_quality=60), "looks like quality 60"),
        ("shifted by a row", image_of("rs", "right_0", lambda image: np.roll(image, 1, axis=0)), ""),
        ("upside down", image_of("rs", "right_0", np.flipud), "beyond 5 sigma"),
        ("rows of every fourth code", image_of("rs", "right_0", _in_rows(lambda image: image // 4 * 4)), jpeg),
    ):
        yield Fault(f"{right} {name}", plant, (right, words))
    yield Fault("another mosaic everywhere", _everywhere("mosaic", "BGGR"), ("rs/left_0.png", "looks like RGGB"))
    yield Fault(
        "another quality everywhere", _everywhere("right_jpeg_quality", 90), ("rs/right_0.png", "quality 80")
    )
    no = _everywhere("right_jpeg_quality", None)
    yield Fault("no compression everywhere", no, ("rs/right_0.png", "variance of the sensor's"))
    own = manifest_of(f"{VICTIM}/sequence.json", put("sensor", "mosaic", "none"))
    yield Fault("no mosaic in sequence.json", own, ("sequence.json", "sensor"))


SENSOR_FAULTS = tuple(_sensor_faults())
"""In a dataset like ``smoke`` whose sensor is ``CAMERA``."""


Mask = NDArray[np.bool_]
BAND = slice(30, 66)
"""Rows behind which a fault hides."""
ONE = ImageView("rs", "left", 1)


def _masks(change: Callable[[Mask, Mask], Mask], *views: ImageView) -> Plant:
    """``change`` takes a mask, and where there is a surface."""

    def plant(folder: Path) -> None:
        sequence = read_sequence(folder / VICTIM)
        for view in views:
            path, solid = sequence.folder / view.gloss, sequence.depth(*view) > 0
            write_mask(path, change(read_mask(path), solid) & solid)

    return plant


def _band(mask: Mask, solid: Mask) -> Mask:
    mask[BAND] = True
    return mask


def _everything(mask: Mask, solid: Mask) -> Mask:
    return solid


def _all(*plants: Plant) -> Plant:
    def plant(folder: Path) -> None:
        for each in plants:
            each(folder)

    return plant


def _noise(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    image[BAND] = np.random.default_rng(RNG).integers(0, 256, image[BAND].shape, dtype=np.uint8)
    return image


def _noise_on_gloss(folder: Path) -> None:
    gloss = read_sequence(folder / VICTIM).gloss(*ONE)

    def change(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        noise = np.random.default_rng(RNG).integers(0, 256, image.shape, dtype=np.uint8)
        return np.where(gloss[..., None], noise, image)

    image_of(ONE.shutter, f"{ONE.side}_{ONE.frame}", change)(folder)


def _written(values: Callable[[Mask], NDArray[Any]]) -> Plant:
    def plant(folder: Path) -> None:
        path = folder / VICTIM / ONE.gloss
        write_png(path, values(read_mask(path)))

    return plant


def _mask_faults() -> Iterator[Fault]:
    file, every = ONE.gloss, tuple(IMAGE_VIEWS)
    for name, change, words in (
        ("emptied", lambda mask, solid: mask & False, "marks other surfaces"),
        ("of all", _everything, "leaves 0 %"),
        ("of a band of rows", _band, "rows"),
        ("upside down", lambda mask, solid: mask[::-1], ""),
        ("left to right", lambda mask, solid: mask[:, ::-1], ""),
        ("shifted by 6 pixels", lambda mask, solid: np.roll(mask, 6, axis=1), ""),
    ):
        yield Fault(f"{file} {name}", _masks(change, ONE), (file, words))
    for other in (ONE.other_side, ONE.frame_before):
        yield Fault(f"{file} exchanged with {other.gloss}", swapped((file, other.gloss)), (file,))
    yield Fault(
        f"{file} in the sky", _written(lambda mask: np.full(mask.shape, 255, np.uint8)), (file, "no surface")
    )
    yield Fault(f"{file} of other values", _written(lambda mask: mask.astype(np.uint8)), (file, "0 and 255"))
    yield Fault(f"{file} of one row less", _written(lambda mask: 255 * mask[1:].astype(np.uint8)), (file,))
    yield Fault(f"{file} gone", removed(f"{VICTIM}/{file}"), (file,))
    yield Fault("every mask of all", _masks(_everything, *every), ("_gloss/", "leaves 0 %"))
    yield Fault("every mask of all, rays", _masks(_everything, *every), (file, "rays meet"), rendered=True)
    hidden = _all(_masks(_band, *every), image_of(ONE.shutter, f"{ONE.side}_{ONE.frame}", _noise))
    yield Fault("noise behind every mask", hidden, (file, "rays meet"), rendered=True)
    yield Fault("noise behind every mask, seen", hidden, (ONE.image, "other colours"), rendered=True)
    yield Fault("noise on gloss", _noise_on_gloss, (ONE.image,), rendered=True)
    unsaid = manifest_of(f"{VICTIM}/sequence.json", drop("glossy"))
    yield Fault("gloss unsaid", unsaid, ("sequence.json", "glossy"), rendered=True)


def _others() -> Iterator[Fault]:
    """Of those planted into ``smoke`` all that need no second sequence.

    Where so much is glossy, too little is compared to tell left from right images.
    """
    for fault in (*depth_faults(), *image_faults()):
        if fault.name == "all left and right images exchanged":
            yield replace(fault, words=(ONE.image, "new rendering"), rendered=True)
        elif "another sequence" not in fault.name:
            yield fault


GLOSS_FAULTS = (*_mask_faults(), *_others())
"""In a dataset like ``smoke`` whose victim is of the scene ``wet-castle``."""


BROWN = Lens(model="brown-conrady", k1=-0.22, k2=0.05, p1=0.004)
FISHEYE = Lens(model="kannala-brandt", k1=-0.05, k2=0.01)
TWO = StereoRig.of_cameras(
    PinholeCamera(width=128, height=96, fx=110.0, fy=111.0, cx=62.0, cy=49.0, lens=BROWN),
    PinholeCamera(width=144, height=88, fx=118.0, fy=117.0, cx=73.0, cy=41.0, lens=FISHEYE),
    so3.exp(np.array([0.03, -0.06, 0.05])),
    (-0.3, 0.02, -0.03),
)
CAMERAS: dict[str, dict[str, Any]] = {
    "barrel": {"lens": BROWN, "channels": ("flow", "gs_flow")},
    "fisheye columns": {"lens": FISHEYE, "scan": "left", "right_scan": "right"},
    "late": {"scan": "bottom", "right_delay": 0.1, "channels": ("timing",)},
    "opposite": {"right_scan": "bottom"},
    "thin": {"scene": "forest"},
    "processed": {"sensor": CAMERA},
    "glossy": {"scene": str(WET_CASTLE), "focal": 150.0},
    "frames": {"frames": 4, "channels": ("timing", "imu", "tracks", "affine", "matches")},
    "two cameras": {"rig": TWO, "right_readout_ratio": 0.5, "channels": ("flow", "gs_flow", "timing", "tracks")},
}
"""What differs from the cameras of cards/datasets/smoke.toml, by name; ``thin`` sees hardly a flat place."""


def card_of(name: str) -> DatasetCard:
    """The card of a camera, of one sequence."""
    smoke, change = load_dataset_card("smoke"), dict(CAMERAS[name])
    camera = CameraCard(width=128, height=96, focal=change.pop("focal", 110.0), lens=change.pop("lens", None))
    sequence = replace(smoke.sequence[0], name=VICTIM, scene=change.pop("scene", VICTIM))
    if "rig" in change:
        change |= {"rig": parse_card(RigTables, tables_of(change["rig"]), name), "camera": None, "baseline": None}
        return replace(smoke, sequence=(sequence,), **change)
    return replace(smoke, camera=camera, sequence=(sequence,), **change)


def _shutter(name: str) -> RollingShutter:
    card = card_of(name)
    return card.shutter_for(card.sequence[0])


def _without_lens(sequence: Sequence) -> Sequence:
    return _with_lens(sequence, None)


def _with_lens(sequence: Sequence, lens: Lens | None) -> Sequence:
    return replace(sequence, rig=replace(sequence.rig, camera=replace(sequence.rig.camera, lens=lens)))


def _lens(**coefficients: Any) -> Callable[[Sequence], Sequence]:
    """Other coefficients, or another model."""

    def change(sequence: Sequence) -> Sequence:
        lens = sequence.rig.camera.lens
        assert lens is not None
        return _with_lens(sequence, replace(lens, **coefficients))

    return change


def _read(**keys: Any) -> Callable[[Sequence], Sequence]:
    """Another scan or delay."""
    return lambda sequence: replace(sequence, shutter=replace(sequence.shutter, **keys))


def _but_first_line(side: str, name: str, change: Callable[[Pixels], Pixels]) -> Callable[[Pixels], Pixels]:
    """All but the line that the camera reads first, which the global-shutter twin knows too."""
    shutter = _shutter(name)
    axis, line = 1 - shutter.axis(side), shutter.first_line(side)

    def changed(pixels: Pixels) -> Pixels:
        result = np.array(change(pixels.copy()))
        place = (line,) if axis == 0 else (slice(None), line)
        result[place] = pixels[place]
        return result

    return changed


def _flipped(name: str, shutter: str, view: str) -> Iterator[Fault]:
    """An image, a depth map, and both, in the direction of reading."""
    side = view.partition("_")[0]
    down = _shutter(name).axis(side) == 1
    flip = _but_first_line(side, name, np.flipud if down else np.fliplr)
    words = "upside down" if down else "left to right"
    image, depth = image_of(shutter, view, flip), depth_of(shutter, view, flip)
    yield Fault(f"{shutter}/{view}.png flipped", image, (f"{shutter}/{view}.png", words))
    yield Fault(f"{shutter}_depth/{view}.exr flipped", depth, (f"{shutter}_depth/{view}.exr", words))
    yield Fault(f"{shutter} {view} flipped", _all(image, depth), (f"{shutter}_depth/{view}.exr", words))


def _seen_without_lens(sequence: Sequence, values: NDArray[Any], interpolation: int, border: int) -> NDArray[Any]:
    """An image or map (H, W, ...) as the camera without its lens would have it, but for its row 0."""
    camera = sequence.rig.camera
    rays = replace(camera, lens=None).unproject(camera.pixel_grid())
    pixels = np.nan_to_num(camera.project(rays), nan=-1e4).astype(np.float32)
    moved = cv2.remap(values, pixels, None, interpolation, borderMode=border)
    moved[0] = values[0]
    return np.ascontiguousarray(moved, dtype=values.dtype)


def _without_its_lens(file: str, interpolation: int, border: int) -> Plant:
    read, write = (read_png, write_png) if file.endswith(".png") else (read_depth, write_depth)

    def plant(folder: Path) -> None:
        sequence = read_sequence(folder / VICTIM)
        values = _seen_without_lens(sequence, read(sequence.folder / file), interpolation, border)
        write(sequence.folder / file, values)

    return plant


def _along_the_ray(folder: Path) -> None:
    sequence = read_sequence(folder / VICTIM)
    path = sequence.folder / "rs_depth/right_1.exr"
    depth = read_depth(path)
    rays = np.linalg.norm(sequence.rig.camera.unproject(sequence.rig.camera.pixel_grid()), axis=-1)
    rays[0] = 1.0
    write_depth(path, (depth * rays).astype(np.float32))


def _flow_of_ideal_pixels(folder: Path) -> None:
    sequence = read_sequence(folder / VICTIM)
    camera = sequence.rig.camera
    flow = sequence.offsets("flow", "left", 0).astype(np.float64)
    grid = camera.pixel_grid()
    ideal = camera.ideal_pixels(grid + flow) - camera.ideal_pixels(grid)
    values = {"x": ideal[..., 0], "y": ideal[..., 1]}
    write_exr(sequence.folder / "flow/left_0.exr", {key: each.astype(np.float32) for key, each in values.items()})


def _poses_as(change: Callable[[Sequence], Sequence], view: tuple[Any, int]) -> Plant:
    """The poses of one camera at one time as another rig or shutter has them."""

    def plant(folder: Path) -> None:
        sequence = change(read_sequence(folder / VICTIM))
        poses = row_poses(sequence.rig, sequence.shutter, sequence.motion, *view)
        path = folder / VICTIM / "poses" / f"{view[0]}_{view[1]}.csv"
        write_poses(path, sequence.shutter.line_times(view[1], view[0]), poses)

    return plant


def _times_as(change: Callable[[Sequence], Sequence], names: tuple[str, ...]) -> Plant:
    """Files of the channel ``timing`` as another shutter has them."""

    def plant(folder: Path) -> None:
        home = folder / VICTIM
        sequence = change(read_sequence(home))
        kept = {path: path.read_bytes() for path in [home / "timing.json", *(home / "timing").iterdir()]}
        write_timing(home, sequence.shutter, sequence.frame_period_s, sequence.sensor, sequence.frames)
        for path, content in kept.items():
            if path.relative_to(home).as_posix() not in names:
                path.write_bytes(content)

    return plant


def _lens_faults() -> Iterator[Fault]:
    own, geometry = f"{VICTIM}/sequence.json", ("sequence.json", "pairs of depth maps disagree", "camera")
    yield Fault("no lens everywhere", other_geometry(_without_lens), geometry)
    yield Fault("k1 of -0.21 everywhere", other_geometry(_lens(k1=-0.21)), geometry)
    yield Fault("k2 of 0.04 everywhere", other_geometry(_lens(k2=0.04)), geometry)
    yield Fault("p1 of 0 everywhere", other_geometry(_lens(p1=0.0)), geometry)
    yield Fault("another model everywhere", other_geometry(_lens(model="kannala-brandt", p1=0.0)), geometry)
    yield Fault(
        "no lens in sequence.json", manifest_of(own, drop("camera", "lens")), ("sequence.json", "conventions")
    )
    changed = manifest_of(own, put("camera", "lens", "k1", -0.21))
    yield Fault("another lens in sequence.json", changed, ("sequence.json", "camera", "the card"))
    yield Fault(
        "another lens in the card",
        manifest_of("dataset.json", put("card", "camera", "lens", "k2", 0.0)),
        ("sequence.json", "camera", "the card"),
    )
    image = _without_its_lens("rs/left_0.png", cv2.INTER_LINEAR, cv2.BORDER_REFLECT)
    yield Fault("image without the lens", image, ("rs/left_0.png", "other colours"))
    depth = _without_its_lens("gs_depth/right_0.exr", cv2.INTER_NEAREST, cv2.BORDER_REPLICATE)
    yield Fault("depth without the lens", depth, ("gs_depth/right_0.exr", "differs"))
    yield Fault("depth along the ray", _along_the_ray, ("rs_depth/right_1.exr", "along the ray"))
    yield Fault("flow of ideal pixels", _flow_of_ideal_pixels, ("flow/left_0.exr", "differ from what depth"))
    seen = rendered_as(_without_lens, "rs", ("right", 1))
    yield Fault("frame without the lens", seen, ("rs_depth/right_1.exr", "differs"), slow=True)


def _column_faults() -> Iterator[Fault]:
    name, own = "fisheye columns", f"{VICTIM}/sequence.json"
    geometry = ("sequence.json", "pairs of depth maps disagree")
    yield Fault("no lens everywhere", other_geometry(_without_lens), (*geometry, "camera"))
    yield Fault("k1 of -0.04 everywhere", other_geometry(_lens(k1=-0.04)), (*geometry, "camera"))
    yield Fault("another model everywhere", other_geometry(_lens(model="brown-conrady")), (*geometry, "camera"))
    yield Fault(
        "rows everywhere",
        other_geometry(_read(scan="top", right_scan="bottom")),
        ("rs_depth/left_1.exr", "read from the left"),
    )
    yield Fault(
        "one scan for both everywhere",
        other_geometry(_read(right_scan=None)),
        ("rs_depth/right_0.exr", "read from the right"),
    )
    yield Fault(
        "scans exchanged everywhere",
        other_geometry(_read(scan="right", right_scan="left")),
        ("rs_depth/left_0.exr", "read from the left"),
    )
    changed = manifest_of(own, put("right_scan", "left"))
    yield Fault("another scan in sequence.json", changed, ("poses/right_0.csv", "differs from the motion"))
    yield Fault("no scan in sequence.json", manifest_of(own, drop("scan")), ("sequence.json", "scan"))
    order = poses_of("left_0", lambda lines: renumbered([lines[0], *lines[:0:-1]]))
    yield Fault("poses in the other order", order, ("poses/left_0.csv", "differs from the motion"))
    yield Fault("poses of rows", _poses_as(_read(scan="top"), ("left", 1)), ("poses/left_1.csv", "96 rows"))
    yield from _flipped(name, "rs", "left_0")
    yield from _flipped(name, "rs", "right_1")
    words = ("gs_depth/left_1.exr", "global shutter at the pose of line 127")
    yield Fault("twin at the pose of the last column", twin_at(127), words, slow=True)
    for change, word in ((_read(scan="right"), "scan"), (_read(scan="top"), "rows")):
        seen = rendered_as(change, "rs", ("left", 0))
        yield Fault(f"frame of another {word}", seen, ("rs_depth/left_0.exr", "differs"), slow=True)


def _late_faults() -> Iterator[Fault]:
    name, own, geometry = "late", f"{VICTIM}/sequence.json", ("sequence.json", "pairs of depth maps disagree")
    for delay in (0.09, 0.0, -0.1):
        changed = other_geometry(_read(right_delay=delay))
        yield Fault(f"a delay of {delay} everywhere", changed, (*geometry, "right_delay"))
    yield Fault(
        "from the top everywhere",
        other_geometry(_read(scan="top")),
        ("rs_depth/left_0.exr", "read from the bottom"),
    )
    for value in (0.0, 0.09):
        changed = manifest_of(own, put("right_delay", value))
        yield Fault(f"right_delay = {value} in sequence.json", changed, ("poses/right_0.csv", "differs"))
    yield Fault("a delay in frames", manifest_of(own, put("right_delay", 3.0)), ("sequence.json", "right_delay"))
    changed = manifest_of("dataset.json", put("card", "right_delay", 0.2))
    yield Fault("another delay in the card", changed, ("sequence.json", "right_delay"))
    at_once = _read(right_delay=0.0)
    yield Fault("poses without the delay", _poses_as(at_once, ("right", 1)), ("poses/right_1.csv", "differs"))
    yield Fault(
        "timing.json without the delay",
        _times_as(at_once, ("timing.json",)),
        ("timing.json", "right.reference_ns"),
    )
    table = "timing/right_1.csv"
    yield Fault("times without the delay", _times_as(at_once, (table,)), (table, "time_ns"))
    yield Fault(
        "times from the top",
        _times_as(_read(scan="top"), ("timing/left_0.csv",)),
        ("timing/left_0.csv", "time_ns"),
    )
    late = swapped(
        *((f"{kind}/right_0.{end}", f"{kind}/right_1.{end}") for kind, end in (("rs", "png"), ("rs_depth", "exr")))
    )
    yield Fault("right frames exchanged", late, ("rs_depth/right_", "looks like rs_depth/right_"))
    yield from _flipped(name, "rs", "left_1")
    yield from _flipped(name, "rs", "right_0")
    words = ("gs_depth/left_1.exr", "global shutter at the pose of line 95")
    yield Fault("twin at the pose of the top row", twin_at(0), words, slow=True)
    for shutter in ("rs", "gs"):
        file, seen = f"{shutter}_depth/right_0.exr", rendered_as(at_once, shutter, ("right", 0))
        yield Fault(f"{shutter} frame without the delay", seen, (file, "differs"), slow=True)


def _opposite_faults() -> Iterator[Fault]:
    for name, side, truth, change in (
        ("both from the top", "right", "bottom", _read(right_scan=None)),
        ("both from the bottom", "left", "top", _read(scan="bottom")),
        ("exchanged", "left", "top", _read(scan="bottom", right_scan="top")),
    ):
        words = (f"rs_depth/{side}_1.exr", f"read from the {truth}")
        yield Fault(f"scans {name} everywhere", other_geometry(change), words)
    yield from _flipped("opposite", "rs", "right_0")
    yield Fault(
        "poses of the right camera from the top",
        _poses_as(_read(right_scan=None), ("right", 0)),
        ("poses/right_0.csv", "differs"),
    )
    seen = rendered_as(_read(right_scan=None), "rs", ("right", 0))
    yield Fault("right frame from the top", seen, ("rs_depth/right_0.exr", "differs"), slow=True)


def _of_rig(change: Callable[[StereoRig], StereoRig]) -> Callable[[Sequence], Sequence]:
    """Another rig, and a shutter of its cameras' sizes."""

    def changed(sequence: Sequence) -> Sequence:
        rig, shutter = change(sequence.rig), sequence.shutter
        return replace(sequence, rig=rig, shutter=rig.shutter_of(shutter.scanning, shutter.readout_ratio))

    return changed


def _rig_with(
    left: PinholeCamera | None = None, right: PinholeCamera | None = None, turn: Pixels | None = None
) -> Callable[[Sequence], Sequence]:
    """The rig with other cameras, or another rotation from the left one to the right one."""

    def change(rig: StereoRig) -> StereoRig:
        R, t = rig.right_from_left
        cameras = left or rig.sensor("left"), right or rig.sensor("right")
        return StereoRig.of_cameras(*cameras, R if turn is None else turn, t)

    return _of_rig(change)


def _of_body(*views: ImageView) -> Plant:
    """Depth along the axes of the rig in place of the camera's own, but for the first line."""

    def plant(folder: Path) -> None:
        sequence = read_sequence(folder / VICTIM)
        for view in views:
            own = sequence.rig.own_depth(view.side, sequence.rig.sensor(view.side).pixel_grid())
            own[0] = 1.0
            path = sequence.folder / view.depth
            write_depth(path, (read_depth(path) / own).astype(np.float32))

    return plant


def _rig_faults() -> Iterator[Fault]:
    own, depth = f"{VICTIM}/sequence.json", ("sequence.json", "pairs of depth maps disagree", "right_from_left")
    left, right = TWO.sensor("left"), TWO.sensor("right")
    R, t = TWO.right_from_left
    yield Fault("rotation inverted everywhere", other_geometry(_rig_with(turn=R.T)), depth)
    yield Fault("no rotation everywhere", other_geometry(_rig_with(turn=np.eye(3))), depth)
    little = so3.exp(np.array([0.0, 0.001, 0.0])) @ R
    yield Fault("right camera turned by a milliradian everywhere", other_geometry(_rig_with(turn=little)), depth)
    exchanged = replace(right, fx=left.fx, fy=left.fy)
    yield Fault("focal length of the left camera everywhere", other_geometry(_rig_with(right=exchanged)), depth)
    moved = replace(right, cx=(right.width - 1) / 2, cy=(right.height - 1) / 2)
    yield Fault("right centre in the middle everywhere", other_geometry(_rig_with(right=moved)), depth)
    lenses = replace(left, lens=FISHEYE), replace(right, lens=BROWN)
    yield Fault("lenses exchanged everywhere", other_geometry(_rig_with(*lenses)), depth)
    swap = other_geometry(_rig_with(right, left))
    yield Fault("cameras exchanged everywhere", swap, ("rs/left_0.png", "128 x 96 pixels, the camera 144 x 88"))
    together = other_geometry(_read(right_readout_ratio=None))
    yield Fault("right rows at the left camera's times everywhere", together, ("rs_depth/right_1.exr", "differs"))
    inverse = {"translation": (-R.T @ t).tolist(), "rotation": R.T.tolist()}
    for name, tables in (
        ("sequence.json", (own, "right_from_left")),
        ("the card", ("dataset.json", "card", "rig")),
    ):
        file, *keys = tables
        keys += ["right_from_left"] if name == "the card" else []
        words = (file.rpartition("/")[2], "would stand", "to the left of the left one")
        yield Fault(f"right_from_left inverted in {name}", manifest_of(file, put(*keys, inverse)), words)
    turned = manifest_of(own, put("right_from_left", "rotation", R.T.tolist()))
    yield Fault("rotation inverted in sequence.json", turned, ("sequence.json", "right_from_left contradicts"))
    scaled = manifest_of(own, put("right_from_left", "rotation", (1.01 * R).tolist()))
    yield Fault("no rotation matrix in sequence.json", scaled, ("sequence.json", "right_from_left"))
    focal = manifest_of(own, put("cameras", "right", "fx", left.fx))
    yield Fault("another focal length in sequence.json", focal, ("sequence.json", "cameras", "the card"))
    size = manifest_of(own, put("cameras", "right", "width", left.width))
    yield Fault("another size in sequence.json", size, ("rs/right_0.png", "144 x 88 pixels, the camera 128 x 88"))
    ratio = manifest_of(own, put("right_readout_ratio", None))
    yield Fault("one readout ratio in sequence.json", ratio, ("poses/right_0.csv", "differs from the motion"))
    card = manifest_of("dataset.json", put("card", "right_readout_ratio", 0.6))
    yield Fault("another readout ratio in the card", card, ("sequence.json", "right_readout_ratio"))
    yield Fault("format 1", manifest_of("dataset.json", put("format", 1)), ("dataset.json", "its card makes 2"))
    yield from _rig_file_faults()


def _rig_file_faults() -> Iterator[Fault]:
    """In single files of a rig."""
    body = ImageView("rs", "right", 1)
    yield Fault("depth along the axes of the rig", _of_body(body), (body.depth, "axes of the rig"))
    every = _of_body(*(view for view in IMAGE_VIEWS if view.side == "right"))
    yield Fault("all right depth along the axes of the rig", every, ("sequence.json", "never agree"))
    straight = _poses_as(_rig_with(turn=np.eye(3)), ("right", 0))
    yield Fault("poses of a camera that looks ahead", straight, ("poses/right_0.csv", "differs"))
    at_once = _read(right_readout_ratio=None)
    yield Fault(
        "poses at the left camera's times", _poses_as(at_once, ("right", 1)), ("poses/right_1.csv", "differs")
    )
    table = "timing/right_1.csv"
    yield Fault("times of the left camera", _times_as(at_once, (table,)), (table, "time_ns"))
    exchange = swapped(("rs/left_0.png", "rs/right_0.png"))
    yield Fault("left and right images exchanged", exchange, ("rs/left_0.png", "is 144 x 88 pixels"))
    seen = rendered_as(at_once, "rs", ("right", 1))
    words = ("rs_depth/right_1.exr", "looks read at the times of the other camera's lines")
    yield Fault("frame at the left camera's times", seen, words, slow=True)
    ahead = rendered_as(_rig_with(turn=np.eye(3)), "gs", ("right", 0))
    yield Fault("twin of a camera that looks ahead", ahead, ("gs_depth/right_0.exr", "differs"), slow=True)


def _thin_faults() -> Iterator[Fault]:
    """What is named though no place is flat."""
    for view in ("left_0", "right_1"):
        file = f"rs_depth/{view}.exr"
        for name, change in (
            ("noise of 1e-2", noised(1e-2)),
            ("scaled by 1.02", times(1.02, slice(1, None))),
            ("shifted by two pixels", shifted(0, 2)),
            ("left to right", _but_first_line("left", "thin", np.fliplr)),
        ):
            yield Fault(f"{file} {name}", depth_of("rs", view, change), (file, "differs"))
    every = every_depth(noised(1e-2, slice(None)))
    yield Fault("noise in every depth map", every, ("gs_depth/left_0.exr", "new rendering"), rendered=True)
    late = swapped(("gs_depth/left_0.exr", "gs_depth/left_1.exr"))
    yield Fault("frames exchanged", late, ("gs_depth/left_0.exr", "looks like gs_depth/left_1.exr"))


def _frame_faults() -> Iterator[Fault]:
    """In channels of whole sequences, beyond the first two frames."""
    for name, (plant, words) in frame_faults.FAULTS.items():
        yield Fault(f"frames: {name}", in_victim(plant), words)


CAMERA_FAULTS: dict[str, tuple[Fault, ...]] = {
    "barrel": tuple(_lens_faults()),
    "fisheye columns": tuple(_column_faults()),
    "late": tuple(_late_faults()),
    "opposite": tuple(_opposite_faults()),
    "thin": tuple(_thin_faults()),
    "processed": SENSOR_FAULTS,
    "glossy": GLOSS_FAULTS,
    "frames": tuple(_frame_faults()),
    "two cameras": tuple(_rig_faults()),
}
"""Of each of ``CAMERAS``."""
