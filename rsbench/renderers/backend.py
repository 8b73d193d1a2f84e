"""Starts Mitsuba with a variant that is chosen once per process and tested in a child process first."""

from __future__ import annotations

import glob
import os
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from rsbench.components.imports import signals_later
from rsbench.core.errors import RsbenchError
from rsbench.renderers import llvm

Preference = Literal["auto", "llvm", "cuda", "scalar"]

VARIANTS = {"llvm": "llvm_ad_rgb", "cuda": "cuda_ad_rgb", "scalar": "scalar_rgb"}

_DRIVER_GLOBS = (
    "/usr/lib/*-linux-gnu/libcuda.so*",
    "/usr/lib64/libcuda.so*",
    "/usr/lib/libcuda.so*",
    "/usr/lib/wsl/lib/libcuda.so*",
    "/usr/local/nvidia/lib64/libcuda.so*",
    "/usr/local/cuda*/compat/libcuda.so*",
    "/run/opengl-driver/lib/libcuda.so*",
)

_CUDA_PROBE = """
import mitsuba as mi
mi.set_variant("cuda_ad_rgb")
scene = mi.load_dict({"type": "scene", "shape": {"type": "sphere"}})
ray = mi.Ray3f(mi.Point3f(0, 0, mi.Float([-3, -4])), mi.Vector3f(0, 0, 1))
t = list(scene.ray_intersect(ray).t)
assert abs(t[0] - 2) < 1e-4 and abs(t[1] - 3) < 1e-4, t
import drjit as dr
print("version", *dr.detail.cuda_version())
"""


@dataclass(frozen=True, kw_only=True)
class Backend:
    """The renderer backend of this process."""

    variant: str
    """Mitsuba variant: ``llvm_ad_rgb``, ``cuda_ad_rgb`` or ``scalar_rgb``."""
    llvm_path: Path | None = None
    llvm_version: str | None = None
    message: str | None = None
    """One line for the user if the choice needs an explanation (a slow fallback and its remedy), else None."""


_started: Backend | None = None
_lock = threading.RLock()


def start_backend(preference: Preference = "auto") -> Backend:
    """Choose the Mitsuba variant of this process and start it; later calls return the same answer.

    ``auto`` tries LLVM (the same bits on every machine of a kind), then CUDA, then the slow scalar variant.
    ``cuda`` falls back to ``auto`` if no GPU can trace rays, and reports this in the message. The environment
    variable ``RSBENCH_VARIANT`` overrides ``preference``; ``DRJIT_LIBLLVM_PATH`` names the only libLLVM to try.
    Every library is tried in a child process first, so an unsuitable one cannot end this process.

    Raises:
        RsbenchError: unknown preference; ``llvm`` does not work here; another backend has already been started in
            this process; the working folder is gone.
    """
    global _started
    wanted = _wanted(preference)
    with _lock:
        if _started is None:
            _check_working_folder()
            chosen, candidate = _adopted() or _choose(wanted)
            if chosen.variant == VARIANTS["llvm"]:
                _check_loaded()
            if candidate is not None:
                llvm.load(candidate)
            _set_variant(chosen.variant)
            _started = chosen
        instead = wanted == "cuda" and _started.message is not None
        if wanted != "auto" and _started.variant != VARIANTS[wanted] and not instead:
            raise RsbenchError(
                f"renderer backend {wanted!r} cannot start: this process already renders with {_started.variant}"
            )
        return _started


def ask_for(name: str | None) -> None:
    """Set the backend of this process and its children; None leaves the choice to the environment.

    Raises:
        RsbenchError: there is no such backend.
    """
    if name is not None and name not in VARIANTS:
        raise RsbenchError(f"--backend {name}: allowed are {', '.join(VARIANTS)}")
    if name is not None:
        os.environ["RSBENCH_VARIANT"] = name


def _check_working_folder() -> None:
    """Check that the working folder exists: otherwise the import of Mitsuba ends the process."""
    try:
        os.getcwd()
    except OSError as error:
        raise RsbenchError(f"the working folder, which must exist: {error.strerror}; go to another") from error


def _wanted(preference: str) -> Preference:
    field = "RSBENCH_VARIANT" if os.environ.get("RSBENCH_VARIANT") else "renderer backend"
    name = os.environ.get("RSBENCH_VARIANT") or preference
    short = {variant: key for key, variant in VARIANTS.items()}.get(name, name)
    for known in get_args(Preference):
        if short == known:
            return known
    raise RsbenchError(f"{field} = {name!r}: allowed are {', '.join(get_args(Preference))}")


def _choose(wanted: Preference) -> tuple[Backend, llvm.Candidate | None]:
    without_gpu = ""
    if wanted == "cuda":
        verdict = probe_cuda()
        if verdict.ok:
            return Backend(variant=VARIANTS["cuda"]), None
        without_gpu = f"renderer backend 'cuda' does not work here ({verdict.reason})"
    refusals: list[str] = []
    for candidate in llvm.candidates() if wanted != "scalar" else ():
        verdict = llvm.probe(candidate)
        if verdict.ok:
            variant = VARIANTS["llvm"]
            message = f"{without_gpu}: rendering with {variant}" if without_gpu else None
            found = Backend(
                variant=variant, llvm_path=candidate.path, llvm_version=verdict.version, message=message
            )
            return found, candidate
        refusals.append(f"{candidate.path}: {verdict.reason}")
    tried = f" ({'; '.join(refusals)})" if refusals else ""
    if wanted == "llvm":
        raise RsbenchError(f"renderer backend 'llvm' found no usable libLLVM{tried}; {llvm.REMEDY}")
    if wanted == "auto" and probe_cuda().ok:
        return Backend(variant=VARIANTS["cuda"]), None
    if wanted == "scalar":
        return Backend(variant=VARIANTS["scalar"]), None
    why = "; ".join(filter(None, [without_gpu, f"no usable libLLVM{tried}"]))
    message = f"{why}: rendering with scalar_rgb, tens of times slower; {llvm.REMEDY}"
    return Backend(variant=VARIANTS["scalar"], message=message), None


def _adopted() -> tuple[Backend, None] | None:
    """Return the variant that the user's program has already set, if any."""
    mitsuba = sys.modules.get("mitsuba")
    variant = mitsuba.variant() if mitsuba is not None else None
    if variant is None:
        return None
    if variant not in VARIANTS.values():
        raise RsbenchError(
            f"Mitsuba variant {variant!r} is already set in this process: rsbench renders with "
            f"{', '.join(VARIANTS.values())}"
        )
    path = os.environ.get("DRJIT_LIBLLVM_PATH")
    return Backend(variant=variant, llvm_path=Path(path) if path else None), None


def _check_loaded() -> None:
    """Check that Dr.Jit, if already imported, has found LLVM: it searches only once, on import."""
    drjit = sys.modules.get("drjit")
    version = drjit.detail.llvm_version() if drjit is not None else (llvm.MINIMUM_VERSION,)
    if version[0] < llvm.MINIMUM_VERSION:
        found = f"has LLVM {'.'.join(map(str, version))}" if version[0] > 0 else "found none it can use"
        raise RsbenchError(
            f"drjit was imported before rsbench and {found}, of which {llvm.MINIMUM_VERSION} or later is needed: "
            "call rsbench.renderers.backend.start_backend() before that import, or set DRJIT_LIBLLVM_PATH"
        )


def _set_variant(variant: str) -> None:
    with signals_later():
        import mitsuba

        if mitsuba.variant() != variant:
            mitsuba.set_variant(variant)


def set_threads(count: int) -> None:
    """Let the started backend use ``count`` CPU threads (a worker of several on one machine uses a share).

    Raises:
        RsbenchError: ``count`` is below 1.
    """
    if count < 1:
        raise RsbenchError(f"threads = {count}: at least 1 is needed")
    start_backend()
    import drjit

    drjit.set_thread_count(count)


def driver_library() -> Path | None:
    """Find the NVIDIA driver's library by file name, without loading it."""
    folders = [part for part in os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep) if part]
    patterns = [*_DRIVER_GLOBS, *(f"{glob.escape(folder)}/libcuda.so*" for folder in folders)]
    if sys.platform == "win32":
        patterns = [str(Path(os.environ.get("SYSTEMROOT", "C:/Windows"), "System32", "nvcuda.dll"))]
    return next((Path(name) for pattern in patterns for name in sorted(glob.glob(pattern))), None)


def probe_cuda(timeout: float = 120.0) -> llvm.ProbeResult:
    """Test whether ``cuda_ad_rgb`` can trace rays here; without an NVIDIA driver, no process is started."""
    driver = driver_library()
    if driver is None:
        return llvm.ProbeResult(ok=False, reason="no NVIDIA driver on this machine")
    devices = ",".join(sorted(glob.glob("/dev/nvidia[0-9]*")))
    machine = f"{devices}|{os.environ.get('CUDA_VISIBLE_DEVICES', 'all')}"
    return llvm.remembered("cuda", driver, machine, lambda: llvm.run_child(_CUDA_PROBE, [], {}, timeout))
