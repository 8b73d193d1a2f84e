"""The packages of docs/how-to/extend.md, installed as anybody would, and a folder with its cards."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

import rsbench

ROOT = Path(__file__).parents[2]
Run = Callable[[str], str]


@dataclass(frozen=True)
class Section:
    """One kind of component in the document."""

    module: str
    source: str
    entry_points: str
    cards: dict[str, str] = field(default_factory=dict)
    commands: list[str] = field(default_factory=list)


def read_sections() -> dict[str, Section]:
    """Sections of docs/how-to/extend.md by their headings; the last one is a command that all share."""
    text = (ROOT / "docs" / "how-to" / "extend.md").read_text("utf-8")
    head, *parts, together = re.split(r"^## ", text, flags=re.MULTILINE)
    shared = re.findall(r"^rsbench .*", together, flags=re.MULTILINE)
    found = {}
    for number, part in enumerate(parts):
        title, _, body = part.partition("\n")
        if number == 0:  # its package is the example at the top
            body += head
        blocks = re.findall(r"^```(\w+)\n(.*?)^```", body, flags=re.DOTALL | re.MULTILINE)
        named = [re.match(r"# (\S+)\n", block) for _, block in blocks]
        files = {name.group(1): block for name, (_, block) in zip(named, blocks, strict=True) if name}
        (module,) = [name for name in files if name.endswith(".py")]
        points = [block for (kind, block) in blocks if kind == "toml" and "entry-points" in block]
        found[title] = Section(
            module=module,
            source=files[module],
            entry_points=re.search(r"\[project.entry-points.*?\n(?=\n|$)", points[0] + "\n", re.DOTALL).group(),  # pyrefly: ignore[missing-attribute]
            cards={
                name: text for name, text in files.items() if name.endswith(".toml") and name != "pyproject.toml"
            },
            commands=[line for kind, block in blocks if kind == "sh" for line in block.splitlines()] or shared,
        )
    return found


SECTIONS = read_sections()
_PYPROJECT = """
[project]
name = "stranger-{name}"
version = "1.0"

{entry_points}

[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"

[tool.hatch.build.targets.wheel]
include = ["{module}"]
"""


@pytest.fixture(scope="session")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder where every package of the document is installed."""
    folder = tmp_path_factory.mktemp("strangers")
    sources = []
    for section in SECTIONS.values():
        source = folder / "sources" / section.module.removesuffix(".py")
        source.mkdir(parents=True)
        (source / section.module).write_text(section.source, "utf-8")
        text = _PYPROJECT.format(name=source.name, module=section.module, entry_points=section.entry_points)
        assert tomllib.loads(text)["project"]["entry-points"]
        (source / "pyproject.toml").write_text(text, "utf-8")
        sources.append(str(source))
    command = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "--no-index",
    ]
    subprocess.run([*command, "--target", str(folder / "site"), *sources], check=True, timeout=120)
    return folder / "site"


@pytest.fixture(scope="session")
def run(installed: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Runs a line of the document away from the repository, with the packages installed; returns its output."""
    work = tmp_path_factory.mktemp("work")
    for section in SECTIONS.values():
        for name, text in section.cards.items():
            (work / name).write_text(text, "utf-8")
    done: dict[str, str] = {}

    def once(line: str) -> str:
        if line not in done:
            words = shlex.split(line, comments=True)
            assert words[0] == "rsbench"
            result = subprocess.run(
                [sys.executable, "-m", *words],
                cwd=work,
                env=os.environ | {"PYTHONPATH": f"{installed}{os.pathsep}{Path(rsbench.__file__).parents[1]}"},
                capture_output=True,
                text=True,
                timeout=300,
                check=False,
            )
            assert result.returncode == 0, f"{line}\n{result.stdout}\n{result.stderr}"
            done[line] = str(work) + "\n" + result.stdout
        return done[line]

    return once


@pytest.fixture(scope="session")
def data(run: Run) -> Path:
    """The dataset of the scene builder's section."""
    output = run("rsbench generate street-data.toml --out data")
    return Path(output.partition("\n")[0]) / "data"
