"""What ends a command from outside: signals at any moment, and streams that nobody reads."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from rsbench.cli.exits import stoppable
from rsbench.components.imports import signals_later

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize("command", ["generate", "list"])
def test_a_signal_ends_a_command_in_one_line(
    number: int, code: int, command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = signal.getsignal(number)
    monkeypatch.setattr(sys, "argv", ["rsbench", "-q", command, "smoke"])
    closed = []
    with pytest.raises(SystemExit) as end, stoppable():
        try:
            os.kill(os.getpid(), number)
            time.sleep(60.0)
        finally:
            os.kill(os.getpid(), number)  # an impatient second one does not disturb the closing
            closed.append(True)
    assert end.value.code == code and closed
    advice = "; the same command resumes where it stopped" if command == "generate" else ""
    assert capsys.readouterr().err == f"interrupted{advice}\n"
    assert signal.getsignal(number) == before


def test_an_error_that_a_signal_was_turned_into_is_not_shown(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end, stoppable():
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(60.0)
        except BaseException:
            raise NameError("half a module") from None
    assert end.value.code == 130 and capsys.readouterr().err.startswith("interrupted")


def test_an_error_without_a_signal_passes() -> None:
    with pytest.raises(NameError), stoppable():
        raise NameError


def test_what_is_ignored_from_the_start_stays_ignored() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # as after nohup, or in a script's background
    try:
        with stoppable():
            os.kill(os.getpid(), signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_long_computation_is_not_waited_for() -> None:
    """One call that does not come back to Python for minutes, as a render may not for seconds."""
    code = (
        "import hashlib, sys; from rsbench.cli.exits import stoppable\n"
        "with stoppable():\n"
        "    print('begun', flush=True)\n"
        "    hashlib.pbkdf2_hmac('sha256', b'', b'', 10**9)"
    )
    command = [sys.executable, "-c", code, "simulate"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "begun\n"
        start = time.monotonic()
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=60.0)
        assert time.monotonic() - start < 6.0  # 1 on a free machine
    assert process.returncode == 143 and "Traceback" not in errors
    assert errors == "interrupted; the same command resumes where it stopped\n"


def test_nothing_of_a_command_stays_behind() -> None:
    threads, descriptors = threading.active_count(), len(os.listdir("/dev/fd"))
    for _ in range(5):
        with stoppable():
            pass
    deadline = time.monotonic() + 10.0
    while threading.active_count() > threads and time.monotonic() < deadline:
        time.sleep(0.01)
    assert threading.active_count() == threads and len(os.listdir("/dev/fd")) <= descriptors


@pytest.mark.parametrize(("streams", "code"), [("2>&-", 2), (">&- 2>&- <&-", 2), ("2>&1 >&- | head -c 5", 0)])
def test_closed_streams_change_nothing_else(streams: str, code: int) -> None:
    """A file opened later must not get the number of a closed stream, and with it whatever is printed."""
    shown = subprocess.run(
        f"{shlex.quote(sys.executable)} -m rsbench show nosuch {streams}",
        shell=True,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert shown.returncode == code and "Traceback" not in shown.stderr
    assert shown.stdout == ("rsben" if "head" in streams else "")


def test_a_reader_that_leaves_is_no_error() -> None:
    command = [sys.executable, "-m", "rsbench", "list"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere it ends after its time limit")
def test_an_import_that_is_tried_ends_with_its_parent(tmp_path: Path) -> None:
    """Killed without a chance to end its children; the module would hold the import up for minutes."""
    (tmp_path / "slow.py").write_text(
        f"import os, time\nopen({str(tmp_path / 'pid')!r}, 'w').write(f'{{os.getpid()}}.')\ntime.sleep(1000)"
    )
    code = "from rsbench.components.imports import try_import; try_import('slow')"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *filter(None, sys.path)])}
    with subprocess.Popen([sys.executable, "-c", code], env=environment) as process:
        deadline = time.monotonic() + 60.0
        while not (tmp_path / "pid").exists() or not (tmp_path / "pid").read_text().endswith("."):
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.01)
        process.kill()
    pid = (tmp_path / "pid").read_text()[:-1]
    while time.monotonic() < deadline:
        stat = Path(f"/proc/{pid}/stat")
        if not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] == "Z":
            return
        time.sleep(0.01)
    os.kill(int(pid), signal.SIGKILL)
    pytest.fail("it goes on")


def test_signals_wait_for_an_import_to_end() -> None:
    """Native code does not survive an exception out of a handler."""
    ended = []
    with pytest.raises(KeyboardInterrupt), signals_later():
        signal.raise_signal(signal.SIGINT)
        ended.append(True)
    assert ended == [True]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    thread = threading.Thread(target=lambda: signals_later().__enter__())
    thread.start()
    thread.join()  # elsewhere no handler runs, and none may be changed
