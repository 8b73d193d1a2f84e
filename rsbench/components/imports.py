"""Other packages' code: classes by ``package.module:Class``, entry points, and hashes of their sources.

Modules that are installed or beside a card are imported in a child process first, which they may end or block.
Their exceptions become one line. Equal component keys mean equal answers, whatever the file or name of a
component.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import functools
import hashlib
import importlib
import importlib.util
import inspect
import json
import math
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from importlib import metadata, resources
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

from rsbench.core.errors import RsbenchError

_NUMERIC_ROOMS = ("core", "solvers", "vision", "capture", "pipeline")
"""Packages whose source determines the answers of rsbench's components."""
_NUMERIC_FILES = ("components/compiled.py", "components/motion_kernels.py", "components/motion_models.py")
"""Further modules of this kind outside these packages."""


def component_key(component: object, parameters: Mapping[str, Any]) -> str:
    """Hash of a component's class, source, parameters, and the keys of the components inside it.

    The parameters of a dataclass are all its fields, so that a changed default changes the key; those of another
    class are the ones in its card.
    """
    cls = type(component)
    if dataclasses.is_dataclass(component) and not isinstance(component, type):
        parameters = {f.name: getattr(component, f.name) for f in dataclasses.fields(component) if f.init}
    identity = {
        "class": f"{cls.__module__}:{cls.__qualname__}",
        "source": source_version(cls),
        "parameters": dict(parameters),
        "inner": list(getattr(component, "inner_keys", ())),
    }
    return hashlib.sha256(json.dumps(identity, sort_keys=True, default=_text).encode()).hexdigest()


def _text(value: object) -> str:
    """Text of a value that JSON cannot represent, without its memory address, which differs in every run."""
    return re.sub(r" at 0x[0-9a-fA-F]+", "", repr(value))


def source_version(cls: type) -> str:
    """Hash of the source that determines a class's answers.

    For rsbench's classes this is all of its numerical code, for another package's the whole package, for a single
    file this file and the files beside it that it imports.
    """
    module = cls.__module__
    if module.partition(".")[0] == "rsbench":
        return own_source_version()
    try:
        file = inspect.getsourcefile(cls)
    except TypeError:  # built in, or made in a shell
        file = None
    if file is None or not Path(file).is_file():
        return f"{module}: no source"
    root = sys.modules.get(module.partition(".")[0])
    if root is not None and getattr(root, "__file__", None) and hasattr(root, "__path__"):
        folder = Path(str(root.__file__)).parent
        return hash_of_files(folder.parent, sorted(folder.rglob("*.py")))
    return hash_of_files(Path(file).parent, with_neighbours(Path(file)))


def with_neighbours(file: Path) -> list[Path]:
    """A file and the modules and packages beside it that it imports, directly or not, sorted."""
    found: set[Path] = set()
    todo = [file]
    while todo:
        path = todo.pop()
        if path in found or not path.is_file():
            continue
        found.add(path)
        for name in _imported(path):
            todo.append(file.parent / f"{name}.py")
            todo += (file.parent / name).rglob("*.py")
    return sorted(found)


def _imported(file: Path) -> set[str]:
    """First parts of the names of the modules that a file imports anywhere."""
    try:
        tree = ast.parse(file.read_bytes())
    except SyntaxError:
        return set()
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module.partition(".")[0])
    return names


@functools.cache
def own_source_version() -> str:
    """Hash of rsbench's sources that determine the answers of solvers, matchers and correctors."""
    package = Path(str(resources.files("rsbench")))
    rooms = [path for room in _NUMERIC_ROOMS for path in (package / room).rglob("*.py")]
    return hash_of_files(package, sorted([*rooms, *(package / name for name in _NUMERIC_FILES)]))


def hash_of_files(folder: Path, files: list[Path]) -> str:
    text = "\n".join(f"{path.relative_to(folder).as_posix()} {file_hash(path)}" for path in files)
    return hashlib.sha256(text.encode()).hexdigest()


def file_hash(path: Path) -> str:
    """SHA-256 of a file's bytes. Children that test imports load this module, so it does not import NumPy."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def entry_points_by_name(group: str) -> dict[str, list[metadata.EntryPoint]]:
    """Entry points of a group; different ones may have one name. Loads nothing."""
    found: dict[str, list[metadata.EntryPoint]] = {}
    for point in points_of(group, tuple((folder, _changed(folder)) for folder in sys.path)):
        same = found.setdefault(point.name, [])
        if all(other.value != point.value for other in same):
            same.append(point)
    return found


def package_of(point: metadata.EntryPoint) -> str:
    """The package's name."""
    try:
        name = point.dist.name if point.dist is not None else None
    except Exception:  # metadata of the package are missing or cannot be read
        name = None
    return name or "a package"


@lru_cache(maxsize=16)
def points_of(group: str, folders: tuple[tuple[str, int], ...]) -> Sequence[metadata.EntryPoint]:
    """Entry points of a group, cached while ``folders`` (of ``sys.path``, with times of change) are equal.

    A package whose metadata cannot be read has none.
    """
    try:
        return tuple(metadata.entry_points(group=group))
    except Exception:
        points, seen = list[metadata.EntryPoint](), set[str]()
        for package in metadata.distributions():
            with contextlib.suppress(Exception):
                if (name := str(package.metadata["Name"]).lower()) not in seen:
                    points += [point for point in package.entry_points if point.group == group]
                    seen.add(name)
        return points


def _changed(folder: str) -> int:
    """When a folder last changed, ns."""
    try:
        return os.stat(folder or ".").st_mtime_ns
    except OSError:
        return 0


IMPORT_LIMIT = "RSBENCH_IMPORT_LIMIT_S"
"""Environment variable: time limit for the import of another package's module, seconds."""
_LIMIT_S = 60.0
_POSIX = os.name == "posix"
_IMPORTED = 173
"""Exit code of the child process after a module was imported; no module is likely to choose it."""
_COMMAND = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from rsbench.components.imports import import_and_end; "
    "import_and_end(sys.argv[2], float(sys.argv[3]), int(sys.argv[4]))"
)
_expendable = False
_beside_cards: dict[str, tuple[Path, str]] = {}
"""Modules imported from the folders of cards: file, and its hash at that time."""
_threads: list[threading.Thread] = []
"""Threads that other packages' code started."""
_folders: list[str] = []
"""Folders of cards on ``sys.path``, the last used first."""
_RENAMED = {
    "rsbench.solvers.affine_parameters": "rsbench.solvers.free_velocities",
    "rsbench.solvers.dai": "rsbench.solvers.free_velocities",
    "rsbench.solvers.eight_point": "rsbench.solvers.essential_matrix",
    "rsbench.solvers.gyro": "rsbench.solvers.gyro_and_gravity",
    "rsbench.solvers.iterated": "rsbench.solvers.linear",
    "rsbench.solvers.line_triplets": "rsbench.solvers.triplets",
    "rsbench.solvers.opencv_five_point": "rsbench.solvers.essential_matrix",
    "rsbench.solvers.p3p": "rsbench.solvers.poselib",
    "rsbench.solvers.poselib_mono": "rsbench.solvers.poselib",
    "rsbench.solvers.poselib_pnp": "rsbench.solvers.poselib",
    "rsbench.solvers.poselib_stereo": "rsbench.solvers.poselib",
    "rsbench.solvers.scaled": "rsbench.solvers.zhuang",
    "rsbench.solvers.twelve_parameters": "rsbench.solvers.free_velocities",
    "rsbench.solvers.upright": "rsbench.solvers.gyro_and_gravity",
}
"""Present modules of classes that users' cards may name by a former module."""


@contextlib.contextmanager
def blaming(where: str, what: str) -> Iterator[None]:
    """Turn exceptions of other packages' code into one line with its name; its output goes to stderr.

    Its threads do not keep the command from ending, see ``abandoned_threads``.
    """
    before = set(threading.enumerate())
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    except RecursionError:  # the caller reports the circle
        raise
    except (Exception, SystemExit) as error:
        text = str(error).partition("\n")[0] if isinstance(error, RsbenchError) else exception_text(error)
        remedy = "; install the package that has it" if isinstance(error, ModuleNotFoundError) else ""
        raise RsbenchError(f"{where}: {what}: {text}{remedy}") from error
    finally:
        _threads.extend(each for each in threading.enumerate() if each not in before and not each.daemon)


def exception_text(error: BaseException) -> str:
    """Type and text of an error, in one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def import_file(file: Path) -> ModuleType:
    """The module of a Python file, which may import others beside it.

    Raises:
        RsbenchError: no such file, not a name of a module, or an exception of the import: one line.
    """
    if not file.is_file():
        raise RsbenchError(f"{file}: no such file")
    if not file.stem.isidentifier():
        raise RsbenchError(f"{file}: is imported, so its name must be of letters, digits and '_': rename it")
    with blaming(str(file), "cannot be imported"):
        return _import_beside(file.stem, file.parent.resolve())


def import_target(target: str, folder: Path | None, where: str) -> object:
    """The object ``package.module:Class`` of an installed module or of one in a folder."""
    module, _, name = target.partition(":")
    module = _RENAMED.get(module, module)
    if not all(part.isidentifier() for part in [*module.split("."), name]):
        raise RsbenchError(f"{where}: must be 'package.module:Class'")
    with blaming(where, "cannot be imported"):
        if folder is None or module.partition(".")[0] == "rsbench":
            try_import(module)
            return getattr(importlib.import_module(module), name)
        return getattr(_import_beside(module, folder.resolve()), name)


def abandoned_threads() -> bool:
    """Whether threads of other packages' code are alive, for which Python would wait at exit."""
    return any(thread.is_alive() for thread in _threads)


def try_import(module: str, version: str = "") -> None:
    """Import another package's module in a child process first, so that it cannot end or block this one.

    An exception there is ignored: the import here raises it again. Each version of a module is tested once;
    modules of rsbench and imported ones are not tested.

    Raises:
        ImportError: the child ended or took too long.
    """
    if _expendable or module.partition(".")[0] == "rsbench" or module in sys.modules:
        return
    if fate := _fate(module, version):
        raise ImportError(f"importing {module} {fate}")


@functools.cache
def _fate(module: str, version: str) -> str:
    from rsbench.storage.untrusted_files import positive_variable

    limit_s = positive_variable(IMPORT_LIMIT, _LIMIT_S, " of seconds")
    path = json.dumps([str(entry) for entry in sys.path])
    with lifeline() as line:
        process = start_child(_COMMAND, path, module, str(limit_s), line=line)
        try:
            code = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            return f"took longer than {limit_s:g} s ({IMPORT_LIMIT} allows more)"
        finally:
            kill_group(process)
            process.wait()
    return "" if code == _IMPORTED else ending(code)


def start_child(
    code: str,
    *arguments: str,
    line: int,
    stream: int = subprocess.DEVNULL,
    environment: Mapping[str, str] | None = None,
) -> subprocess.Popen[bytes]:
    """Start Python code in a process group of its own, to which a terminal's Ctrl-C does not go.

    Args:
        code: its last argument is ``line``.
        line: see ``lifeline``; -1 for a child that outlives this process.
        stream: ``subprocess.DEVNULL`` or ``PIPE``, for all three standard streams.
        environment: that of this process when None.
    """
    return subprocess.Popen(
        [sys.executable, "-u", "-c", code, *arguments, str(line)],
        stdin=stream,
        stdout=stream,
        stderr=stream,
        start_new_session=True,
        env=environment,
        pass_fds=(line,) if _POSIX and line >= 0 else (),
    )


def kill_group(process: subprocess.Popen[bytes]) -> None:
    """Kill a process of ``start_child`` and all of its group."""
    if _POSIX:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    process.kill()


def import_and_end(module: str, limit_s: float, line: int) -> NoReturn:
    """In the child process: import a module and end, with the exit code ``_IMPORTED``."""
    if _POSIX:
        signal.alarm(math.ceil(limit_s) + 1)  # in case the parent is gone, where ``end_with`` does nothing
        end_with(line)
    with contextlib.suppress(BaseException):
        importlib.import_module(module)
    os._exit(_IMPORTED)


@contextlib.contextmanager
def lifeline() -> Iterator[int]:
    """A descriptor for a child to inherit and to pass to ``end_with``; -1 where the system has none."""
    if not _POSIX:
        yield -1
        return
    reader, writer = os.pipe()
    try:
        yield reader
    finally:
        os.close(reader)
        os.close(writer)


def end_with(line: int) -> None:
    """In a child that leads its process group: let Linux kill the group when the parent is gone.

    However the parent ends, its end of the pipe is closed; this works even while code loops that holds Python's
    lock.
    """
    if sys.platform == "linux":
        import fcntl
        import select

        with contextlib.suppress(OSError):
            fcntl.fcntl(line, fcntl.F_SETOWN, -os.getpgrp())
            fcntl.fcntl(line, fcntl.F_SETSIG, signal.SIGKILL)
            fcntl.fcntl(line, fcntl.F_SETFL, fcntl.fcntl(line, fcntl.F_GETFL) | os.O_ASYNC)
            if select.select([line], [], [], 0.0)[0]:  # the parent is gone already
                os.killpg(os.getpgrp(), signal.SIGKILL)


def import_untried() -> None:
    """Import without a test in a child: other packages' code may end this process."""
    global _expendable
    _expendable = True


def ending(code: int) -> str:
    """How a process ended, by its exit code."""
    if code >= 0:
        return f"ended its process with exit code {code}"
    try:
        return f"killed by signal {-code} ({signal.Signals(-code).name})"
    except ValueError:
        return f"killed by signal {-code}"


def search(card: Path) -> None:
    """Allow the import of modules beside a card, in child processes too."""
    _put_on_path(str(card.parent.resolve()))


def _import_beside(module: str, folder: Path) -> ModuleType:
    """Import a module that is installed or lies in a folder.

    The folder stays on the path, after installed packages, for later imports, in child processes too. A changed
    module is imported again.
    """
    _put_on_path(str(folder))
    _forget_changed(folder)
    importlib.invalidate_caches()
    first = folder / module.partition(".")[0]
    beside = next((path for path in (first.with_suffix(".py"), first / "__init__.py") if path.is_file()), None)
    if beside is not None:
        _refuse_other(first.name, beside)
    try_import(module, "".join(map(file_hash, with_neighbours(beside))) if beside is not None else "")
    before = set(sys.modules)
    found = importlib.import_module(module)
    for name in set(sys.modules) - before:
        file = _file_of(name)
        if file is not None and file.is_relative_to(folder):
            _beside_cards[name] = file, file_hash(file)
    for file in with_neighbours(beside) if beside is not None else ():
        if file.parent == folder and file.stem in sys.modules:
            _refuse_other(file.stem, file)
    return found


def _put_on_path(folder: str) -> None:
    """Put a folder at the end of the path, before the folders of other cards."""
    if folder in sys.path and folder not in _folders:
        return
    if folder in _folders:
        _folders.remove(folder)
    sys.path[:] = [entry for entry in sys.path if entry not in (folder, *_folders)] + [folder, *_folders]
    _folders.insert(0, folder)


def _forget_changed(folder: Path) -> None:
    """Remove the modules of a folder from Python's if the file of one of them has changed."""
    mine = {name: file for name, (file, _) in _beside_cards.items() if file.is_relative_to(folder)}
    if any(not file.is_file() or file_hash(file) != _beside_cards[name][1] for name, file in mine.items()):
        for name in mine:
            del _beside_cards[name]
            sys.modules.pop(name, None)


def _refuse_other(name: str, beside: Path) -> None:
    """Raise ImportError if a module beside a card has the name of another module."""
    if name in sys.modules:
        other = _file_of(name)
    else:
        spec = importlib.util.find_spec(name)
        other = Path(spec.origin).resolve() if spec is not None and spec.has_location and spec.origin else None
    if other is not None and other != beside.resolve():
        raise ImportError(f"module {name!r} is taken by {other}: rename {beside.name}")


def _file_of(module: str) -> Path | None:
    file = getattr(sys.modules.get(module), "__file__", None)
    return Path(file).resolve() if file else None


@contextlib.contextmanager
def signals_later() -> Iterator[None]:
    """Delay the handlers of Ctrl-C and SIGTERM until after the block.

    Native code, such as Mitsuba, may crash if a handler raises during its import.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # handlers run in the main thread alone
        return
    received = list[int]()
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    handlers = {number: handler for number, handler in before.items() if callable(handler)}
    for number in handlers:
        signal.signal(number, lambda number, _: received.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number in received:
            signal.raise_signal(number)
