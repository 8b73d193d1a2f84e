"""What the Rerun viewer gets, read back by rerun; and refusals, which need no rerun."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run_here
from exported_data import dataset, only

from rsbench.core.so3 import FloatArray
from rsbench.interop.writers.match_colours import Scene, Strips, found_strips, line_seconds
from rsbench.interop.writers.sequence_views import View

NEEDS_RERUN = pytest.mark.skipif(find_spec("rerun") is None, reason="rerun is not installed: rsbench[view]")

MOVED = ("time", "Transform3D:translation", "Transform3D:quaternion")


def read_back(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Columns of every chunk by entity."""
    from rerun.chunk import RrdReader

    found = dict[str, list[dict[str, Any]]]()
    for chunk in RrdReader(str(path)).stream():
        found.setdefault(chunk.entity_path, []).append(chunk.to_record_batch().to_pydict())
    return found


def numbers(rows: Any, *shape: int) -> FloatArray:
    return np.array(rows, dtype=np.float64).reshape(*shape)


@pytest.mark.parametrize("scan", ["top", "right"])
@NEEDS_RERUN
def test_rerun_has_the_rig_its_lines_and_the_points(tmp_path: Path, scan: str) -> None:
    """Points go through the poses and the calibration that the file has, and land where the frame shows them."""
    from rsbench.interop.writers.rerun_scene import write_recording

    sequence = only(dataset(tmp_path / "data", scan=scan))
    strips = Strips("matches", View("left", 0), np.array([[[1.0, 2.0], [3.0, 4.0]]]), np.zeros((1, 3), np.uint8))
    write_recording(Scene(sequence, (strips,), 500), tmp_path / "out.rrd", lambda word: None)
    found = read_back(tmp_path / "out.rrd")
    (pinhole,) = [each for each in found["/world/left"] if "Pinhole:resolution" in each]
    K = numbers(pinhole["Pinhole:image_from_camera"], 3, 3).T  # columns first
    np.testing.assert_allclose(K, [[60, 0, 31], [0, 61, 25.5], [0, 0, 1]])
    moved = [each for each in found["/world/left"] if "Transform3D:translation" in each]
    times, places, turns = (np.concatenate([_column(each, name) for each in moved]) for name in MOVED)
    for frame in (0, 1):
        seconds = line_seconds(sequence, View("left", frame))
        (cloud,) = found[f"/world/points/left_{frame}"]
        world = numbers(cloud["Points3D:positions"], -1, 3)
        assert 300 < len(world) <= 500
        depth = sequence.depth("rs", "left", frame)
        lines = np.arange(len(seconds))
        at = np.argmin(np.abs(times - seconds[:, None]), axis=1)  # read as microseconds
        R, p = np.stack([_matrix(turns[k]) for k in at]), places[at]
        # A point is seen by the line at whose pose it lands on that line.
        X = np.einsum("lij,nlj->nli", R.transpose(0, 2, 1), world[:, None] - p)
        pixels = X @ K.T
        pixels = pixels[..., :2] / pixels[..., 2:] - 0.5
        axis = 0 if scan == "right" else 1
        line = np.argmin(np.abs(pixels[..., axis] - lines), axis=1)
        own = pixels[np.arange(len(world)), line]
        np.testing.assert_allclose(own, np.round(own), atol=2e-4)  # float32
        x, y = np.round(own).astype(int).T
        np.testing.assert_allclose(X[np.arange(len(world)), line, 2], depth[y, x], rtol=1e-6)
    drawn = [each for each in found["/frames/left/matches"] if "LineStrips2D:colors" in each]
    np.testing.assert_allclose(numbers(drawn[0]["LineStrips2D:strips"], 2, 2), [[1.5, 2.5], [3.5, 4.5]])
    (images,) = found["/frames/right/gs"]
    assert bytes(images["EncodedImage:blob"][1][0]) == (tmp_path / "data/planes/gs/right_1.png").read_bytes()


def _column(columns: dict[str, Any], name: str) -> FloatArray:
    values = columns[name]
    if name == "time":
        return np.array([value.total_seconds() for value in values])
    return numbers(values, len(values), -1)


def _matrix(row: Any) -> FloatArray:
    """Of a quaternion x, y, z, w."""
    x, y, z, w = numbers(row, 4)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * w * K + 2.0 * K @ K


@NEEDS_RERUN
def test_the_command_writes_a_file_or_nothing(tmp_path: Path) -> None:
    folder = dataset(tmp_path / "data")
    run = run_here("view", folder, "--save", tmp_path / "new" / "planes.rrd", "--points", 200)
    assert run.returncode == 0, run.stderr
    assert {path.name for path in (tmp_path / "new").iterdir()} == {"planes.rrd"}
    found = read_back(tmp_path / "new" / "planes.rrd")
    assert {"/frames/left/depth", "/world/lines/right_1", "/world/left/image"} <= set(found)
    run = run_here("view", folder, "--save", folder)
    assert run.returncode == 2 and "is a folder" in run.stderr
    run = run_here("view", folder, "--sequence", "castle", "--save", tmp_path / "x.rrd")
    assert run.returncode == 2 and "no such sequence" in run.stderr


def test_without_rerun_or_a_screen_one_line_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    run = run_here("view", dataset(tmp_path / "data"))
    assert run.returncode == 2
    words = "there is no screen" if find_spec("rerun") else "rsbench[view]"
    assert words in run.stderr and run.stderr.count("\n") == 1


def test_matches_without_labels_are_those_of_the_matcher(tmp_path: Path) -> None:
    sequence = only(dataset(tmp_path / "data"))
    strips = list(found_strips(sequence, "sift"))
    assert [(each.name, each.view) for each in strips] == [
        ("matches", View("left", 0)),
        ("matches", View("right", 0)),
        ("stereo", View("left", 0)),
        ("stereo", View("left", 1)),
    ]
    assert all(each.pixels.shape == (len(each.colours), 2, 2) for each in strips)
