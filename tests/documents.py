"""What documents of the repository show: code, sections, tables; and the committed results that they quote."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


def blocks(document: Path, language: str) -> list[str]:
    """All code of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", document.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)


def notebook_code(notebook: Path) -> str:
    """The code of all cells."""
    cells = json.loads(notebook.read_text("utf-8"))["cells"]
    return "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")


def write_blocks(document: Path, folder: Path) -> None:
    """Write the files of a documented package: blocks of Python and TOML whose first line names the file."""
    for block in [*blocks(document, "python"), *blocks(document, "toml")]:
        name, content = block.removeprefix("# ").split("\n", 1)
        (folder / name).write_text(content, "utf-8")


def section(text: str, title: str) -> str:
    """The section whose title begins so, to the next title of its level."""
    return text.partition(f"## {title}")[2].partition("\n## ")[0]


def rows(text: str) -> list[list[str]]:
    """The cells of all rows of tables."""
    return [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]


def results(name: str) -> list[dict[str, str]]:
    """The rows of a table in results/."""
    return list(csv.DictReader((ROOT / "results" / name).read_text("utf-8").splitlines()))
