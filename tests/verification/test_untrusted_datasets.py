"""What a dataset of somebody else may say: names and links that lead out, wrong types, files that unfold."""

from __future__ import annotations

import contextlib
import io
import json
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from analytic_dataset import write_analytic_dataset
from commands import run_here
from PIL import Image

from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.dataset.sequence import read_dataset, read_dataset_manifest
from rsbench.storage.files import read_depth, write_bytes, write_depth, write_json
from rsbench.storage.untrusted_files import read_bytes
from rsbench.verification import verify_dataset

RIG = StereoRig(camera=PinholeCamera.centred(24, 16, 20.0), baseline=0.3)


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    folder = tmp_path / "data"
    write_analytic_dataset(
        folder, RIG, RollingShutter(height=16, readout_ratio=0.9), LinearMotion([0, 0, 0], [1, 0, 0])
    )
    return folder


def change(path: Path, field: str, value: object) -> None:
    """Set a field of a JSON file, by its dotted name; ``...`` removes it."""
    content = json.loads(path.read_text())
    *parents, last = field.split(".")
    table = content
    for key in parents:
        table = table[key]
    if value is ...:
        del table[last]
    else:
        table[last] = value
    path.write_text(json.dumps(content))


def refusal(read: Callable[[], Any]) -> str:
    with pytest.raises(RsbenchError) as caught:
        read()
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    ("sequences", "message"),
    [
        (["../other"], "name = '../other': must be a folder's name"),
        (["/tmp"], "name = '/tmp': must be a folder's name"),
        ([".."], "must be a folder's name"),
        (["a\\b"], "must be a folder's name"),
        (["planes\n"], "must be a folder's name"),
        (["x" * 200], "must be a folder's name"),
        (["planes", "planes"], "'planes' is listed twice"),
        ([], "sequences = []: must name at least one"),
        ([7], "sequences.0 = 7: input should be a valid string"),
        ("planes", "sequences = 'planes': input should be a valid array"),
        (..., "'sequences' is required"),
    ],
)
def test_names_of_sequences_lead_nowhere_else(dataset: Path, sequences: object, message: str) -> None:
    path = dataset / "dataset.json"
    change(path, "sequences", sequences)
    found = refusal(lambda: read_dataset(dataset))
    assert found.startswith(f"{path}: ") and message in found


def test_a_name_that_is_not_the_folders_is_refused(dataset: Path) -> None:
    victim = dataset.parent / "victim"
    for name in (str(victim), "../victim", "victim"):
        change(dataset / "planes/sequence.json", "name", name)
        assert f"name = {name!r}: must be" in refusal(lambda: read_dataset(dataset))


@pytest.mark.parametrize("name", ["planes", "planes/sequence.json", "planes/rs", "planes/rs/left_0.png"])
def test_links_that_lead_out_of_the_dataset_are_refused(dataset: Path, name: str) -> None:
    inner = dataset / name
    outer = dataset.parent / "outer"
    inner.rename(outer)
    inner.symlink_to(outer)
    found = refusal(lambda: read_dataset(dataset)[0].image("rs", "left", 0))
    assert "leads out of the folder; copy" in found


def _as_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def _as_link_to_a_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path.with_name("pipe"))
    path.symlink_to("pipe")


def _as_socket(path: Path) -> None:
    path.unlink()
    with contextlib.chdir(path.parent), socket.socket(socket.AF_UNIX) as bound:  # a name of 108 bytes at most
        bound.bind(path.name)


def _as_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("make", [_as_pipe, _as_link_to_a_pipe, _as_socket, _as_folder])
@pytest.mark.parametrize(
    "name",
    [
        *("dataset.json", "planes/sequence.json", "planes/poses/left_0.csv", "planes/rs/left_0.png"),
        *("planes/rs_depth/left_0.exr", "planes/gs/right_1.png"),
    ],
)
def test_files_of_a_dataset_are_regular(dataset: Path, name: str, make: Callable[[Path], None]) -> None:
    """A named pipe that nobody writes to ends no read, and a test that waits for it ends at no time."""
    make(dataset / name)
    ran = run_here("verify", str(dataset), "--rerender", "no")
    assert ran.returncode in (1, 2) and name.rpartition("/")[2] in ran.stdout + ran.stderr
    assert "Traceback" not in ran.stdout + ran.stderr


@pytest.mark.skipif(not Path("/dev/stdin").exists(), reason="needs /dev/stdin")
def test_what_a_process_has_open_is_read(dataset: Path) -> None:
    """Problems come through pipes of a shell as before; a named pipe is refused in one line."""
    answer = subprocess.run(
        [sys.executable, "-c", "import sys, pathlib as p, rsbench.storage.untrusted_files as u;"
         "sys.stdout.buffer.write(u.read_bytes(p.Path('/dev/stdin')))"],
        input=b"x" * 300_000, capture_output=True, check=True,
    )  # fmt: skip
    assert answer.stdout == b"x" * 300_000
    os.mkfifo(dataset / "pipe")
    assert "it is a named pipe; give a regular file" in refusal(lambda: read_bytes(dataset / "pipe"))


@pytest.mark.skipif(not os.access("/dev/shm", os.W_OK), reason="needs /dev/shm")
def test_a_folder_below_dev_holds_files_of_anybody() -> None:
    """In memory, where datasets lie for speed, a pipe is refused as elsewhere."""
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        os.mkfifo(pipe := Path(folder) / "poses.csv")
        assert refusal(lambda: read_bytes(pipe)) == (
            f"{pipe}: cannot be read: it is a named pipe; give a regular file"
        )


@pytest.mark.slow
def test_sequences_that_are_not_there_are_counted(dataset: Path) -> None:
    """As many lines for 300 000 names as for 300, in a time that does not grow with their square."""
    names = [f"s{number}" for number in range(300_000)]
    change(dataset / "dataset.json", "sequences", ["planes", *names])
    lines = [line for report in verify_dataset(dataset) for line in report.faults]
    missing = [line for line in lines if "missing: no such folder in the dataset" in line]
    assert len(missing) == 100 and missing[0].startswith("s0/: ") and len(lines) < 110
    assert missing[-1].endswith("; 299900 more sequences of dataset.json are missing likewise")
    change(dataset / "dataset.json", "sequences", ["planes", *(f"../{name}" for name in names)])
    lines = [line for report in verify_dataset(dataset) for line in report.faults]
    assert any("not the name of a folder in it: '../s0', '../s1'" in line for line in lines) and len(lines) < 10


@pytest.mark.parametrize("what", ["empty", "pipe", "no JSON"])
def test_a_sequence_that_cannot_be_read_is_one_fault(dataset: Path, what: str) -> None:
    """Not one for each file that it might have had."""
    names = [f"s{number}" for number in range(150)]
    for name in names:
        (dataset / name).mkdir()
        if what == "pipe":
            os.mkfifo(dataset / name / "sequence.json")
        elif what == "no JSON":
            (dataset / name / "sequence.json").write_text("{")
    change(dataset / "dataset.json", "sequences", ["planes", *names])
    reports = verify_dataset(dataset)
    found = {report.name: report.faults for report in reports if report.name in names}
    assert {len(faults) for faults in found.values()} == {1}
    assert len(found) == (100 if what == "empty" else 150)
    if what == "empty":
        assert found["s99"][0].endswith("; 50 more sequences of dataset.json are missing likewise")


def test_files_that_are_not_there_are_counted(dataset: Path) -> None:
    """A manifest may list any number of them; two faults each, for sequence.json does not list them either."""
    files = json.loads((dataset / "dataset.json").read_text())["files"]
    more = {f"planes/{number}.png": {"sha256": "0" * 64, "size": 1} for number in range(2000)}
    change(dataset / "dataset.json", "files", files | more)
    faults = next(report.faults for report in verify_dataset(dataset) if report.name == "planes")
    assert len(faults) == 1001 and faults[-1] == "planes/: 3000 more faults of this sequence"


def test_faults_move_no_cursor(dataset: Path) -> None:
    """Names of a stranger's manifest are shown as text."""
    files = json.loads((dataset / "dataset.json").read_text())["files"]
    strange: dict[str, dict[str, object]] = {
        "planes/\x1b[2J\x07.png": {"sha256": "0" * 64, "size": 1},
        "x\x9b\r.png": {},
    }
    change(dataset / "dataset.json", "files", files | strange)
    ran = run_here("verify", dataset, "--rerender", "no")
    assert r"planes/\x1b[2J\x07.png: missing" in ran.stderr and r"none of its sequences: x\x9b\r.png" in ran.stderr
    assert "\x07" not in ran.stderr and "\x9b" not in ran.stderr


def test_links_within_a_dataset_are_followed(dataset: Path) -> None:
    path = dataset / "planes/rs/left_0.png"
    path.rename(dataset / "planes/kept.png")
    path.symlink_to("../kept.png")
    assert read_dataset(dataset)[0].image("rs", "left", 0).shape == (16, 24, 3)
    path.unlink()
    path.symlink_to(path)
    assert "leads out" in refusal(lambda: read_dataset(dataset)[0].image("rs", "left", 0))


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("name", 3, "name = 3: input should be a valid string"),
        ("name", ..., "'name' is required"),
        ("conventions", 2, "conventions = 2"),
        ("format", True, "format = True"),
        ("format", 2, "'cameras' is required"),
        ("camera", [], "camera = []"),
        ("camera.height", ..., "'camera.height' is required"),
        ("camera.width", "24", "camera.width = '24'"),
        ("camera.width", 2_000_000_000, "camera width = 2000000000"),
        ("camera.fx", float("nan"), "camera.fx = nan: numbers must be finite"),
        ("baseline", -1.0, "baseline = -1.0: must be a positive"),
        ("readout_ratio", 1.5, "readout_ratio = 1.5: must be a number from 0 to 1"),
        ("frame_period_s", 0, "frame_period_s = 0.0: must be positive"),
        ("row_time_s", {}, "row_time_s = {}"),
        ("motion", "linear", "motion = 'linear'"),
        ("motion.model", "warp", "'warp'"),
        ("motion.model", "..:x", "motion model = '..:x': must be 'package.module:Class'"),
        ("motion.w", [0, 0], "motion.w"),
        ("motion.w", [0, 0, 1e999], "motion.w.2 = inf: numbers must be finite"),
        ("motion.parameters", {"k": 1}, "unknown parameter 'k'"),
        ("files", ["a"], "files = ['a']"),
        ("files", {"rs/left_0.png": 3}, "files.rs/left_0.png = 3"),
    ],
)
def test_each_wrong_field_of_a_sequence_is_named(dataset: Path, field: str, value: object, message: str) -> None:
    path = dataset / "planes/sequence.json"
    change(path, field, value)
    found = refusal(lambda: read_dataset(dataset))
    assert found.startswith(f"{path}: ") and message in found


@pytest.mark.parametrize(
    "content", [b"", b"[]", b"null", b"\xff", b"{", b'{"format": ' + b"9" * 5000 + b"}", b"[" * 100_000]
)
def test_manifests_that_are_no_objects_are_refused(dataset: Path, content: bytes) -> None:
    for path in (dataset / "dataset.json", dataset / "planes/sequence.json"):
        before = path.read_bytes()
        path.write_bytes(content)
        assert refusal(lambda: read_dataset(dataset)).startswith(f"{path}: ")
        path.write_bytes(before)


def test_parameters_nested_too_deep_are_refused(dataset: Path) -> None:
    deep: list[Any] = []
    for _ in range(500):
        deep = [deep]
    change(dataset / "planes/sequence.json", "motion.parameters", {"poses": deep})
    assert "nested more than" in refusal(lambda: read_dataset(dataset))


def test_a_dataset_runs_no_code_that_lies_in_the_current_folder(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "planted_module.py").write_text("raise SystemExit('run')")
    monkeypatch.chdir(tmp_path)
    change(dataset / "planes/sequence.json", "motion.model", "planted_module:Motion")
    assert "No module named 'planted_module'" in refusal(lambda: read_dataset(dataset))


def test_a_reader_passes_over_keys_of_later_versions(dataset: Path) -> None:
    for path in (dataset / "dataset.json", dataset / "planes/sequence.json"):
        change(path, "flow", {"of": "tomorrow"})
    assert [sequence.name for sequence in read_dataset(dataset)] == ["planes"]


@pytest.mark.parametrize(
    ("record", "message"),
    [("x", "= 'x'"), ({"sha256": "x"}, "size' is required"), ({"sha256": "x", "size": "1"}, "size = '1'")],
)
def test_wrong_records_of_files_are_named(dataset: Path, record: object, message: str) -> None:
    change(dataset / "dataset.json", "files", {"planes/a": record})
    assert message in refusal(lambda: read_dataset_manifest(dataset))


# Sizes


def test_an_image_of_another_size_is_refused_before_it_is_decoded(dataset: Path) -> None:
    path = dataset / "planes/rs/left_0.png"
    Image.new("RGB", (4000, 3000)).save(path)
    found = refusal(lambda: read_dataset(dataset)[0].image("rs", "left", 0))
    assert found == f"{path}: is 4000 x 3000 pixels, the camera 24 x 16"
    path.write_bytes(path.read_bytes()[:100])  # there is nothing to decode
    assert refusal(lambda: read_dataset(dataset)[0].image("rs", "left", 0)) == found


def test_a_depth_map_of_another_size_or_kind_is_refused(dataset: Path) -> None:
    path = dataset / "planes/rs_depth/left_0.exr"

    def read() -> None:
        read_dataset(dataset)[0].depth("rs", "left", 0)

    write_depth(path, np.ones((30, 40), np.float32))
    assert refusal(read) == f"{path}: is 40 x 30 pixels, the camera 24 x 16"
    z = np.ones((16, 24), np.float32)
    for channels in ({"Y": z}, {"Z": z, "A": z}):
        _write_exr(path, OpenEXR.scanlineimage, channels)
        assert "one channel, Z" in refusal(read)
    _write_exr(path, OpenEXR.scanlineimage, {"Z": z.astype(np.float16)})
    assert "must hold a float32 channel Z" in refusal(read)


def _write_exr(path: Path, kind: Any, channels: dict[str, Any]) -> None:
    content = io.BytesIO()
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": kind}, channels) as file:
        file.write(content)
    path.write_bytes(content.getvalue())


# A full disk


def test_what_does_not_fit_is_one_line_and_leaves_what_was_there(tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    import signal

    path, depth = tmp_path / "z.exr", np.random.default_rng(0).random((50, 60), dtype=np.float32)
    write_depth(path, depth)
    before = path.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    heard = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
        found = [
            refusal(lambda: write_depth(path, 2 * depth)),
            refusal(lambda: write_json(path, {"a": "b" * 5000})),
        ]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, heard)
    for message in found:
        assert message.startswith(f"{path}: cannot be written, ") and "bytes: File too large; make room" in message
    assert [file.name for file in tmp_path.iterdir()] == ["z.exr"] and path.read_bytes() == before
    np.testing.assert_array_equal(read_depth(path), depth)


def test_a_folder_that_is_gone_is_named(tmp_path: Path) -> None:
    path = tmp_path / "gone" / "x.json"
    assert refusal(lambda: write_bytes(path, b"1")).startswith(f"{path}: cannot be written, 1 bytes: No such file")
