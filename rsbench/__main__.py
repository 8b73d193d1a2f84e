"""``python -m rsbench`` and the command ``rsbench``."""

import contextlib
import gc
import os
import signal
import sys

_LOADED_OBJECTS = 250_000
"""More than the largest command has loaded."""


def main() -> None:
    """Run the command line; a signal while it is loaded ends the process in one line, or without one."""
    _open_streams()
    _collect_late()
    heard = [each for each in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(each) != signal.SIG_IGN]
    for number in heard:
        signal.signal(number, signal.SIG_DFL)
    from rsbench.cli.exits import end_at_once

    for number in heard:
        signal.signal(number, end_at_once)
    # Before NumPy is loaded: our own threads use the cores, and more of the BLAS only wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _keep_memory_together()
    from rsbench.cli.main import run

    try:
        run()
    except SystemExit as end:
        gc.freeze()  # Python's end looks for garbage among all objects several times: a tenth of a short command
        if end.code not in [128 + number for number in heard] and not _waits_for_components():
            raise
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(int(end.code or 0))  # all is closed but Python, which takes a second for its modules


def _collect_late() -> None:
    """Loading makes many objects and no garbage: look for it first when a command has made more than it loads."""

    def loaded(phase: str, _: dict[str, int]) -> None:
        if phase == "stop":
            gc.callbacks.remove(loaded)
            gc.set_threshold(10_000, 20, 10)

    gc.set_threshold(_LOADED_OBJECTS)
    gc.callbacks.append(loaded)


def _waits_for_components() -> bool:
    """Whether Python's end would wait for threads of a component; what is to be done at the end is done then."""
    import atexit

    imports = sys.modules.get("rsbench.components.imports")
    if imports is None or not imports.abandoned_threads():
        return False
    atexit._run_exitfuncs()
    return True


def _keep_memory_together() -> None:
    """glibc gives threads heaps of their own, up to eight a core, which keep what was freed: a third of all."""
    if sys.platform == "linux":
        import ctypes

        with contextlib.suppress(AttributeError):  # another C library
            ctypes.CDLL(None).mallopt(-8, 2)  # M_ARENA_MAX


def _open_streams() -> None:
    """Standard streams that are closed lead nowhere: else the next file opened would get what is printed."""
    for descriptor, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(descriptor)
        except OSError:
            nowhere = os.open(os.devnull, os.O_RDWR)
            if nowhere != descriptor:
                os.dup2(nowhere, descriptor)
                os.close(nowhere)
            setattr(sys, name, os.fdopen(descriptor, mode, closefd=False))


if __name__ == "__main__":
    main()
