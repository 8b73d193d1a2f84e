"""Other packages' code: classes by ``package.module:Class``, entry points, and the hash of the source behind them.

Code is imported from what is installed or lies beside a card, first in a child process, which it may end or block.
What it raises becomes one line. Equal component keys mean equal answers, whatever file or name a component came
from.
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
from typing import Any, NoReturn

from rsbench.core.errors import RsbenchError

_NUMERIC_ROOMS = ("core", "solvers", "vision", "capture", "pipeline")
"""Packages whose source decides what a component of ours answers."""
_NUMERIC_FILES = ("components/compiled.py", "components/motion_kernels.py", "components/motion_models.py")
"""Modules outside these packages of which that is true too."""


def component_key(component: object, parameters: Mapping[str, Any]) -> str:
    """Hash of a component's class, source, parameters, and the keys of the components inside it.

    A dataclass's parameters are all its fields, so that a changed default is a change; another object's are what
    its card gave.
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
    """A value that JSON does not know, without its address in memory, which differs in every run."""
    return re.sub(r" at 0x[0-9a-fA-F]+", "", repr(value))


def source_version(cls: type) -> str:
    """Hash of the source that a class's answers come from.

    All of rsbench's numerics for its own; the whole package of another's; for a single file, that file and the
    files beside it that it imports.
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
    """A file, and the modules and packages beside it that it imports, and those that they import, sorted."""
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
    """Hash of rsbench's own sources that decide what solvers, matchers and correctors answer."""
    package = Path(str(resources.files("rsbench")))
    rooms = [path for room in _NUMERIC_ROOMS for path in (package / room).rglob("*.py")]
    return hash_of_files(package, sorted([*rooms, *(package / name for name in _NUMERIC_FILES)]))


def hash_of_files(folder: Path, files: list[Path]) -> str:
    text = "\n".join(f"{path.relative_to(folder).as_posix()} {file_hash(path)}" for path in files)
    return hashlib.sha256(text.encode()).hexdigest()


def file_hash(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def entry_points_by_name(group: str) -> dict[str, list[metadata.EntryPoint]]:
    """Entry points of a group; of one name more than one, where they differ. Loads nothing."""
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
    except Exception:  # files about the package are missing or cannot be read
        name = None
    return name or "a package"


@lru_cache(maxsize=16)
def points_of(group: str, folders: tuple[tuple[str, int], ...]) -> Sequence[metadata.EntryPoint]:
    """Entry points of a group while ``folders``, those of ``sys.path`` and when they changed, stay the same.

    A package whose files about itself cannot be read has none, and stops no other.
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
    """When something was last put into a folder, or taken out; ns."""
    try:
        return os.stat(folder or ".").st_mtime_ns
    except OSError:
        return 0


IMPORT_LIMIT = "RSBENCH_IMPORT_LIMIT_S"
"""Variable of the environment: seconds in which another package's module must be imported."""
_LIMIT_S = 60.0
_POSIX = os.name == "posix"
_IMPORTED = 173
"""Exit code of a process in which a module was tried, that no module is likely to choose."""
_COMMAND = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from rsbench.components.imports import import_and_end; "
    "import_and_end(sys.argv[2], float(sys.argv[3]), int(sys.argv[4]))"
)
_expendable = False
_beside_cards: dict[str, tuple[Path, str]] = {}
"""Modules that were imported from beside a card: file, and its hash when it was imported."""
_threads: list[threading.Thread] = []
"""Those that others' code started."""
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
"""Modules that users' cards may name and whose classes have moved: the module of each now."""


@contextlib.contextmanager
def blaming(where: str, what: str) -> Iterator[None]:
    """What others' code raises becomes one line with its name; what it prints stays out of answers on stdout.

    Threads that it starts do not keep the command from ending, see ``abandoned_threads``.
    """
    before = set(threading.enumerate())
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    except RecursionError:  # whoever closed the circle says so
        raise
    except (Exception, SystemExit) as error:
        text = str(error).partition("\n")[0] if isinstance(error, RsbenchError) else in_words(error)
        raise RsbenchError(f"{where}: {what}: {text}") from error
    finally:
        _threads.extend(each for each in threading.enumerate() if each not in before and not each.daemon)


def in_words(error: BaseException) -> str:
    """Type and text of an error, in one line."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def import_target(target: str, folder: Path | None, where: str) -> object:
    """What ``package.module:Class`` names; modules in a folder are found too."""
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
    """Whether threads run that others' code started, and for which Python would wait at its end."""
    return any(thread.is_alive() for thread in _threads)


def try_import(module: str, version: str = "") -> None:
    """Import another package's module in a process of its own first, so that it cannot end or stop this one.

    What it raises there is left to the import here. Each version of a module is tried once, and none that is
    rsbench's own, or imported already.

    Raises:
        ImportError: what became of the process.
    """
    if _expendable or module.partition(".")[0] == "rsbench" or module in sys.modules:
        return
    if fate := _fate(module, version):
        raise ImportError(f"importing {module} {fate}")


@functools.cache
def _fate(module: str, version: str) -> str:
    limit_s, path = _import_limit(), json.dumps([str(entry) for entry in sys.path])
    with lifeline() as line:
        process = subprocess.Popen(
            [sys.executable, "-c", _COMMAND, path, module, str(limit_s), str(line)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # its own process group
            pass_fds=(line,) if _POSIX else (),
        )
        try:
            code = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            return f"took longer than {limit_s:g} s ({IMPORT_LIMIT} allows more)"
        finally:
            if _POSIX:
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.killpg(process.pid, signal.SIGKILL)
            process.kill()
            process.wait()
    return "" if code == _IMPORTED else ending(code)


def _import_limit() -> float:
    text = os.environ.get(IMPORT_LIMIT, "")
    with contextlib.suppress(ValueError):
        if math.isfinite(limit_s := float(text or _LIMIT_S)) and limit_s > 0.0:
            return limit_s
    raise RsbenchError(f"{IMPORT_LIMIT} = {text!r}: must be a positive number of seconds")


def import_and_end(module: str, limit_s: float, line: int) -> NoReturn:
    """In a process of its own: import a module, and say by the exit code that this came to an end."""
    if _POSIX:
        signal.alarm(math.ceil(limit_s) + 1)  # should the parent be gone by then, where ``end_with`` does nothing
        end_with(line)
    with contextlib.suppress(BaseException):
        importlib.import_module(module)
    os._exit(_IMPORTED)


@contextlib.contextmanager
def lifeline() -> Iterator[int]:
    """A descriptor for a child to inherit and to give to ``end_with``; -1 where there are none."""
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
    """In a child that leads its group: let Linux kill the group when the parent is gone.

    Even while code that holds Python's lock loops, and whatever the parent's end was: the other end of the pipe is
    closed then.
    """
    if sys.platform == "linux":
        import fcntl
        import select

        with contextlib.suppress(OSError):
            fcntl.fcntl(line, fcntl.F_SETOWN, -os.getpgrp())
            fcntl.fcntl(line, fcntl.F_SETSIG, signal.SIGKILL)
            fcntl.fcntl(line, fcntl.F_SETFL, fcntl.fcntl(line, fcntl.F_GETFL) | os.O_ASYNC)
            if select.select([line], [], [], 0.0)[0]:  # it was gone before
                os.killpg(os.getpgrp(), signal.SIGKILL)


def import_untried() -> None:
    """From now on nothing is tried first: this process is one that others' code may end."""
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
    """Find modules beside a card too, in child processes as well, whatever in it names them."""
    _put_on_path(str(card.parent.resolve()))


def _import_beside(module: str, folder: Path) -> object:
    """Import a module that is installed or lies in a folder.

    The folder stays on the path, after everything that is installed, for what is imported later, in child
    processes too. A module that changed since it was imported is imported anew.
    """
    _put_on_path(str(folder))
    _forget_changed(folder)
    importlib.invalidate_caches()
    first = folder / module.partition(".")[0]
    beside = next((path for path in (first.with_suffix(".py"), first / "__init__.py") if path.is_file()), None)
    if beside is not None:
        _refuse_other(first.name, beside)
    try_import(module, "".join(file_hash(file) for file in with_neighbours(beside)) if beside is not None else "")
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
    """At the end of the path, before the folders of other cards."""
    if folder in sys.path and folder not in _folders:
        return
    if folder in _folders:
        _folders.remove(folder)
    sys.path[:] = [entry for entry in sys.path if entry not in (folder, *_folders)] + [folder, *_folders]
    _folders.insert(0, folder)


def _forget_changed(folder: Path) -> None:
    """Drop the modules of a folder when the file of one of them changed."""
    mine = {name: file for name, (file, _) in _beside_cards.items() if file.is_relative_to(folder)}
    if any(not file.is_file() or file_hash(file) != _beside_cards[name][1] for name, file in mine.items()):
        for name in mine:
            del _beside_cards[name]
            sys.modules.pop(name, None)


def _refuse_other(name: str, beside: Path) -> None:
    """A module beside a card must not be taken for one of the same name from elsewhere."""
    if name in sys.modules:
        other = _file_of(name)
    else:
        spec = importlib.util.find_spec(name)
        other = Path(spec.origin).resolve() if spec is not None and spec.has_location and spec.origin else None
    if other is not None and other != beside.resolve():
        raise ImportError(f"module {name!r} is taken by {other}: rename the one beside the card")


def _file_of(module: str) -> Path | None:
    file = getattr(sys.modules.get(module), "__file__", None)
    return Path(file).resolve() if file else None


@contextlib.contextmanager
def signals_later() -> Iterator[None]:
    """Let handlers of Ctrl-C and SIGTERM run after the block.

    Native code may crash when they raise while it is imported, as Mitsuba now and then did.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # handlers run in the main thread alone
        return
    came = list[int]()
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    held = {number: handler for number, handler in before.items() if callable(handler)}
    for number in held:
        signal.signal(number, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for number, handler in held.items():
            signal.signal(number, handler)
        for number in came:
            signal.raise_signal(number)
