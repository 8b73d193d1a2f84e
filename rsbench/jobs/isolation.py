"""Run other packages' code in a child process: it may raise, exit, crash, hang or print without harm to the
parent.

A worker starts its child with the first call and keeps it for the next ones. A call that exceeds its time limit,
or whose child ends, gives a failed ``Outcome`` with the reason; the child is killed with all processes of its
group, and a fresh one serves the next call. What the child prints is captured. The child ends with its parent,
even if the parent is killed. This protects against mistakes, not against malice: the code runs with the user's
rights, and a process that leaves the group survives. With a limit of memory, the child's use is read ten times a
second (the address space cannot be limited instead: compilers and BLAS reserve far more of it than they use).

A child sends only plain data, none of which the parent executes: None, a truth value, a number, a text, an array,
or a tuple, list, dict or dataclass of these. A message is its length and an npz file: arrays, and JSON that refers
to them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from multiprocessing.reduction import ForkingPickler
from types import TracebackType
from typing import Any, BinaryIO, NoReturn

import numpy as np
from numpy.typing import NDArray

from rsbench.components.imports import (
    end_with,
    ending,
    exception_text,
    import_untried,
    kill_group,
    lifeline,
    start_child,
)
from rsbench.core.errors import RsbenchError
from rsbench.storage.untrusted_files import PLAIN_KINDS, unpack_arrays

THREAD_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
"""Environment variables that limit the threads of numerical libraries."""
ONE_THREAD = dict.fromkeys(THREAD_VARIABLES, "1")
"""Environment of a child process whose numerical libraries use one thread."""
START_LIMIT_S = 300.0
"""Time limit for loading a module and compiling its functions, seconds."""
NO_ANSWER = "gave no valid answer"
_POLL_S = 0.1
_LAST_ANSWER_S = 10.0
"""Time to read the answer of a process that has ended, seconds; reached only if a process left the group."""
_KEPT_BYTES = 8192
_LONGEST_REASON = 300
_POSIX = os.name == "posix"
_COMMAND = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from rsbench.jobs.isolation import serve_parent; serve_parent(int(sys.argv[2]))"
)
_LENGTH_BYTES = 8
_LONGEST_BYTES = 1 << 32
Server = Callable[..., object]
"""Answers one call, in the child: picklable arguments in, plain data out."""


class EntryFailure(Exception):  # noqa: N818  not an error of rsbench
    """Raised in a child for a fault of another package's code; the message is the reason."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """The result of one call."""

    value: Any
    """The answer, already decoded; None after a failure."""
    reason: str
    """Why the call failed; empty after a success."""
    output: str
    """The last part of what the child has printed so far."""
    ended: bool = False
    """Whether the process ended by itself or was killed from outside, perhaps not because of this call."""

    @property
    def success(self) -> bool:
        return not self.reason


class Cancelled(Exception):  # noqa: N818
    """Raised by a call whose worker is stopped."""


class IsolatedWorker:
    """A child process that answers calls from any thread, one at a time; use as a context manager."""

    def __init__(
        self,
        factory: Callable[..., Server],
        *arguments: object,
        classes: tuple[type, ...] = (),
        environment: Mapping[str, str] | None = None,
        cancel: threading.Event | None = None,
        memory_mb: float | None = None,
    ) -> None:
        """
        Args:
            factory: function of a module of rsbench that is called in the child with ``arguments`` and returns the
                function that answers calls. Both raise ``EntryFailure`` for faults of the entry.
            arguments: picklable arguments of the factory.
            classes: dataclasses that answers may contain.
            environment: environment variables of the child in addition to those of this process.
            cancel: event that ends calls with ``Cancelled`` once it is set, possibly by another thread.
            memory_mb: limit of the child's memory; not applied if the system does not report its use.
        """
        self._memory_mb = memory_mb
        self._start = (factory, arguments)
        self._classes = {cls.__name__: cls for cls in classes}
        self._environment = {**os.environ, **(environment or {})}
        self.cancel = cancel or threading.Event()
        """The argument ``cancel``; it may be replaced between calls."""
        self._child: _Child | None = None
        self._one_call = threading.Lock()

    def call(self, *arguments: object, limit_s: float) -> Outcome:
        """Call the child and return its answer, or the reason of a failure.

        Raises:
            RuntimeError: rsbench's own code in the child raised an exception.
            Cancelled: the event ``cancel`` is set.
        """
        with self._one_call:  # answers to two calls would be mixed up
            try:
                if self._child is not None and self._child.ended:
                    self.close()  # it died after its last answer: not a fault of this call
                if self._child is None:
                    self._child = _Child(self._environment)
                    started = self._exchange(self._start, START_LIMIT_S)
                    if not started.success:
                        self.close()
                        return replace(started, reason=f"did not start: {started.reason}")
                return self._exchange(arguments, limit_s)
            except BaseException:
                self.close()  # a late answer must not be read by the next call
                raise

    def close(self) -> None:
        """End the child."""
        if self._child is not None:
            self._child.kill()
            self._child = None

    def __enter__(self) -> IsolatedWorker:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, trace: TracebackType | None) -> None:
        self.close()

    def _exchange(self, message: object, limit_s: float) -> Outcome:
        assert self._child is not None
        child = self._child
        data, reason = child.exchange(bytes(ForkingPickler.dumps(message)), limit_s, self.cancel, self._memory_mb)
        value = None
        if data is not None:
            value, reason = self._read(data)
        else:
            self.close()
            last = child.output.strip().rpartition("\n")[2]
            reason += f"; it last printed: {_short(last)}" if last else ""
        ended = data is None and not child.overdue
        return Outcome(value=value, reason=reason, output=child.output, ended=ended)

    def _read(self, data: bytes) -> tuple[Any, str]:
        """Decode a message of the child to an answer and a reason of failure."""
        try:
            message = decode(data, self._classes)
        except ValueError as error:
            return None, f"{NO_ANSWER}: {one_line(error)}"
        if not (isinstance(message, tuple) and len(message) == 3 and isinstance(message[2], str)):
            return None, NO_ANSWER
        status, value, reason = message
        if status == "bug":
            raise RuntimeError(f"in a child process:\n{reason}")
        return value, reason


class _Child:
    """A child process with its pipes and the threads that read them."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self.overdue = False
        """Whether a call exceeded its limit of time or memory."""
        self._printed = b""
        path = json.dumps([str(entry) for entry in sys.path])
        with contextlib.ExitStack() as stack:
            line = stack.enter_context(lifeline())
            self._process = start_child(_COMMAND, path, line=line, stream=subprocess.PIPE, environment=environment)
            self._lifeline = stack.pop_all()
        self._answers: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._readers = [
            threading.Thread(target=read, daemon=True) for read in (self._read_answers, self._read_output)
        ]
        for reader in self._readers:
            reader.start()

    @property
    def ended(self) -> bool:
        return self._process.poll() is not None

    @property
    def output(self) -> str:
        return self._printed.decode("utf-8", errors="replace")

    def exchange(
        self, request: bytes, limit_s: float, cancel: threading.Event, memory_mb: float | None
    ) -> tuple[bytes | None, str]:
        """Send a request and return the answer, or None and the reason."""
        # A child that does not read must not block its parent.
        threading.Thread(target=self._send, args=(request,), daemon=True).start()
        end = time.monotonic() + limit_s
        while (left := end - time.monotonic()) > 0.0:
            if cancel.is_set():
                raise Cancelled
            if memory_mb is not None and self._used_mb() > memory_mb:
                self.overdue = True
                return None, f"used more than {memory_mb:g} MB of memory"
            if ended := self.ended:
                kill_group(self._process)  # its own children may keep the pipe open
            try:  # a process that ended may have answered before
                answer = self._answers.get(timeout=_LAST_ANSWER_S if ended else min(left, _POLL_S))
            except queue.Empty:
                if ended:
                    return None, self._ending()
                continue
            return (answer, "") if answer is not None else (None, self._ending())
        self.overdue = True
        return None, f"took longer than {limit_s:g} s"

    def _used_mb(self) -> float:
        """Return the memory of the process, MB, or 0 if the system does not report it."""
        try:
            with open(f"/proc/{self._process.pid}/statm", "rb") as file:
                pages = int(file.read().split()[1])
        except (OSError, ValueError, IndexError):
            return 0.0
        return pages * os.sysconf("SC_PAGE_SIZE") / (1 << 20)

    def kill(self) -> None:
        """Kill the process and its group, and wait until it has ended."""
        kill_group(self._process)
        self._process.wait()
        self._lifeline.close()
        for reader in self._readers:
            reader.join(_POLL_S)  # at once, unless a process that has left the group holds the pipe
        for stream, reader in zip((self._process.stdout, self._process.stderr), self._readers, strict=True):
            if not reader.is_alive() and stream is not None:
                stream.close()
        with contextlib.suppress(OSError, ValueError):
            if self._process.stdin is not None:
                self._process.stdin.close()

    def _ending(self) -> str:
        """Describe how the process ended; wait for at most a second."""
        try:
            code = self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            return "closed its connection"
        self._readers[1].join(_POLL_S)  # its last output
        return ending(code)

    def _send(self, request: bytes) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError, ValueError):  # the child is gone: the reader notices
            send(self._process.stdin, request)  # pyrefly: ignore[bad-argument-type]

    def _read_answers(self) -> None:
        stream: Any = self._process.stdout
        with contextlib.suppress(OSError, ValueError):
            while (answer := receive(stream)) is not None:
                self._answers.put(answer)
        self._answers.put(None)

    def _read_output(self) -> None:
        stream: Any = self._process.stderr
        with contextlib.suppress(OSError, ValueError):
            while part := stream.read1(_KEPT_BYTES):
                self._printed = (self._printed + part)[-_KEPT_BYTES:]


def one_line(error: BaseException) -> str:
    """Describe an exception in one short line."""
    return _short(exception_text(error))


def _short(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= _LONGEST_REASON else f"{text[:_LONGEST_REASON]} ..."


# Plain data as bytes


def encode(value: object) -> bytes:
    """Encode a value as bytes.

    Raises:
        TypeError: the value contains something other than plain data.
    """
    arrays: list[NDArray[Any]] = []
    text = json.dumps(_flat(value, arrays))
    buffer = io.BytesIO()
    content = {"tree": np.array(text), **{f"array_{k}": array for k, array in enumerate(arrays)}}
    np.savez(buffer, allow_pickle=False, **content)
    return buffer.getvalue()


def decode(data: bytes, classes: Mapping[str, type]) -> Any:
    """Decode a value from ``encode``; dataclasses must be in ``classes`` and are created by their constructors.

    Raises:
        ValueError: the bytes are not an encoded value, or a constructor refuses its fields.
    """
    try:
        arrays = unpack_arrays(io.BytesIO(data), "message", limit=len(data))  # ``encode`` compresses nothing
        return _built(json.loads(str(arrays["tree"])), arrays, classes)
    except ValueError:
        raise
    except Exception as error:  # caused by damaged bytes: zip, JSON, a missing key, a wrong field
        raise ValueError(f"no message: {type(error).__name__}: {error}") from error


def _flat(value: object, arrays: list[NDArray[Any]]) -> object:
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in PLAIN_KINDS:
            raise TypeError(f"an array of {value.dtype} is not plain data")
        arrays.append(value)
        return {"array": len(arrays) - 1}
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, (tuple, list)):
        return {type(value).__name__: [_flat(item, arrays) for item in value]}
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {"dict": {key: _flat(item, arrays) for key, item in value.items()}}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: _flat(getattr(value, f.name), arrays) for f in dataclasses.fields(value) if f.init}
        return {"dataclass": type(value).__name__, "fields": fields}
    raise TypeError(f"a {type(value).__name__} is not plain data")


def _built(tree: Any, arrays: Mapping[str, NDArray[Any]], classes: Mapping[str, type]) -> Any:
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        return arrays[f"array_{tree['array']}"]
    for name, kind in (("tuple", tuple), ("list", list)):
        if name in tree:
            return kind(_built(item, arrays, classes) for item in tree[name])
    if "dict" in tree:
        return {key: _built(item, arrays, classes) for key, item in tree["dict"].items()}
    fields = {key: _built(item, arrays, classes) for key, item in tree["fields"].items()}
    return classes[tree["dataclass"]](**fields)


def send(stream: BinaryIO, data: bytes) -> None:
    """Write one message."""
    stream.write(len(data).to_bytes(_LENGTH_BYTES, "big") + data)
    stream.flush()


def receive(stream: BinaryIO) -> bytes | None:
    """Read the next message; return None at the end of the stream or for invalid data."""
    head = stream.read(_LENGTH_BYTES)
    length = int.from_bytes(head, "big")
    if len(head) < _LENGTH_BYTES or length >= _LONGEST_BYTES:
        return None
    data = stream.read(length)
    return data if len(data) == length else None


# In the child


def use_one_thread() -> None:
    """Limit OpenCV, which does not read ``THREAD_VARIABLES``."""
    import cv2

    cv2.setNumThreads(1)


def serve_parent(lifeline: int) -> NoReturn:
    """Answer requests of the parent until it ends."""
    if lifeline >= 0:
        end_with(lifeline)  # on systems other than Linux, ``_listen`` ends the child
    import_untried()
    requests, answers = _take_streams()
    waiting: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(requests, waiting), daemon=True).start()
    server: Server = _start
    while True:
        data = waiting.get()
        message: tuple[str, object, str]
        try:
            value = server(*ForkingPickler.loads(data))
            if server is _start:
                server, value = value, None  # pyrefly: ignore[bad-assignment]
            message = ("answer", value, "")
            reply = encode(message)
        except (EntryFailure, RsbenchError) as error:
            reply = encode(("failed", None, _short(str(error))))
        except Exception:
            reply = encode(("bug", None, traceback.format_exc()))
        send(answers, reply)


def _start(factory: Callable[..., Server], arguments: tuple[object, ...]) -> Server:
    return factory(*arguments)


def _take_streams() -> tuple[BinaryIO, BinaryIO]:
    """Return private streams to the parent, and redirect standard input and output for other code."""
    requests, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    os.dup2(2, 1)
    return requests, answers


def _listen(requests: BinaryIO, waiting: queue.SimpleQueue[bytes]) -> None:
    while (data := receive(requests)) is not None:
        waiting.put(data)
    _end_group()


def _end_group() -> NoReturn:
    if _POSIX:
        os.killpg(os.getpgrp(), signal.SIGKILL)
    os._exit(1)
