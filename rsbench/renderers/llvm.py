"""Finds a libLLVM that Dr.Jit can use, without crashing the user's process.

Dr.Jit loads libLLVM at run time. Its own search takes the first library it finds, and LLVM 15 and 16 (still the
default of common systems) abort the whole process at the first kernel. So every candidate is first loaded by a
child process that compiles a small kernel; only a library that passes this probe is loaded here.

Successful probes are stored in the user's cache folder, so that later starts need none. Failures are not stored:
the cause may be gone at the next start, and a probe takes a fraction of a second. Errors of the cache are ignored:
without a home folder or with a read-only one, nothing is stored.
"""

from __future__ import annotations

import ctypes
import glob
import importlib.metadata
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rsbench.components.imports import lifeline
from rsbench.storage.work_folder import cpu_key, user_cache

_MAXIMUM_ENTRIES = 64


def cache_file() -> Path | None:
    """Return the file with the results of earlier probes, or None if the user has no home folder."""
    base = user_cache()
    return base / "probes.json" if base is not None and base.is_absolute() else None


def recall(key: str) -> str | None:
    """Return the version that an earlier successful probe reported, or None."""
    return _read().get(key)


def remember(key: str, version: str) -> None:
    """Store a successful probe; do nothing if the cache cannot be written."""
    file = cache_file()
    if file is None:
        return
    entries = {**_read(), key: version}
    kept = dict(list(entries.items())[-_MAXIMUM_ENTRIES:])
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=file.parent, suffix=".tmp")
        with os.fdopen(handle, "w", encoding="utf-8", newline="\n") as stream:
            json.dump(kept, stream, indent=1)
        os.replace(name, file)
    except OSError:
        return


def _read() -> dict[str, str]:
    file = cache_file()
    try:
        content = json.loads(file.read_text(encoding="utf-8")) if file is not None else {}
    except (OSError, ValueError):
        return {}
    if not isinstance(content, dict):
        return {}
    return {key: value for key, value in content.items() if isinstance(value, str)}


MINIMUM_VERSION = 17
"""15 and 16 abort on CPUs with AVX-512 ("Cannot select ... fminimum"); 14 lacks opaque pointers."""

REMEDY = (
    "install LLVM 17 or newer (`pip install karellen-llvm-core`, or your system's libLLVM); "
    "`rsbench doctor` shows what was tried"
)

_WHEELS = {
    "karellen-llvm-core": re.compile(r"^libLLVM.*\.so"),
    "llvm-nanobind": re.compile(r"^(libLLVM.*\.so|LLVM\.dll$|l[0-9a-f]+\.dylib$)"),
}
_MINIMUM_BYTES = 20_000_000  # a whole LLVM; smaller files of that name are link stubs

_SYSTEM_GLOBS = (
    "/usr/lib/*-linux-gnu/libLLVM*.so*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/usr/lib64/llvm*/lib/libLLVM*.so*",
    "/usr/lib/libLLVM*.so*",
    "/opt/homebrew/Cellar/llvm*/*/lib/libLLVM.dylib",
    "/usr/local/Cellar/llvm*/*/lib/libLLVM.dylib",
)
_VERSION_IN_PATH = re.compile(r"libLLVM-(\d+)|libLLVM\.so\.(\d+)|llvm-(\d+)/|Cellar/llvm[^/]*/(\d+)")

# The kernel holds the operations that abort with unsuitable versions. The child has no kernel cache: a kernel
# taken from the cache would never reach the library under test.
_PROBE = """
import ctypes, sys
try:
    import resource
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
except (ImportError, OSError, ValueError):
    pass
for library in sys.argv[1:]:
    ctypes.CDLL(library, mode=ctypes.RTLD_GLOBAL)
import drjit as dr
from drjit.llvm import Float, UInt32
version = dr.detail.llvm_version()
x = dr.arange(Float, 64) / 8
y = dr.minimum(x, 2) + dr.maximum(x, 1) + dr.fma(x, x, 1) + dr.sqrt(x)
z = dr.gather(Float, y, 63 - dr.arange(UInt32, 64))
assert abs(float(dr.sum(z)[0]) - float(sum(list(y)))) < 1e-2
print("version", *version)
"""

_BOUND = "from rsbench.components.imports import end_with; end_with({line})\n"


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A libLLVM file that may or may not work."""

    path: Path
    source: str
    """Where it was found: ``DRJIT_LIBLLVM_PATH``, the name of a wheel, or ``system``."""
    preload: tuple[Path, ...] = ()
    """Libraries to load before it, in this order."""


@dataclass(frozen=True, kw_only=True)
class ProbeResult:
    """Result of a probe; ``version`` is empty unless the library is usable."""

    ok: bool
    version: str = ""
    reason: str = ""


def candidates(environ: Mapping[str, str] | None = None) -> Iterator[Candidate]:
    """Yield the libraries to try, best first; only the user's path if it is set."""
    environ = os.environ if environ is None else environ
    chosen = environ.get("DRJIT_LIBLLVM_PATH", "")
    if chosen:
        path = Path(chosen)
        yield Candidate(path=path, source="DRJIT_LIBLLVM_PATH", preload=_missing_links(path))
        return
    seen: set[Path] = set()
    for path, source in (*_wheel_libraries(), *_system_libraries()):
        if path not in seen:
            seen.add(path)
            yield Candidate(path=path, source=source, preload=_missing_links(path))


def _wheel_libraries() -> Iterator[tuple[Path, str]]:
    for name, pattern in _WHEELS.items():
        try:
            files = importlib.metadata.distribution(name).files or []
        except importlib.metadata.PackageNotFoundError:
            continue
        for file in files:
            path = Path(str(file.locate())).resolve()
            if pattern.match(file.name) and path.is_file() and path.stat().st_size > _MINIMUM_BYTES:
                yield path, name


def _system_libraries() -> list[tuple[Path, str]]:
    found = {path: version for path, version in _installed().items() if version >= MINIMUM_VERSION}
    newest_first = sorted(found, key=lambda path: (-found[path], str(path)))
    windows = Path(os.environ.get("PROGRAMFILES", "C:/Program Files"), "LLVM", "bin", "LLVM-C.dll")
    if sys.platform == "win32" and windows.is_file():
        newest_first.append(windows)  # its name has no version: the probe reads it
    return [(path, "system") for path in newest_first]


def outdated_libraries() -> list[Path]:
    """Return system libraries that are never tried because their name contains an unsuitable version."""
    return sorted(path for path, version in _installed().items() if 0 < version < MINIMUM_VERSION)


def _installed() -> dict[Path, int]:
    """Return system libraries with the versions in their names."""
    found: dict[Path, int] = {}
    for pattern in (*_SYSTEM_GLOBS, f"{sys.prefix}/lib/libLLVM*.so*"):
        for name in glob.glob(pattern):
            path = Path(name).resolve()
            if path.is_file() and path.stat().st_size > _MINIMUM_BYTES:
                found[path] = max(version_in_path(f"{name} {path}"), found.get(path, 0))
    return found


def version_in_path(text: str) -> int:
    """Return the LLVM major version in a file name or path, or 0 if there is none."""
    versions = [int(part) for match in _VERSION_IN_PATH.findall(text) for part in match if part]
    return max(versions, default=0)


def _missing_links(library: Path) -> tuple[Path, ...]:
    """Return the C++ runtime libraries to preload if the wheel's symbolic links to them are missing.

    karellen-llvm-core creates its links at the first start of the Python it was installed with, so they are
    missing after an installation by another tool or user. A loaded library of the same soname replaces them.
    """
    for folder in library.parent.glob("*-linux-gnu*"):
        if (folder / "libc++.so.1.0").is_file() and not (folder / "libc++.so.1").exists():
            names = ("libunwind.so.1.0", "libc++abi.so.1.0", "libc++.so.1.0")
            return tuple(folder / name for name in names if (folder / name).is_file())
    return ()


def probe(candidate: Candidate, timeout: float = 60.0) -> ProbeResult:
    """Test in a child process whether Dr.Jit works with the library; successes are stored on disk."""

    def compile_kernel() -> ProbeResult:
        with tempfile.TemporaryDirectory(prefix="rsbench-probe-") as scratch:
            environ = {"DRJIT_LIBLLVM_PATH": str(candidate.path), "DRJIT_CACHE_DIR": scratch}
            verdict = run_child(_PROBE, [str(library) for library in candidate.preload], environ, timeout)
        if verdict.ok and int(verdict.version.split(".")[0]) < MINIMUM_VERSION:
            return ProbeResult(ok=False, reason=f"is LLVM {verdict.version}; {MINIMUM_VERSION} or newer is needed")
        return verdict

    machine = f"{importlib.metadata.version('drjit')}|{cpu_key()}"
    return remembered("llvm", candidate.path, machine, compile_kernel)


def remembered(kind: str, library: Path, machine: str, probe: Callable[[], ProbeResult]) -> ProbeResult:
    """Return the result of a probe; it is not repeated after a success with this library on this machine."""
    try:
        status = library.stat()
    except OSError as error:
        return ProbeResult(ok=False, reason=f"cannot be opened ({error.strerror})")
    key = f"{kind}|{library}|{status.st_mtime_ns}|{status.st_size}|{machine}"
    known = recall(key)
    if known is not None:
        return ProbeResult(ok=True, version=known)
    verdict = probe()
    if verdict.ok:
        remember(key, verdict.version)
    return verdict


def run_child(code: str, arguments: Sequence[str], environ: Mapping[str, str], timeout: float) -> ProbeResult:
    """Run Python code in a child process; success is exit code 0 and ``version ...`` as its last line.

    ``-P`` excludes the working directory from the child's path, which is otherwise that of this process. On Linux
    the child ends with this process, even if this process is killed.
    """
    path = os.pathsep.join(folder for folder in sys.path if folder)
    try:
        with lifeline() as line:
            done = subprocess.run(
                [sys.executable, "-P", "-c", _BOUND.format(line=line) + code, *arguments],
                env={**os.environ, "PYTHONPATH": path, **environ},
                capture_output=True,
                text=True,
                errors="replace",
                timeout=timeout,
                stdin=subprocess.DEVNULL,
                check=False,
                start_new_session=True,
                pass_fds=(line,) if line >= 0 else (),
            )
    except subprocess.TimeoutExpired:
        return ProbeResult(ok=False, reason=f"gave no answer within {timeout:g} s")
    except OSError as error:
        return ProbeResult(ok=False, reason=f"child process did not start ({error})")
    lines = done.stdout.strip().splitlines()
    if done.returncode == 0 and lines and lines[-1].startswith("version"):
        return ProbeResult(ok=True, version=".".join(lines[-1].split()[1:]))
    if done.returncode < 0:
        return ProbeResult(ok=False, reason=f"killed its process (signal {-done.returncode})")
    printed = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    return ProbeResult(ok=False, reason=printed[-1][:200] if printed else f"exit code {done.returncode}")


def load(candidate: Candidate) -> None:
    """Make Dr.Jit use a probed library in this process; must come before Dr.Jit's first use of LLVM."""
    os.environ["DRJIT_LIBLLVM_PATH"] = str(candidate.path)
    for library in candidate.preload:
        ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)


def cpu_features() -> str:
    """Describe the instruction sets that determine Dr.Jit's vector width, such as ``x86_64 avx512f avx2``."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    flags = set(text.split())
    return " ".join([platform.machine(), *(flag for flag in ("avx512f", "avx2", "sve") if flag in flags)])
