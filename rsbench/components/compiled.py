"""Compiled functions: one decorator for the whole package, and the cache of their machine code.

Compiling takes tens of seconds on a slow machine, so the code is cached on disk: in ``NUMBA_CACHE_DIR`` if the
user set it, else in the user's cache folder, else in a temporary folder. Each version of the compiled sources has
its own folder there, because Numba checks only the file of the function that it loads, not those of the functions
that it calls. Each signature of a function has its own file, so that processes that compile at the same time write
the same files.

A package may contain code in ``SHIPPED`` that was compiled for ``PORTABLE_CPU``. It is loaded if there is no
other, and only on a processor with all its instructions, with the same Python, Numba and sources.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import os
import platform
import re
import tempfile
import time
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar, overload

from llvmlite import binding
from numba import config, njit
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.runtime import rtsys

from rsbench.components.imports import hash_of_files
from rsbench.storage.work_folder import temporary, user_cache

F = TypeVar("F", bound=Callable[..., object])

_LOGGER = logging.getLogger("rsbench")
_LONG_S = 1.0
_KEPT_DAYS = 30
_VERSION = re.compile(r"[0-9a-f]{16}")
"""Names of the folders of source versions."""
SHIPPED = "_compiled"
"""Folder of the package with portable code, as a cache folder; ``rsbench compile --portable`` writes it."""
PORTABLE_CPU = "x86-64-v3"
"""LLVM's name of the processor of portable code: most x86 processors since 2013 to 2015."""
_PORTABLE_NEEDS = (
    *("cx16", "popcnt", "sahf", "sse3", "ssse3", "sse4.1", "sse4.2"),
    *("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"),
)
"""LLVM's names of the features of that processor beyond x86-64 (psABI, level 3)."""
_MARKS = (b"@compiled", b"MotionKernel")
"""Marks of files with compiled code; the version is the hash of all such files."""


@overload
def compiled(function: F) -> F: ...
@overload
def compiled(**options: Any) -> Callable[[F], F]: ...
def compiled(function: F | None = None, **options: Any) -> F | Callable[[F], F]:
    """Decorate a function to be compiled at its first call and cached; ``options`` are those of ``numba.njit``."""
    if function is None:
        return functools.partial(compiled, **options)
    dispatcher = njit(nogil=True, no_cfunc_wrapper=True, **options)(function)
    dispatcher._cache = _KernelCache(function)
    out: F = dispatcher
    return out


class _Locator:
    """Numba's locator of a function in the cache; the folder is determined by ``cache_folder`` alone."""

    def __init__(self, py_func: Callable[..., object], py_file: str) -> None:
        self._py_file = py_file
        self._line = py_func.__code__.co_firstlineno

    @classmethod
    def from_function(cls, py_func: Callable[..., object], py_file: str) -> _Locator:
        return cls(py_func, py_file)

    def get_disambiguator(self) -> str:
        return str(self._line)


class _Implementation(CompileResultCacheImpl):
    _locator_classes = (_Locator,)


class _KernelCache(FunctionCache):
    """Numba's cache of one function, with one index per signature; an unreadable file is written again."""

    def __init__(self, py_func: Callable[..., object]) -> None:
        self._name, self._py_func = repr(py_func), py_func
        self._impl = _Implementation(py_func)
        self.enable()

    @property
    def cache_path(self) -> str:
        return str(cache_folder() or "")

    def flush(self) -> None:
        """Do nothing, because another version of the sources has another folder."""

    def _file(self, folder: Path | None, sig: tuple[Any, ...], key: Any) -> IndexDataCacheFile | None:
        # The hash of the folder does not cover the code of a foreign type.
        if folder is None or not self._enabled or any(getattr(kind, "foreign", False) for kind in sig):
            return None
        signature = hashlib.sha256(repr(key).encode()).hexdigest()[:16]
        return IndexDataCacheFile(str(folder), f"{self._impl.filename_base}-{signature}", source_version())

    def load_overload(self, sig: tuple[Any, ...], target_context: Any) -> Any:
        """Load cached code without loading Numba's compiler, which takes as long as a solve."""
        rtsys.initialize(target_context)  # memory of arrays
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)

    def _load_overload(self, sig: tuple[Any, ...], target_context: Any) -> Any:
        key = self._index_key(sig, target_context.codegen())
        triple = key[1][0]
        places = ((cache_folder(), key), (shipped_folder(), (key[0], (triple, PORTABLE_CPU, ""), *key[2:])))
        for folder, wanted in places:
            file = self._file(folder, sig, wanted)
            try:
                found = None if file is None else file.load(wanted)
                if found is not None:
                    return self._impl.rebuild(target_context, found)
            except Exception:  # incomplete, or of another Numba: it is compiled again
                continue
        _STOPWATCH.begin()
        return None

    def _save_overload(self, sig: tuple[Any, ...], data: Any) -> None:
        _STOPWATCH.end()
        key = self._index_key(sig, data.codegen)
        file = self._file(cache_folder(), sig, key)
        if file is None or not self._impl.check_cachable(data):
            return
        try:
            file.save(key, self._impl.reduce(data))
        except OSError as error:  # a full disk
            _LOGGER.debug("compiled code not kept: %s", error)


class _Stopwatch:
    """Warns once, in one line, if compiling takes long."""

    def __init__(self) -> None:
        self.depth, self.started, self.seconds, self.warned = 0, 0.0, 0.0, False

    def begin(self) -> None:
        """Start timing the compilation of a function; functions that it calls are compiled within this time."""
        now = time.perf_counter()
        if self.depth == 0:
            self.started = now
        elif not self.warned and self.seconds + now - self.started > _LONG_S:
            self.warned = True
            _LOGGER.warning("rsbench: compiling, once per installation: up to a minute")
        self.depth += 1

    def end(self) -> None:
        self.depth = max(0, self.depth - 1)
        if self.depth == 0:
            self.seconds += time.perf_counter() - self.started


_STOPWATCH = _Stopwatch()


@functools.cache
def source_version() -> str:
    """Return the hash of all source files of rsbench with compiled code."""
    package = Path(str(resources.files("rsbench")))
    # By text, not by ``Path``, since each command does this before it loads compiled code.
    files = (f"{folder}/{name}" for folder, _, names in os.walk(package) for name in names if name.endswith(".py"))
    return hash_of_files(package, sorted(Path(file) for file in files if _holds_compiled_code(file)))


def _holds_compiled_code(file: str) -> bool:
    with open(file, "rb", buffering=0) as opened:
        text = opened.read()
    return any(mark in text for mark in _MARKS)


@functools.cache
def cache_folder() -> Path | None:
    """Return the cache folder for the present sources, created if missing; None if it is not writable."""
    for base in (Path(config.CACHE_DIR) if config.CACHE_DIR else None, user_cache(), temporary()):
        if base is None:
            continue
        folder = base / "kernels" / source_version()[:16]
        try:
            new = not folder.is_dir()
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError:
            continue
        if new:
            _remove_old(folder)
        return folder
    return None


@functools.cache
def shipped_folder() -> Path | None:
    """Return the folder of portable code for the present sources; None if missing or unusable here."""
    folder = Path(str(resources.files("rsbench"))) / SHIPPED / "kernels" / source_version()[:16]
    return folder if folder.is_dir() and runs_portable_code() else None


def runs_portable_code() -> bool:
    """Return whether processor and operating system support all features that portable code may use."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return False
    features = binding.get_host_cpu_features()
    return all(features.get(name, False) for name in _PORTABLE_NEEDS)


def _remove_old(folder: Path) -> None:
    """Remove folders of other versions that have not changed for a month, and nothing else."""
    oldest = time.time() - _KEPT_DAYS * 86400
    for other in folder.parent.iterdir():
        with contextlib.suppress(OSError):  # another process removed it first
            if other == folder or not _VERSION.fullmatch(other.name) or other.lstat().st_mtime > oldest:
                continue
            for file in [] if other.is_symlink() else [*other.glob("*.nbi"), *other.glob("*.nbc")]:
                file.unlink()
            other.rmdir()
