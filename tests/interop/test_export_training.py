"""Shards and samples for training: read back, and no file of the dataset twice."""

from __future__ import annotations

import gc
import json
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import webdataset
from exported_data import PLACE, dataset, exported, only

from rsbench.core.errors import RsbenchError
from rsbench.core.rig import SIDES
from rsbench.interop.writers import frame_samples
from rsbench.interop.writers.frame_samples import FrameSamples
from rsbench.storage import untrusted_files
from rsbench.storage.files import read_depth, read_png


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return dataset(tmp_path_factory.mktemp("made") / "data", frames=5)


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file with the path of every file of a dataset that is read, by child processes of a fork too."""
    path, read = tmp_path / "read.log", untrusted_files.read_bytes
    path.touch()

    def logged(file: Path, *limit: int) -> bytes:
        with path.open("a") as stream:
            stream.write(f"{file}\n")
        return read(file, *limit)

    for module in ("rsbench.storage.untrusted_files", "rsbench.storage.files"):
        monkeypatch.setattr(f"{module}.read_bytes", logged)
    return path


# WebDataset


def samples_of(folder: Path) -> list[dict[str, Any]]:
    shards = sorted(str(path) for path in folder.glob("*.tar"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # webdataset leaves the last file to the collector
        samples = list(webdataset.WebDataset(shards, shardshuffle=False, empty_check=False).decode("rgb8"))
        gc.collect()
    return samples


def test_webdataset_reads_every_frame(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_samples, "SHARD_SAMPLES", 2)
    out, note = exported(made, "webdataset", tmp_path / "out")
    assert len(list(out.glob("*.tar"))) == 3 and note == {"samples": 5, "told": []}
    samples, sequence = samples_of(out), only(made)
    assert [sample["__key__"] for sample in samples] == [f"000000-planes-{k:04d}" for k in range(5)]
    for frame, sample in enumerate(samples):
        assert sample["json"]["sequence"] == "planes" and sample["json"]["frame"] == frame
        assert sample["json"]["camera"]["fx"] == 60.0 and sample["json"]["scan"] == "top"
        for side in SIDES:
            tau, poses = sequence.poses(side, frame)
            np.testing.assert_array_equal(sample[f"{side}.poses.npy"][..., :3], poses.R)
            np.testing.assert_array_equal(sample[f"{side}.poses.npy"][..., 3], poses.t)
            np.testing.assert_allclose(sample[f"{side}.times.npy"], 0.1 * tau, rtol=1e-15)
            for shutter in ("rs", "gs"):
                np.testing.assert_array_equal(
                    sample[f"{side}.{shutter}.png"], sequence.image(shutter, side, frame)
                )
                depth = sequence.depth(shutter, side, frame)
                np.testing.assert_array_equal(sample[f"{side}.{shutter}_depth.npy"], depth)


def test_each_camera_of_a_rig_has_its_own_size(tmp_path: Path) -> None:
    data = dataset(tmp_path / "data", right="fisheye")
    sample = samples_of(exported(data, "webdataset", tmp_path / "out")[0])[0]
    shapes = [sample[f"{side}.{name}"].shape for side in SIDES for name in ("rs.png", "rs_depth.npy", "poses.npy")]
    assert shapes == [(49, 64, 3), (49, 64), (49, 3, 4), (45, 80, 3), (45, 80), (45, 3, 4)]
    assert sample["json"]["cameras"]["right"]["lens"]["model"] == "kannala-brandt"
    np.testing.assert_allclose(sample["json"]["right_from_left"]["translation"], PLACE, atol=1e-14)
    lines = exported(data, "huggingface", tmp_path / "folder")[0] / "metadata.jsonl"
    assert json.loads(lines.read_text().splitlines()[0])["cameras"] == sample["json"]["cameras"]


# Samples


def _assert_read_once(log: Path) -> None:
    counts = Counter(log.read_text().split())
    assert len(counts) > 20 and set(counts.values()) == {1}


def test_windows_hold_all_frames_and_read_no_file_twice(made: Path, log: Path) -> None:
    samples = FrameSamples(made, frames=2, parts=("rs", "gs", "rs_depth", "gs_depth", "poses"))
    found = [samples[k] for k in range(len(samples))]
    _assert_read_once(log)
    sequence = only(made)
    assert [(sample["sequence"], sample["frame"]) for sample in found] == [("planes", 0), ("planes", 2)]
    tau, poses = sequence.poses("right", 3)
    np.testing.assert_array_equal(found[1]["right_times"][1], tau)
    np.testing.assert_array_equal(found[1]["right_poses"][1, :, :, 3], poses.t)
    np.testing.assert_array_equal(found[1]["right_rs"][1], sequence.image("rs", "right", 3))
    np.testing.assert_array_equal(found[0]["left_gs_depth"][1], sequence.depth("gs", "left", 1))


def test_what_cannot_be_a_sample_is_refused(made: Path) -> None:
    with pytest.raises(RsbenchError, match="planes: has 5 frames, fewer than frames = 6"):
        FrameSamples(made, frames=6)
    with pytest.raises(ValueError, match="parts: 'flow' must be one of rs, gs"):
        FrameSamples(made, parts=("flow",))  # pyrefly: ignore[bad-argument-type]
    with pytest.raises(ValueError, match="frames = 0"):
        FrameSamples(made, frames=0)
    with pytest.raises(IndexError, match="sample 5: there are 5"):
        FrameSamples(made)[5]


@pytest.mark.parametrize("workers", [0, 2])
def test_ten_lines_of_torch_train_on_it(made: Path, log: Path, workers: int) -> None:
    """A global-shutter frame by a filter of the rolling-shutter one: the loss of the second epoch is smaller."""
    torch: Any = pytest.importorskip("torch")
    from rsbench.interop.writers.torch_frames import RollingShutterFrames

    torch.manual_seed(0)
    torch.set_num_threads(1)
    frames = RollingShutterFrames(made, parts=("rs", "gs"))
    loader = torch.utils.data.DataLoader(frames, batch_size=2, shuffle=True, num_workers=workers)
    model = torch.nn.Conv2d(3, 3, 5, padding=2)
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-2)
    losses = []
    for epoch in range(8):
        for batch in loader:
            loss = torch.nn.functional.mse_loss(model(batch["left_rs"][:, 0]), batch["left_gs"][:, 0])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            losses.append(loss.item())
        if epoch == 0:
            _assert_read_once(log)
    assert np.mean(losses[-3:]) < 0.5 * np.mean(losses[:3])


def test_tensors_are_what_the_files_hold(made: Path) -> None:
    torch: Any = pytest.importorskip("torch")
    from rsbench.interop.writers.torch_frames import RollingShutterFrames

    frames = RollingShutterFrames(made, frames=2)
    assert isinstance(frames, torch.utils.data.Dataset) and len(frames) == 2
    sample, sequence = frames[1], only(made)
    assert sample["left_rs"].shape == (2, 3, 49, 64) and sample["left_rs"].dtype == torch.float32
    image = np.round(255 * np.moveaxis(sample["right_gs"][1].numpy(), 0, -1)).astype(np.uint8)
    np.testing.assert_array_equal(image, sequence.image("gs", "right", 3))
    np.testing.assert_array_equal(sample["left_rs_depth"][0].numpy(), sequence.depth("rs", "left", 2))
    assert sample["left_poses"].shape == (2, 49, 3, 4) and sample["left_poses"].dtype == torch.float64


# Hugging Face


def test_the_folder_of_hugging_face_names_every_file_and_its_truth(made: Path, tmp_path: Path) -> None:
    out, note = exported(made, "huggingface", tmp_path / "out")
    lines = [json.loads(line) for line in (out / "metadata.jsonl").read_text("utf-8").splitlines()]
    assert note["lines"] == len(lines) == 10
    assert (out / "README.md").read_text("utf-8").startswith("---\nlicense: ")
    sequence = only(made)
    for line in lines:
        view = line["side"], line["frame"]
        np.testing.assert_array_equal(read_png(out / line["gs_file_name"]), sequence.image("gs", *view))
        np.testing.assert_array_equal(read_depth(out / line["depth"]), sequence.depth("rs", *view))
        assert line["motion"]["model"] == "linear" and (out / line["poses"]).is_file()


def test_hugging_face_loads_both_images_of_a_line(made: Path, tmp_path: Path) -> None:
    datasets: Any = pytest.importorskip("datasets")
    out, _ = exported(made, "huggingface", tmp_path / "out")
    loaded = datasets.load_dataset(
        "imagefolder", data_dir=str(out), split="train", cache_dir=str(tmp_path / "cache")
    )
    assert len(loaded) == 10
    for line in loaded:
        view = line["side"], line["frame"]
        np.testing.assert_array_equal(np.asarray(line["image"]), only(made).image("rs", *view))
        np.testing.assert_array_equal(np.asarray(line["gs"]), only(made).image("gs", *view))
