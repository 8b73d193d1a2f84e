"""``rsbench export``: what it says, what it refuses, and that nothing is half written."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import assert_refused, bytes_below, run_here
from exported_data import dataset, exported, only

from rsbench.cli.export import Target
from rsbench.core.rig import views_of
from rsbench.dataset.layout import moving_file
from rsbench.interop.writers.exporter import FORMATS
from rsbench.storage.files import read_json, write_json, write_png


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return dataset(tmp_path_factory.mktemp("made") / "data")


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_is_written_whole_and_again_the_same(made: Path, tmp_path: Path, name: str) -> None:
    result = run_here("export", made, "--to", name, "--out", tmp_path / "out")
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1] == f"{tmp_path / 'out'}: {name}; README.txt describes it"
    first = bytes_below(tmp_path / "out")
    record = read_json(tmp_path / "out/export.json")
    assert record["to"] == name and list(record["sequences"]) == ["planes"]
    notes = [f"planes: {sentence}" for sentence in record["sequences"]["planes"]["told"]]
    assert [f"note: {note}" for note in notes] == result.stdout.splitlines()[:-1]
    readme = first["README.txt"].decode()
    assert all(sentence in readme for sentence in [record["about"], *notes])
    assert run_here("--quiet", "export", made, "--to", name, "--out", tmp_path / "out").returncode == 0
    assert bytes_below(tmp_path / "out") == first
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_the_commands_formats_are_those_that_there_are() -> None:
    assert [str(target) for target in Target] == list(FORMATS)
    text = (Path(__file__).parents[2] / "docs/how-to/export.md").read_text("utf-8").partition("## ")[0]
    assert [line.split("`")[1] for line in text.splitlines() if line.startswith("| `")] == list(FORMATS)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--to", "colmap", "--sequence", "castle"], ["--sequence castle", "there are: planes"]),
        (["--to", "tum", "--images", "rs"], ["--images rs: tum takes no choice of images"]),
        (["--to", "euroc"], ["'--to'", "euroc"]),
    ],
)
def test_options_that_cannot_be_are_one_line(
    made: Path, tmp_path: Path, options: list[str], words: list[str]
) -> None:
    assert_refused(run_here("export", made, "--out", tmp_path / "out", *options), *words)
    assert not (tmp_path / "out").exists()


def test_what_is_no_dataset_and_an_out_of_others_are_refused(made: Path, tmp_path: Path) -> None:
    assert_refused(run_here("export", tmp_path, "--to", "tum", "--out", tmp_path / "out"), "not a dataset")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").write_text("mine")
    result = run_here("export", made, "--to", "tum", "--out", tmp_path / "mine")
    assert_refused(result, "exists and was not written by 'rsbench export'")
    assert bytes_below(tmp_path / "mine") == {"notes.txt": b"mine"}


def test_a_damaged_file_leaves_the_earlier_export(made: Path, tmp_path: Path) -> None:
    data = dataset(tmp_path / "data")
    assert run_here("export", data, "--to", "kitti", "--out", tmp_path / "out").returncode == 0
    before = bytes_below(tmp_path / "out")
    (data / "planes/gs_depth/left_1.exr").write_bytes(b"no image")
    result = run_here("export", data, "--to", "kitti", "--out", tmp_path / "out")
    assert_refused(result, "gs_depth/left_1.exr: damaged or not an EXR file")
    assert bytes_below(tmp_path / "out") == before
    assert not list(tmp_path.glob(".*"))


def test_torch_is_imported_by_its_own_module_alone() -> None:
    code = (
        "import sys; from rsbench.interop.writers import exporter; "
        "print([name for name in ('torch', 'evo', 'pycolmap', 'webdataset') if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_objects_that_move_are_told_of_and_are_no_points(tmp_path: Path) -> None:
    """Labels by hand: the left half of every picture is labelled as moving."""
    data = dataset(tmp_path / "data")
    thing = {
        "box": [1.0, 1.0, 1.0],
        "position": [0.0, 0.0, 3.0],
        "motion": {"model": "linear", "w": [0.0, 0.0, 0.0], "d": [0.1, 0.0, 0.0]},
    }
    path = data / "planes/sequence.json"
    write_json(path, read_json(path) | {"conventions": 4, "moving": [thing]})
    labels = np.zeros((49, 64), dtype=np.uint8)
    labels[:, :32] = 1
    for shutter, row in (("rs", 0), ("gs", 0), ("gs", 24)):
        for side, frame in views_of(2):
            file = data / "planes" / moving_file(shutter, side, frame, row)
            file.parent.mkdir(parents=True, exist_ok=True)
            write_png(file, labels)
    for name in FORMATS:
        _, note = exported(data, name, tmp_path / name)
        reported = any("move in the images" in word or "what moves" in word for word in note["told"])
        # A trajectory has no images, and every shot of fastec-rs is one pair with its truth at its own instant.
        assert reported == (name not in ("tum", "kalibr", "fastec-rs")), name
    points = np.loadtxt(tmp_path / "colmap/planes/sparse/points3D.txt", usecols=(1, 2, 3, 4, 5, 6))
    assert len(points) > 100
    _, poses = only(data).poses("left", 0)
    image = cv2.imread(str(data / "planes/gs/left_0.png"))[..., ::-1]
    x = points[:, :3] @ poses.R[0].T + poses.t[0]
    pixels = np.round(x[:, :2] / x[:, 2:] * [60.0, 61.0] + [30.5, 25.0]).astype(int)
    x, y = np.clip(pixels, 0, (63, 48)).T
    own = np.all(image[y, x] == points[:, 3:], axis=1)
    assert np.all(pixels[own][:, 0] >= 32)
