"""Start-up: no library, however bad, may end the process; every fallback says what to do."""

from __future__ import annotations

import contextlib
import ctypes.util
import errno
import importlib.metadata
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rendering_child import GENERATE, assert_alike, child, needs_llvm, run_child

from rsbench.core.errors import RsbenchError
from rsbench.dataset.sequence import read_dataset
from rsbench.renderers import backend, diagnosis, llvm
from rsbench.renderers.backend import Backend, start_backend
from rsbench.renderers.llvm import Candidate, ProbeResult
from rsbench.storage.files import read_depth, read_png
from rsbench.verification import verify_dataset


@pytest.mark.slow
def test_scalar_fallback_renders_the_same_frame_and_says_how_to_be_faster(tmp_path: Path) -> None:
    library = "/nonexistent/libLLVM.so"
    slow = child(
        tmp_path, "slow", (96, 72), DRJIT_LIBLLVM_PATH=library, CUDA_VISIBLE_DEVICES="-1", RSBENCH_VARIANT=""
    )
    message = str(slow["message"])
    assert str(slow["variant"]) == "scalar_rgb"
    assert library in message and "install" in message and "\n" not in message
    assert float(slow["seconds"]) < 60
    needs_llvm()
    fast = child(tmp_path, "fast", (96, 72), RSBENCH_VARIANT="llvm")
    assert str(fast["variant"]) == "llvm_ad_rgb" and str(fast["message"]) == ""
    # Rounding differs (fused multiply-add, other vector widths), and flips whole samples at a few edges only.
    for channel, ulp in (("sunsky", 1e-3), ("exposed", 1e-3), ("path", 1e-3), ("depth", 1e-4)):
        difference = np.abs(slow[channel] - fast[channel])
        assert np.mean(difference > ulp) < 2e-3, channel
    assert (slow["depth"] > 0).mean() > 0.2


MOVING = """
import numpy as np
from rsbench.core.camera import PinholeCamera
from rsbench.core.se3 import Pose
from rsbench.renderers.options import RendererOptions
from rsbench.renderers.render import LinePoses, render
from rsbench.renderers.scene import MitsubaScene
from rsbench.scenes.model import Light, Material, Scene, SceneMesh

corners = np.array([[-1.0, -1, 4], [0, -1, 4], [0, 1, 4], [-1, 1, 4]])
faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
quad = SceneMesh(name="quad", vertices=corners, faces=faces, material=Material(name="m"), mover=1)
scene = MitsubaScene(Scene(name="one", meshes=(quad,), light=Light(sun_direction=(0, 0, -1), up=(0, -1, 0))))
still = np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3))
objects = Pose(*(part[None] for part in still))
frame = render(scene, PinholeCamera.centred(4, 3, 3.0), LinePoses(*still, objects), RendererOptions(samples=1))
assert np.argwhere(frame.depth).tolist() == np.argwhere(frame.labels).tolist() == [[1, 1]], frame
"""


def test_the_sky_beside_an_object_that_moves_ends_no_process_without_llvm() -> None:
    run_child(MOVING, RSBENCH_VARIANT="scalar")


AVX2 = "+avx2,+fma,+bmi,+bmi2,+f16c"


def other_width(*, narrow: bool) -> int:
    """A vector width that Dr.Jit does not choose here."""
    needs_llvm()
    if sys.platform != "linux" or "avx2" not in llvm.cpu_features():
        pytest.skip("no x86-64 with AVX2 under Linux, on which Dr.Jit's width can be set")
    # Where there is AVX-512, Dr.Jit is as for 16 by itself, and for that writes what AVX2 has not.
    return 4 if narrow else 8 if "avx512f" in llvm.cpu_features() else 16


@pytest.mark.slow
@pytest.mark.parametrize("narrow", [True, False])
def test_another_vector_width_renders_the_same_within_the_documented_tolerance(
    tmp_path: Path, narrow: bool
) -> None:
    other = child(tmp_path, "other", (96, 72), WIDTH=str(other_width(narrow=narrow)), FEATURES=AVX2)
    own = child(tmp_path, "own", (96, 72))
    assert_alike(other, own)


@pytest.mark.slow
def test_a_dataset_made_with_another_vector_width_is_read_as_alike(tmp_path: Path, smoke_dataset: Path) -> None:
    """All frames, depths and twins of a sequence within the documented tolerance; and no file of it fails."""
    width = other_width(narrow=True)
    run_child(GENERATE, str(tmp_path / "other"), WIDTH=str(width), FEATURES=AVX2)
    other, own = read_dataset(tmp_path / "other")[0], read_dataset(smoke_dataset)[0]
    np.testing.assert_array_equal(other.motion.w, own.motion.w)
    images, differing = 0, 0
    for path in sorted(own.folder.rglob("*.*")):
        there = other.folder / path.relative_to(own.folder)
        differing += there.read_bytes() != path.read_bytes()
        if path.suffix == ".png":
            levels, images = [read_png(each).astype(float) for each in (there, path)], images + 1
            assert np.mean(np.any(levels[0] != levels[1], axis=-1)) < 0.01, path.name
            assert abs(np.mean(levels[0]) - np.mean(levels[1])) < 0.1, path.name
        elif path.suffix == ".exr" and "depth" in path.parent.name:
            np.testing.assert_allclose(read_depth(there), read_depth(path), rtol=1e-5, err_msg=path.name)
    assert images >= 8 and differing > 0  # the other width was used
    assert verify_dataset(tmp_path / "other", rerender="all")[-1].faults == ()  # rows rendered again in this width


def test_a_gpu_renders_the_same_within_the_documented_tolerance(tmp_path: Path) -> None:
    needs_llvm()
    if not (verdict := backend.probe_cuda()).ok:
        pytest.skip(verdict.reason)
    gpu = child(tmp_path, "gpu", (96, 72), RSBENCH_VARIANT="cuda")
    assert str(gpu["variant"]) == "cuda_ad_rgb"
    assert_alike(gpu, child(tmp_path, "own", (96, 72), RSBENCH_VARIANT="llvm"))


def test_same_bits_in_another_process(tmp_path: Path) -> None:
    needs_llvm()
    first = child(tmp_path, "a", (70, 40))
    second = child(tmp_path, "b", (70, 40))
    for channel in ("sunsky", "path", "depth"):
        np.testing.assert_array_equal(first[channel], second[channel])


def test_threads_change_no_bit(town: Any, row_poses: Any) -> None:
    from rsbench.core.camera import PinholeCamera
    from rsbench.renderers.options import RendererOptions
    from rsbench.renderers.render import LinePoses, render
    from rsbench.renderers.scene import MitsubaScene

    camera = PinholeCamera.centred(300, 200, 200.0)
    R, t = row_poses(200, w=(0.1, 0.1, 0.2), d=(0.1, 0.2, 0.3))
    scene = MitsubaScene(town)
    options = RendererOptions(samples=4, integrator="path")
    frames = []
    for threads in (1, 3, os.cpu_count() or 1):
        backend.set_threads(threads)
        frames.append(render(scene, camera, LinePoses(R, t), options))
    for frame in frames[1:]:
        np.testing.assert_array_equal(frame.image, frames[0].image)
        np.testing.assert_array_equal(frame.depth, frames[0].depth)
    with pytest.raises(RsbenchError, match="threads = 0"):
        backend.set_threads(0)


def test_start_is_idempotent_and_refuses_a_second_variant(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RSBENCH_VARIANT", raising=False)
    first = start_backend()
    assert start_backend("auto") is first
    other: backend.Preference = "llvm" if first.variant == "scalar_rgb" else "scalar"
    with pytest.raises(RsbenchError, match=f"already renders with {first.variant}"):
        start_backend(other)


def test_objects_that_move_are_refused_on_a_gpu(town: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    import rsbench.renderers.scene as module

    start_backend()
    monkeypatch.setattr(module, "start_backend", lambda: Backend(variant="cuda_ad_rgb"))
    moved = replace(town, meshes=(*town.meshes[:-1], replace(town.meshes[-1], mover=1)))
    with pytest.raises(RsbenchError, match="objects that move are not rendered on a GPU"):
        module.MitsubaScene(moved)


def test_preferences_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(llvm, "candidates", lambda: iter([Candidate(path=Path("/x/libLLVM.so"), source="system")]))
    monkeypatch.setattr(llvm, "probe", lambda candidate: ProbeResult(ok=False, reason="is LLVM 14"))
    monkeypatch.setattr(backend, "probe_cuda", lambda: ProbeResult(ok=True, version="12.4"))
    assert backend._choose("auto")[0] == Backend(variant="cuda_ad_rgb")
    assert backend._choose("scalar")[0] == Backend(variant="scalar_rgb")
    with pytest.raises(RsbenchError, match=r"/x/libLLVM.so: is LLVM 14.*install LLVM 17"):
        backend._choose("llvm")
    monkeypatch.setattr(backend, "probe_cuda", lambda: ProbeResult(ok=False, reason="no NVIDIA driver"))
    slow = backend._choose("cuda")[0]
    assert slow.variant == "scalar_rgb" and "no NVIDIA driver" in str(slow.message)
    assert backend._choose("auto")[0].variant == "scalar_rgb"
    monkeypatch.setattr(llvm, "probe", lambda candidate: ProbeResult(ok=True, version="21.1.8"))
    chosen = backend._choose("auto")[0]
    assert (chosen.variant, chosen.llvm_version, chosen.message) == ("llvm_ad_rgb", "21.1.8", None)
    instead = backend._choose("cuda")[0]
    message = "renderer backend 'cuda' does not work here (no NVIDIA driver): rendering with llvm_ad_rgb"
    assert (instead.variant, instead.message) == ("llvm_ad_rgb", message)
    monkeypatch.setattr(backend, "_started", instead)
    assert backend.start_backend("cuda") is instead, "a second call is no conflict"


def test_environment_variable_overrides_and_is_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RSBENCH_VARIANT", "scalar_rgb")
    assert backend._wanted("llvm") == "scalar"
    monkeypatch.setenv("RSBENCH_VARIANT", "turbo")
    with pytest.raises(RsbenchError, match=r"RSBENCH_VARIANT = 'turbo': allowed are auto, llvm, cuda, scalar"):
        backend._wanted("auto")


def test_a_file_that_is_no_library_is_refused(tmp_path: Path) -> None:
    junk = tmp_path / "libLLVM.so.23.1"
    junk.write_bytes(b"not a library" * 100)
    verdict = llvm.probe(Candidate(path=junk, source="DRJIT_LIBLLVM_PATH"))
    assert not verdict.ok and verdict.reason
    assert not llvm.probe(Candidate(path=tmp_path / "absent.so", source="system")).ok


@pytest.mark.parametrize("library", [*llvm.outdated_libraries(), None], ids=str)
def test_dr_jit_imported_first_with_an_unsuitable_llvm_or_none_is_refused(library: Path | None) -> None:
    code = """
import os
import shutil
import drjit
del os.environ["DRJIT_LIBLLVM_PATH"]
from rsbench.renderers.backend import start_backend
start_backend("llvm")
"""
    needs_llvm()
    environ = {
        **os.environ,
        "DRJIT_LIBLLVM_PATH": str(library or "/nonexistent/libLLVM.so"),
        "RSBENCH_VARIANT": "",
    }
    done = subprocess.run([sys.executable, "-c", code], env=environ, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "RsbenchError: drjit was imported before rsbench and " in done.stderr, done


def test_unsuitable_system_llvm_ends_only_the_child() -> None:
    old = llvm.outdated_libraries()
    if not old:
        pytest.skip(f"no LLVM older than {llvm.MINIMUM_VERSION} on this machine")
    for path in old:
        # LLVM 14 loops now and then instead of failing.
        verdict = llvm.probe(Candidate(path=path, source="system"), timeout=3.0)
        assert not verdict.ok and verdict.reason


def test_a_child_that_hangs_is_given_up() -> None:
    begin = time.perf_counter()
    verdict = llvm.run_child("import time; time.sleep(60)", [], {}, 0.5)
    assert not verdict.ok and "0.5 s" in verdict.reason and time.perf_counter() - begin < 20


def test_a_working_folder_that_is_gone_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def gone() -> str:
        raise FileNotFoundError(errno.ENOENT, "No such file or directory")

    monkeypatch.setattr(backend, "_started", None)
    monkeypatch.setattr(os, "getcwd", gone)
    with pytest.raises(RsbenchError, match="the working folder, which must exist: No such file or directory"):
        start_backend()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere nothing ends a child whose parent was killed")
def test_a_child_ends_when_its_parent_is_killed(tmp_path: Path) -> None:
    deadly = (
        "import os, signal, sys, time; open(sys.argv[1], 'w').write(str(os.getpid())); "
        "os.kill(os.getppid(), signal.SIGKILL); time.sleep(60)"
    )
    started = tmp_path / "pid"
    parent = f"from rsbench.renderers import llvm; llvm.run_child({deadly!r}, [{str(started)!r}], {{}}, 60.0)"
    assert subprocess.run([sys.executable, "-c", parent]).returncode == -signal.SIGKILL
    child = Path("/proc") / started.read_text() / "stat"
    end = time.perf_counter() + 10
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        while child.read_text().rpartition(")")[2].split()[0] not in ("Z", "X"):  # dead, and not buried yet
            assert time.perf_counter() < end, "the child lives on"
            time.sleep(0.01)


def test_wheel_without_its_symbolic_links_still_loads(tmp_path: Path) -> None:
    """As left by installers that do not run the wheel's start-up hook."""
    wheels = [c for c in llvm.candidates({}) if c.source == "karellen-llvm-core"]
    if not wheels:
        pytest.skip("karellen-llvm-core is not installed")
    runtime = wheels[0].path.parent / "x86_64-unknown-linux-gnu"
    (tmp_path / "lib" / runtime.name).mkdir(parents=True)
    library = Path(shutil.copy(wheels[0].path, tmp_path / "lib"))
    for file in runtime.glob("*.so.1.0"):
        shutil.copy(file, tmp_path / "lib" / runtime.name)
    [candidate] = llvm.candidates({"DRJIT_LIBLLVM_PATH": str(library)})
    assert [path.name for path in candidate.preload] == ["libunwind.so.1.0", "libc++abi.so.1.0", "libc++.so.1.0"]
    assert llvm.probe(candidate).ok
    if ctypes.util.find_library("c++") is None:
        library.touch()  # another key, so that the good news about it is not recalled
        assert not llvm.probe(Candidate(path=library, source="DRJIT_LIBLLVM_PATH")).ok


def test_candidates_come_in_order(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(llvm, "_MINIMUM_BYTES", 0)
    for name in ("libLLVM-18.so.1", "libLLVM.so.20.1", "libLLVM-15.so", "libLLVM.so.9"):
        (tmp_path / name).write_bytes(b"x")
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "elsewhere"))
    monkeypatch.setattr(llvm, "_SYSTEM_GLOBS", (f"{tmp_path}/libLLVM*.so*",))
    monkeypatch.setattr(llvm, "_wheel_libraries", lambda: iter([(Path("/wheel/libLLVM.so"), "wheel")]))
    names = [candidate.path.name for candidate in llvm.candidates({})]
    assert names[:3] == ["libLLVM.so", "libLLVM.so.20.1", "libLLVM-18.so.1"]
    assert not {"libLLVM-15.so", "libLLVM.so.9"} & set(names)
    only = list(llvm.candidates({"DRJIT_LIBLLVM_PATH": "/mine.so"}))
    assert [candidate.path for candidate in only] == [Path("/mine.so")]


def test_good_news_is_remembered_and_bad_news_is_not(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    library = tmp_path / "libLLVM.so.22.1"
    library.write_bytes(b"x")
    candidate = Candidate(path=library, source="system")
    answers = [
        ProbeResult(ok=False, reason="busy"),
        ProbeResult(ok=True, version="22.1.8"),
        ProbeResult(ok=True, version="16.0.6"),
    ]
    monkeypatch.setattr(llvm, "run_child", lambda *arguments: answers.pop(0))
    assert not llvm.probe(candidate).ok
    assert llvm.probe(candidate).version == "22.1.8"
    assert llvm.probe(candidate).version == "22.1.8" and len(answers) == 1
    library.write_bytes(b"another")
    assert "is LLVM 16.0.6; 17 or newer" in llvm.probe(candidate).reason


@pytest.mark.parametrize("content", ["", "{", "[1]", '{"k": 3}'])
def test_a_damaged_or_unwritable_cache_is_no_cache(
    content: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tmp_path / "rsbench").mkdir()
    (tmp_path / "rsbench" / "probes.json").write_text(content)
    assert llvm.recall("k") is None
    llvm.remember("k", "21")
    assert llvm.recall("k") == "21"
    assert json.loads((tmp_path / "rsbench" / "probes.json").read_text())["k"] == "21"
    file = tmp_path / "file"
    file.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(file))
    llvm.remember("k", "21")
    assert llvm.recall("k") is None
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr("os.path.expanduser", lambda path: path)  # as without a home folder
    llvm.remember("k", "21")
    assert llvm.recall("k") is None


def test_doctor_reports_and_outlives_everything_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = {row.component: row for row in diagnosis.doctor_report()}
    assert rows["scalar_rgb"].status == "ok" and rows["OpenEXR works"].status == "ok"
    assert {"python", "mitsuba", "processor", "threads", "llvm_ad_rgb", "cuda_ad_rgb"} <= set(rows)

    def broken(*arguments: Any, **options: Any) -> Any:
        raise OSError("everything is broken")

    monkeypatch.setattr(llvm, "run_child", broken)
    monkeypatch.setattr(llvm, "candidates", broken)
    monkeypatch.setattr(diagnosis, "probe_cuda", broken)
    monkeypatch.setattr(importlib.metadata, "version", broken)
    broken_rows = diagnosis.doctor_report()
    assert sum(row.status == "fail" for row in broken_rows) >= 4
    assert any("everything is broken" in row.detail for row in broken_rows)


def row(component: str, status: Any = "ok", detail: str = "") -> diagnosis.DoctorRow:
    return diagnosis.DoctorRow(component, status, detail)


def test_the_doctor_says_what_to_do_on_each_kind_of_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    good = [row("llvm_ad_rgb"), row("cuda_ad_rgb", "warn"), row("scalar_rgb")]
    monkeypatch.setattr(diagnosis.sys, "platform", "linux")
    monkeypatch.setattr(diagnosis.platform, "machine", lambda: "x86_64")
    assert diagnosis.advice(good) == ["renders with llvm_ad_rgb; next: rsbench demo"]
    faster, last = diagnosis.advice([row("llvm_ad_rgb", "warn"), *good[1:]])
    assert "faster than scalar_rgb: install LLVM 17" in faster and last.startswith("renders with scalar_rgb")
    lines = diagnosis.advice(
        [row("scipy", "fail", "not installed"), row("OpenEXR works", "fail", "no file"), *good]
    )
    assert lines[0].startswith("install scipy: pip install") and lines[1] == "mend OpenEXR works: no file"
    monkeypatch.setattr(diagnosis.platform, "machine", lambda: "arm64")
    assert "tested on Linux x86-64 alone" in diagnosis.advice(good)[0]
    assert diagnosis.advice([row(each.component, "fail", "x") for each in good])[-1].startswith("nothing renders")
