"""What can be checked here of other systems: line ends, processes, /proc, names that differ in case alone."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from commands import run_here
from leaderboards import named, small_split, truth_lines, write
from small_scenes import write_box_scene, write_small_card

from rsbench.benchmark import provenance
from rsbench.benchmark.leaderboard.board import add
from rsbench.core.errors import RsbenchError
from rsbench.renderers import llvm
from rsbench.storage import work_folder

PACKAGE = Path(__file__).parents[1] / "rsbench"
FORKING = {"fork", "forkpty", "get_context", "set_start_method", "Process", "Pool", "ProcessPoolExecutor"}


def nodes() -> Iterator[tuple[Path, ast.AST]]:
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            yield path, node


@pytest.mark.slow
def test_text_is_written_with_line_feeds_and_no_process_is_forked() -> None:
    wrong, texts = list[str](), 0
    for path, node in nodes():
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute | ast.Name):
            name = node.func.attr if isinstance(node.func, ast.Attribute) else node.func.id
            words = {keyword.arg for keyword in node.keywords}
            mode = [a.value for a in node.args[:2] if isinstance(a, ast.Constant) and a.value in ("w", "a", "x")]
            if (name == "write_text" and len(node.args) > 1) or (name in ("open", "fdopen") and mode):
                texts += 1
                if not words & {"newline", "fileobj"}:  # an archive is no text
                    wrong.append(f"{path.name}:{node.lineno}: {name} without newline")
            if name in FORKING:
                wrong.append(f"{path.name}:{node.lineno}: {name}")
    assert wrong == [] and texts > 3


def test_every_use_of_proc_has_a_fallback(monkeypatch: pytest.MonkeyPatch) -> None:
    for path in PACKAGE.rglob("*.py"):
        if "/proc/" in (text := path.read_text("utf-8")):
            tree = list(ast.walk(ast.parse(text)))
            guards = [node for node in tree if isinstance(node, ast.Try) and node.handlers]
            for node in tree:
                if isinstance(node, ast.Constant) and str(node.value).startswith("/proc/"):
                    line = node.lineno
                    assert any(each.lineno < line < each.handlers[0].lineno for each in guards), f"{path}:{line}"

    def missing(self: Path, *words: Any, **more: Any) -> str:
        raise FileNotFoundError(str(self))

    monkeypatch.setattr(Path, "read_text", missing)
    assert provenance.processor() and work_folder.cpu_key() and llvm.cpu_features()


def test_names_that_differ_in_case_alone_are_refused(tmp_path: Path) -> None:
    card = write_small_card(tmp_path, [write_box_scene(tmp_path, "a")])
    text = card.read_text("utf-8")
    sequence = text[text.index("[[sequence]]") :]
    card.write_text(text + "\n" + sequence.replace('name = "a"', 'name = "A"'), "utf-8")
    ran = run_here("generate", card, "--out", tmp_path / "out")
    assert ran.returncode == 2 and "two sequences are named 'a'" in ran.stderr
    split = small_split(2)
    add(tmp_path / "board", write(tmp_path / "x.jsonl", named(truth_lines(split), "mine")), split, {})
    with pytest.raises(RsbenchError, match="'Mine': differs from the entry 'mine' in case alone"):
        add(tmp_path / "board", write(tmp_path / "x.jsonl", named(truth_lines(split), "Mine")), split, {})
