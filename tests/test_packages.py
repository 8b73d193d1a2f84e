"""The packages that are released: the same bytes whoever builds them, and nothing that does not belong in."""

from __future__ import annotations

import email
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path
from typing import Any, NamedTuple, get_args

import pytest
from markdown_it import MarkdownIt

import rsbench
from rsbench.components.cards import CardKind, list_cards
from rsbench.core.version import RELEASE, RELEASED
from rsbench.verification.digests import references

ROOT = Path(__file__).parents[1]


class Built(NamedTuple):
    """What is released."""

    sdist: Path
    wheel: Path


def _build(source: Path, out: Path) -> Built:
    command = [sys.executable, "-m", "hatchling", "build", "-d", str(out)]
    subprocess.run(command, cwd=source, check=True, capture_output=True, timeout=60)
    (sdist,), (wheel,) = out.glob("*.tar.gz"), out.glob("*.whl")
    return Built(sdist, wheel)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    return _build(ROOT, tmp_path_factory.mktemp("built"))


def test_a_build_from_the_source_package_has_the_same_bytes(built: Built, tmp_path: Path) -> None:
    """Elsewhere, from other times of files: so it depends on nothing but what is in it, and nothing is missing."""
    safely: dict[str, Any] = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}  # from 3.11.4 on
    with tarfile.open(built.sdist) as archive:
        archive.extractall(tmp_path, **safely)
    (source,) = tmp_path.iterdir()
    again = _build(source, tmp_path / "out")
    assert again.wheel.read_bytes() == built.wheel.read_bytes()
    assert again.sdist.read_bytes() == built.sdist.read_bytes()


def test_the_wheel_carries_code_cards_documents_and_licence(built: Built) -> None:
    names = set(zipfile.ZipFile(built.wheel).namelist())
    kinds = {kind: list_cards(kind).values() for kind in get_args(CardKind)}
    expected = {f"rsbench/_cards/{kind}/{path.name}" for kind, paths in kinds.items() for path in paths}
    expected |= {f"rsbench/_cards/references/{path.name}" for path in references().values()} | {"rsbench/py.typed"}
    for ending in ("*.py", "*.j2"):
        expected |= {path.relative_to(ROOT).as_posix() for path in (ROOT / "rsbench").rglob(ending)}
    expected |= {
        f"rsbench/_docs/{path.relative_to(ROOT / 'docs').as_posix()}" for path in ROOT.glob("docs/**/*.md")
    }
    expected |= {f"rsbench/_docs/examples/{path.name}" for path in (ROOT / "examples").iterdir() if path.is_file()}
    assert expected <= names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert all(name.startswith(("rsbench/", f"rsbench-{rsbench.__version__}.dist-info/")) for name in names)


def test_packages_are_small_and_hold_no_tests_results_or_data(built: Built) -> None:
    with tarfile.open(built.sdist) as archive:
        names = archive.getnames()
    assert {name.split("/")[1] for name in names if "/" in name} <= {
        *("rsbench", "scenes", "renderers", "solvers", "cards", "docs", "examples", "results"),
        *("README.md", "CHANGELOG.md", "CITATION.cff", "LICENSE", "PKG-INFO", "pyproject.toml", ".gitignore"),
    }
    stored = [name for name in names if name.split("/")[1:2] == ["results"] and not name.endswith(".jsonl.xz")]
    assert not stored, "answers to rank beside are the only results"
    names += zipfile.ZipFile(built.wheel).namelist()
    wrong = re.compile(r"__pycache__|\.(exr|npz|parquet|pyc)$|/tests?/|dataset\.json$")
    assert [name for name in names if wrong.search(name)] == []
    assert all(path.stat().st_size < 5e6 for path in built)


def test_the_metadata_say_what_an_index_shows(built: Built) -> None:
    with zipfile.ZipFile(built.wheel) as archive:
        text = archive.read(f"rsbench-{rsbench.__version__}.dist-info/METADATA").decode()
    found = email.message_from_string(text)
    assert (found["Name"], found["Version"]) == ("rsbench", rsbench.__version__)
    assert (found["License-Expression"], found["License-File"]) == ("MIT", "LICENSE")
    assert found["Description-Content-Type"] == "text/markdown" and found["Summary"]
    shown = MarkdownIt("commonmark").enable("table").render(str(found.get_payload()))
    assert shown.startswith("<h1>rsbench</h1>") and shown.count("<table>") == 3
    links, repository = re.findall(r'(?:href|src)="(.*?)"', shown), "https://github.com/rsbench/rsbench"
    assert f"{repository}/raw/main/docs/before-after.gif" in links and all("://" in link for link in links)
    for kind, path in re.findall(rf"{repository}/(blob|raw)/main/([^#\s]+)", "\n".join(links)):
        assert (ROOT / path).is_file(), (kind, path)


def test_release_and_day_are_those_of_citation_and_changelog() -> None:
    citation, changes = (ROOT / "CITATION.cff").read_text("utf-8"), (ROOT / "CHANGELOG.md").read_text("utf-8")
    assert f"\nversion: {RELEASE}\ndate-released: {RELEASED}\n" in citation
    assert re.findall(r"^## \[(.*?)\] - (.*)$", changes, re.MULTILINE)[0] == (RELEASE, RELEASED)
