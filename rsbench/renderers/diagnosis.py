"""Diagnosis of the rendering backends on this machine; everything that may crash is tried in a child process."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from rsbench.renderers import llvm
from rsbench.renderers.backend import VARIANTS, probe_cuda

_PACKAGES = (
    "rsbench",
    "numpy",
    "scipy",
    "mitsuba",
    "drjit",
    "karellen-llvm-core",
    "llvm-nanobind",
    "trimesh",
    "opencv-python-headless",
    "OpenEXR",
)
_OPTIONAL = ("karellen-llvm-core", "llvm-nanobind")

_VARIANT_CHECK = """
import os, sys
os.environ.pop("RSBENCH_VARIANT", None)
from rsbench.renderers.backend import start_backend
backend = start_backend(sys.argv[1])
import mitsuba as mi
scene = mi.load_dict({"type": "scene", "shape": {"type": "sphere"}})
hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, -3), mi.Vector3f(0, 0, 1)))
distance = hit.t if isinstance(hit.t, float) else hit.t[0]
assert abs(distance - 2) < 1e-4, distance
print("version", backend.llvm_version or "ok")
"""
_OPENCV_CHECK = """
import cv2, numpy
assert cv2.SIFT_create().detect(numpy.zeros((32, 32), numpy.uint8)) is not None
print("version", cv2.__version__)
"""
_OPENEXR_CHECK = """
import OpenEXR, numpy, os, tempfile
with tempfile.TemporaryDirectory() as folder:
    name = os.path.join(folder, "z.exr")
    z = numpy.arange(12, dtype=numpy.float32).reshape(3, 4)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"Z": z}) as file:
        file.write(name)
    with OpenEXR.File(name, separate_channels=True) as file:
        assert (file.channels()["Z"].pixels == z).all()
print("version", OpenEXR.__version__)
"""


@dataclass(frozen=True)
class DoctorRow:
    """One line of ``rsbench doctor``."""

    component: str
    status: Literal["ok", "warn", "fail"]
    detail: str


def doctor_report() -> list[DoctorRow]:
    """Return rows about Python, packages, the processor, every LLVM and variant tried, and the image libraries.

    It never raises and never loads an untested library; a check that raises becomes a row with the error.
    """
    rows: list[DoctorRow] = []
    checks: tuple[tuple[str, Callable[[], Iterator[DoctorRow]]], ...] = (
        ("python", _python),
        ("packages", _packages),
        ("processor", _processor),
        ("LLVM", _llvm),
        ("variants", _variants),
        ("image libraries", _image_libraries),
    )
    for name, check in checks:
        try:
            rows.extend(check())
        except Exception as error:  # the other checks must still run
            rows.append(DoctorRow(name, "fail", f"check broke: {type(error).__name__}: {error}"))
    return rows


def advice(rows: Sequence[DoctorRow]) -> list[str]:
    """Return advice for this machine, one line each; the last line names the backend that will be used.

    Args:
        rows: rows from ``doctor_report``.
    """
    found = {row.component: row for row in rows}
    lines = []
    if missing := [row.component for row in rows if row.status == "fail" and row.detail == "not installed"]:
        lines.append(f"install {', '.join(missing)}: pip install --force-reinstall rsbench brings what is missing")
    broken = [row for row in rows if row.status == "fail" and row.component not in (*missing, "libLLVM")]
    lines += [f"mend {row.component}: {row.detail}" for row in broken]
    if sys.platform != "linux" or platform.machine() != "x86_64":
        lines.append("rsbench is tested on Linux x86-64 alone: please tell us what pytest says on this machine")
    works = [name for name in VARIANTS.values() if name in found and found[name].status == "ok"]
    llvm_variant, scalar = VARIANTS["llvm"], VARIANTS["scalar"]
    if llvm_variant not in works:
        lines.append(f"to render tens of times faster than {scalar}: {llvm.REMEDY}")
    if works:
        lines.append(f"renders with {next(iter(works))}; next: rsbench demo")
    else:
        lines.append("nothing renders here; solve, simulate and leaderboard work all the same")
    return lines


def _python() -> Iterator[DoctorRow]:
    yield DoctorRow("python", "ok", f"{platform.python_version()} ({sys.executable})")
    yield DoctorRow("system", "ok", platform.platform())


def _packages() -> Iterator[DoctorRow]:
    for name in _PACKAGES:
        try:
            yield DoctorRow(name, "ok", importlib.metadata.version(name))
        except importlib.metadata.PackageNotFoundError:
            if name not in _OPTIONAL:
                yield DoctorRow(name, "fail", "not installed")


def _processor() -> Iterator[DoctorRow]:
    affinity = getattr(os, "sched_getaffinity", None)
    usable = len(affinity(0)) if affinity is not None else os.cpu_count()
    yield DoctorRow("processor", "ok", llvm.cpu_features())
    yield DoctorRow("threads", "ok", f"{usable} usable of {os.cpu_count()}")
    yield DoctorRow("probe cache", "ok", str(llvm.cache_file() or "none (no home folder)"))


def _llvm() -> Iterator[DoctorRow]:
    found = False
    for candidate in llvm.candidates():
        verdict = llvm.probe(candidate)
        found |= verdict.ok
        answer = f"LLVM {verdict.version}" if verdict.ok else verdict.reason
        yield DoctorRow(
            f"libLLVM ({candidate.source})", "ok" if verdict.ok else "warn", f"{candidate.path}: {answer}"
        )
    for path in llvm.outdated_libraries():
        detail = f"{path}: ignored, older than {llvm.MINIMUM_VERSION}"
        yield DoctorRow("libLLVM (system)", "ok" if found else "warn", detail)
    if not found:
        yield DoctorRow("libLLVM", "fail", f"none works; {llvm.REMEDY}")


def _variants() -> Iterator[DoctorRow]:
    for name, variant in VARIANTS.items():
        verdict = probe_cuda() if name == "cuda" else llvm.run_child(_VARIANT_CHECK, [name], {}, 120.0)
        answer = f"traces rays ({verdict.version})" if verdict.ok else verdict.reason
        missing: Literal["warn", "fail"] = "fail" if name == "scalar" else "warn"
        yield DoctorRow(variant, "ok" if verdict.ok else missing, answer)


def _image_libraries() -> Iterator[DoctorRow]:
    for name, code in (("OpenCV works", _OPENCV_CHECK), ("OpenEXR works", _OPENEXR_CHECK)):
        verdict = llvm.run_child(code, [], {}, 60.0)
        yield DoctorRow(name, "ok" if verdict.ok else "fail", verdict.version if verdict.ok else verdict.reason)
