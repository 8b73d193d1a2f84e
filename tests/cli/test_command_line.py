"""The command line: help, answers, refusals in one line, and unexpected errors with a log."""

from __future__ import annotations

import errno
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from commands import assert_refused, run_apart, run_here, sweep_card
from small_scenes import write_box_scene, write_small_card

from rsbench.cli import exits, main
from rsbench.pipeline.problem import EXAMPLE


def test_help_loads_nothing_heavy() -> None:
    heavy = ("numpy", "pandas", "mitsuba", "cv2", "scipy", "numba", "trimesh", "matplotlib")
    code = f"import sys, rsbench.cli.main; print([m for m in {heavy!r} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("words", "heavy"),
    [
        (("correct", "nowhere.png"), ("numba", "cv2", "scipy.special", "pandas", "av", "mitsuba", "matplotlib")),
        (
            ("solve", str(EXAMPLE)),
            ("cv2", "numba.np.arraymath", "scipy.stats", "pandas", "rich.progress", "av", "mitsuba"),
        ),
    ],
)
def test_a_command_loads_nothing_heavy_that_it_does_not_use(
    words: tuple[str, ...], heavy: tuple[str, ...]
) -> None:
    run_here(*words)  # compiling loads more, and takes so long that progress is shown
    code = f"""
import sys
from rsbench.cli.main import run
sys.argv = ["rsbench", *{words!r}]
try:
    run()
except SystemExit:
    print("loaded:", [name for name in {heavy!r} if name in sys.modules])
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "loaded: []"


def test_unknown_card_is_refused_with_the_names_that_exist(tmp_path: Path) -> None:
    # In a process of its own: exit code and line are those of the program, not of a function.
    result = run_apart("generate", "papre", "--out", tmp_path / "x")
    assert_refused(result, "papre", "paper")
    assert result.stdout == ""
    assert not (tmp_path / "x").exists()


def test_damaged_depth_is_refused_by_evaluate_and_found_by_verify(smoke_dataset: Path, tmp_path: Path) -> None:
    copy = tmp_path / "smoke"
    shutil.copytree(smoke_dataset, copy)
    damaged = copy / "castle/rs_depth/left_0.exr"
    damaged.write_bytes(damaged.read_bytes()[:500])
    assert_refused(
        run_here("evaluate", copy, "--out", tmp_path / "e", "--solver", "gs-8pt"), "left_0.exr", "damaged"
    )
    result = run_here("verify", copy, "--rerender", "no")
    assert result.returncode == 1
    assert "left_0.exr" in result.stderr


def test_verify_passes_on_sound_data(smoke_dataset: Path) -> None:
    result = run_here("verify", smoke_dataset, "--fast")
    assert result.returncode == 0, result.stderr
    assert "0 faults" in result.stdout.splitlines()[-1]
    assert "--fast left out: rows rendered again" in result.stdout + result.stderr


def test_evaluate_writes_scores_and_a_page_without_links(smoke_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "evaluation"
    result = run_here(
        "evaluate", smoke_dataset, "--out", out, "--solver", "gs-8pt", "--solver", "rs-stereo-refined"
    )
    assert result.returncode == 0, result.stderr
    assert str((out / "report.html").resolve()) in result.stdout.replace("\n", "")
    page = (out / "report.html").read_text()
    assert "http://" not in page and "https://" not in page, "the page must open without a network"
    for table in ("pose", "depth", "correction"):
        assert len((out / "scores" / f"{table}.csv").read_text().splitlines()) > 2


def run_failing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: BaseException
) -> tuple[int, str]:
    def fail(**options: Any) -> None:
        raise error

    monkeypatch.setattr(main, "app", fail)
    with pytest.raises(SystemExit) as caught:
        main.run()
    assert isinstance(caught.value.code, int)
    (line,) = capsys.readouterr().err.splitlines()
    return caught.value.code, line


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(sys, "argv", ["rsbench", "list"])
    return tmp_path / "cache"


def test_an_unknown_error_is_one_line_with_a_log(
    cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(cache.parent)
    code, line = run_failing(monkeypatch, capsys, ZeroDivisionError("a bug\nof ours"))
    assert code == 70
    assert "a fault of rsbench, not yours: ZeroDivisionError: a bug of ours; what led to it: " in line
    log = Path(line.rpartition("what led to it: ")[2])
    assert log.is_relative_to(cache)
    text = log.read_text("utf-8")
    assert "Traceback" in text and "in fail" in text and "['rsbench', 'list']" in text
    assert [path.name for path in cache.parent.iterdir()] == ["cache"]


def test_logs_do_not_pile_up(cache: Path) -> None:
    for _ in range(25):
        exits.describe(ValueError())
    assert len(list((cache / "rsbench" / "faults").iterdir())) == 20


def test_without_a_place_for_a_log_the_line_stays(
    cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cache.write_text("no folder")
    monkeypatch.setattr(exits, "temporary", lambda: None)
    code, line = run_failing(monkeypatch, capsys, RecursionError("too deep"))
    assert code == 70 and "RecursionError: too deep; no log of it could be written" in line


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (MemoryError(), 1, "not enough memory"),
        (PermissionError(errno.EACCES, "Permission denied", "/x"), 2, "rsbench: error: /x: Permission denied"),
        (OSError(errno.EBADF, "Bad file descriptor"), 70, "the system refused: OSError: [Errno 9] Bad file"),
        # Without a name: a full disk behind standard output, and a working folder that was removed.
        (OSError(errno.ENOSPC, "No space left"), 2, "rsbench: error: standard output: No space left"),
        (OSError(errno.ENOENT, "No such file"), 2, "error: the working folder, which must exist: No such file"),
    ],
)
def test_errors_of_the_system(
    cache: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    error: Exception,
    code: int,
    words: str,
) -> None:
    found, line = run_failing(monkeypatch, capsys, error)
    assert found == code and words in line and "file system:" not in line
    assert cache.exists() == (code == 70)  # faults of users have no log


def test_a_long_message_keeps_its_file_and_its_remedy(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main._fail("x.toml: " + "long " * 10_000 + "do this instead")
    line = capsys.readouterr().err
    assert len(line) < 2100 and line.startswith("rsbench: error: x.toml: ") and line.endswith("do this instead\n")


@pytest.mark.parametrize(
    "command", [("generate", "smoke"), ("reproduce", "fig4"), ("simulate", "noise"), ("demo",)], ids=lambda c: c[0]
)
def test_a_folder_that_cannot_be_written_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    def work(*arguments: object, **options: object) -> None:
        raise AssertionError("the work had begun")

    monkeypatch.setattr("rsbench.renderers.backend.start_backend", work)
    monkeypatch.setattr("rsbench.dataset.generation.load_scene", work)
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        result = run_here(*command, "--out", out)
        assert_refused(result, "file")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.fixture
def card(tmp_path: Path) -> Path:
    """Of a camera with a lens."""
    path = write_small_card(tmp_path, [write_box_scene(tmp_path, "a")])
    path.write_text(
        path.read_text().replace("focal = 80", 'focal = 80\nlens = { model = "brown-conrady", k1 = -0.1 }')
    )
    return path


CARD = sweep_card(["gs-8pt"], noise_px=[0.0, 0.5], trials=3)


def test_a_users_own_sweep(tmp_path: Path) -> None:
    card = tmp_path / "mine.toml"
    card.write_text(CARD)
    out = tmp_path / "results"
    result = run_here(
        "simulate", card, "--out", out, "--solver", "rs-stereo-linear", "--set", "points=40", "--workers", 1
    )
    assert result.returncode == 0, result.stderr
    assert "rs-stereo-linear" in result.stdout
    assert f"table: {out / 'summary.csv'}" in result.stdout
    table = pd.read_csv(out / "summary.csv")
    assert list(table.solver) == ["rs-stereo-linear"] * 2 and list(table.value) == [0.0, 0.5]
    assert table.e_R_median[0] < table.e_R_median[1]
    assert sorted(path.name for path in out.iterdir()) == [
        "bounds",
        "provenance.json",
        "seconds",
        "summary.csv",
        "sweep.json",
        "trials",
    ]


DASK = find_spec("distributed") is not None

# Refusals of all commands: {card} is a dataset card of a camera with a lens, {out} must stay absent.

SOLVE = f"solve {EXAMPLE}"
GENERATE = "generate {card} --out {out}"
SIMULATE = "simulate noise --out {out}"
REFUSED = {
    "bogus": ["No such command 'bogus'; see rsbench --help"],
    "evaluate --out-of": ["No such option: --out-of"],
    "generate": ["Missing argument 'card'; see rsbench generate --help"],
    "leaderboard submit": ["see rsbench leaderboard submit --help"],
    "list solver": ["did you mean 'solvers'"],
    "show castle --kind solver": ["did you mean 'solvers'"],
    "verify {folder}/none": ["none"],
    "evaluate {folder}/none --out {out}": ["none"],
    "solve": ["--example"],
    "solve {folder}/absent.json": ["absent.json", "cannot be read"],
    f"{SOLVE} --solver gs-9pt": ["gs-9pt", "gs-8pt"],
    f"{SOLVE} --solver gs-8pt --solver {{folder}}/gs-8pt.toml": ["'gs-8pt'", "gs-8pt.toml", "both"],
    f"{SOLVE} --with noise": ["--json"],
    f"{SOLVE} --json --with nois": ["did you mean 'noise'"],
    f"{SOLVE} --threshold-px nan": ["--threshold-px"],
    f"{SOLVE} --time-limit 0": ["--time-limit"],
    f"{GENERATE} --shard=": ["--shard : must be I/N"],
    f"{GENERATE} --shard 1": ["--shard 1: must be I/N"],
    f"{GENERATE} --shard 2/1": ["shard 2/1: the first number"],
    f"{GENERATE} --shard 2/2": ["shard 2/2: is empty"],
    f"{GENERATE} --channels=": ["--channels : ''"],
    f"{GENERATE} --channels nix": ["--channels nix: 'nix'"],
    f"{GENERATE} --channels timing,timing": ["each once"],
    f"{GENERATE} --channels all": ["dataset small: channels: 'disparity' needs cameras without a lens"],
    f"{GENERATE} --only b": ["no sequence 'b'"],
    f"{GENERATE} --estimate --full-frames": ["--estimate: not with --full-frames"],
    "simulate nois --out {out}": ["did you mean 'noise'?"],
    f"{SIMULATE} --workers 2 --scheduler tcp://127.0.0.1:1": ["give one of the two"],
    f"{SIMULATE} --scheduler {{folder}}/none.json": ["--scheduler", "no such file" if DASK else "pip install"],
    f"{SIMULATE} --trials x": ["Invalid value for '--trials'"],
    f"{SIMULATE} --set pints=9": ["unknown key 'pints'", "did you mean 'points'?"],
    f"{SIMULATE} --set points": ["--set points", "FIELD=VALUE"],
    f"{SIMULATE} --set shape=ball": ["shape = 'ball'"],
    f"{SIMULATE} --set x={'[' * 3000}": ["--set x", "not a value of TOML"],
    f"{SIMULATE} --solver nobody": ["solver 'nobody' does not exist"],
}


@pytest.mark.parametrize("words", REFUSED, ids=lambda words: words[:60])
def test_bad_input_is_refused_in_one_line_and_writes_nothing(card: Path, tmp_path: Path, words: str) -> None:
    (tmp_path / "gs-8pt.toml").write_text("class = 'rsbench.solvers.essential_matrix:EightPointSolver'\n")
    places = {"card": card, "folder": tmp_path, "out": tmp_path / "out"}
    result = run_here(*(word.format(**places) for word in words.split()))
    assert_refused(result, *REFUSED[words])
    assert result.stdout == ""
    assert not (tmp_path / "out").exists()
