"""Damaged files of an evaluation: records are made again, tables and arrays refused in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsbench.benchmark.images.predict import load_disparities
from rsbench.benchmark.images.store import Artefact, read_seconds, records_below
from rsbench.core.camera import PinholeCamera
from rsbench.core.errors import RsbenchError
from rsbench.core.rig import StereoRig
from rsbench.storage.files import read_table, save_arrays, write_json

DEPTH = {"matcher": "sgm", "entry": "sgm", "timed": False, "success": True, "reason": ""}


@pytest.mark.parametrize(
    "change", [{"success": None}, {"success": "yes"}, {"reason": 3}, {"stranger": 1}, {"matcher": ["sgm"]}]
)
def test_a_damaged_record_is_none(tmp_path: Path, change: dict[str, Any]) -> None:
    artefact = Artefact(folder=tmp_path, name="depth/sgm", identity="a")
    artefact.start()
    artefact.finish(DEPTH)
    assert artefact.record() == {"identity": "a", **DEPTH}
    assert [name for name, _ in records_below(tmp_path, "depth")] == ["sgm"]
    artefact.finish(DEPTH | change)
    assert artefact.record() is None
    assert list(records_below(tmp_path, "depth")) == []


def test_seconds_are_numbers(tmp_path: Path) -> None:
    write_json(tmp_path / "seconds.json", {"matches": 0.5, "depth/sgm": "long", "motion/x": None})
    assert read_seconds(tmp_path) == {"matches": 0.5}


def test_disparities_are_those_of_the_camera(tmp_path: Path) -> None:
    rig = StereoRig(camera=PinholeCamera.centred(8, 6, 10.0), baseline=0.1)
    path = tmp_path / "sgm.npz"
    whole = {f"{side}_{frame}": np.zeros((6, 8), np.float32) for side in ("left", "right") for frame in (0, 1)}
    save_arrays(path, whole)
    assert load_disparities(path, rig).keys() == whole.keys()
    for damage in (np.zeros((8, 6), np.float32), np.zeros((6, 8)), np.zeros((), np.float32)):
        save_arrays(path, whole | {"right_1": damage})
        with pytest.raises(RsbenchError, match=r"sgm\.npz: must hold right_1 .* sgm\.json"):
            load_disparities(path, rig)


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "not a table"),
        (b'a,b\n"1,2', "not a table"),
        (b"\xff", "UTF-8"),
        (b"b\n1\n", "'a'"),
        (b"a,b\n1,x\n", "'b'"),
    ],
)
def test_a_damaged_table_is_refused(tmp_path: Path, content: bytes, word: str) -> None:
    path = tmp_path / "t.csv"
    path.write_bytes(b"a,b\n1,2\n")
    assert read_table(path, ["a"], ["b"]).b.tolist() == [2]
    path.write_bytes(content)
    with pytest.raises(RsbenchError, match=r"t\.csv: .*" + word):
        read_table(path, ["a"], ["b"])
