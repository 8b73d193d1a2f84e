"""The house: sizes, cards, documents and packaging."""

from __future__ import annotations

import ast
import importlib
import itertools
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from commands import install_project, run_here
from documents import ROOT, blocks, write_blocks
from programs import run_python

from rsbench.benchmark.simulated.contract import CHECKS, check_solver
from rsbench.benchmark.simulated.simulation import SimulationOptions, simulate
from rsbench.components.cards import CardKind, list_cards, read_toml
from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.pose_errors import rotation_error, translation_error
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.core.version import RELEASE, __version__
from rsbench.dataset.card import load_dataset_card
from rsbench.solvers.engine.base import list_solvers, load_solver_entry
from rsbench.storage.untrusted_files import read_json

DOCS = ROOT / "docs"
SOURCES = sorted((ROOT / "rsbench").rglob("*.py"))
DOCUMENTS = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md")])
MAX_REPOSITORY_MB, MAX_ARGUMENTS = 34, 9

in_checkout = pytest.mark.skipif(not (ROOT / ".git").exists(), reason="needs a git checkout")


def _tracked() -> list[Path]:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True)
    paths = [ROOT / name for name in listed.stdout.split("\0") if name]
    return [path for path in paths if path.is_file()]


# Sizes


def test_what_travels_together_is_one_object() -> None:
    """Of all functions but those whose keywords a user types, and compiled loops, which take arrays."""
    many: list[str] = []
    for path in SOURCES:
        name = path.relative_to(ROOT)
        if name.parts[1] in ("api", "cli"):
            continue
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef) and not any(
                "compiled" in ast.unparse(d) for d in node.decorator_list
            ):
                given = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
                count = sum(each.arg not in ("self", "cls") for each in given)
                if count > MAX_ARGUMENTS and node.name not in _OF_MANY:
                    many.append(f"{name}: {node.name}: {count} arguments")
    assert not many, f"functions of more than {MAX_ARGUMENTS} arguments: {many}"


_OF_MANY = {"solver"}


@in_checkout
def test_the_repository_is_small() -> None:
    total = sum(path.stat().st_size for path in _tracked())
    assert total < MAX_REPOSITORY_MB * 1e6


# What must not be in tracked files: machine paths, addresses of package indexes.

_FORBIDDEN = re.compile(
    r"(?<![\w.~-])/(home|Users|root|work|mnt)/\w"  # absolute paths of one machine
    r"|[A-Z]:\\\\?Users"
    r"|--(extra-)?index-url|--find-links|--trusted-host"
    r"|https?://(test\.)?(pypi|files\.pythonhosted)\.org"
)


@in_checkout
def test_nothing_points_at_one_machine_or_one_package_index() -> None:
    found: list[str] = []
    for path in _tracked():
        if path == Path(__file__):
            continue
        data = path.read_bytes()
        if b"\0" not in data[:4096]:
            text = data.decode("utf-8", errors="replace")
            found += [f"{path.relative_to(ROOT)}: {match.group()}" for match in _FORBIDDEN.finditer(text)]
    assert not found


def test_the_search_for_machine_paths_can_find_them() -> None:
    assert _FORBIDDEN.search("open('/home/" + "me/x')") and _FORBIDDEN.search("--extra-" + "index-url x")
    assert not _FORBIDDEN.search("the network/home/page, https://github.com/rsbench/rsbench")


@in_checkout
def test_no_document_holds_the_marks_of_a_merge() -> None:
    marks = re.compile(r"^(<{7}|={7}|>{7})( |$)", re.MULTILINE)
    assert not [
        path for path in _tracked() if path.suffix in (".md", ".toml", ".txt") if marks.search(path.read_text())
    ]
    assert marks.search("a\n<<<<<<< HEAD\nb\n=======\nc\n")


@pytest.mark.parametrize("name", ["constraints.txt", "constraints-dev.txt"])
def test_constraints_are_exact_and_hashed(name: str) -> None:
    text = (ROOT / name).read_text("utf-8")
    assert "://" not in text
    entries = [e.replace("\\\n", " ") for e in re.split(r"\n(?=\S)", text) if e.strip()]
    assert len(entries) > 20
    for entry in entries:
        if not entry.startswith("#"):
            assert re.match(r"[a-z0-9._-]+(\[[\w,-]+\])?==\S+", entry), entry[:80]
            assert re.search(r"--hash=sha256:[0-9a-f]{64}", entry), entry[:80]


def test_every_dependency_is_locked() -> None:
    """Of the extras those that ``make lock`` names: torch alone is larger than all else."""
    project = read_toml(ROOT / "pyproject.toml")["project"]
    extras = re.findall(r"--extra (\w+)", (ROOT / "Makefile").read_text("utf-8"))
    assert extras == ["install", "dev", "docs"]
    wanted = {"dependencies": project["dependencies"], **project["optional-dependencies"]}
    users, tools = _locked("constraints.txt"), _locked("constraints-dev.txt")
    assert users <= tools, "installing the tools must not change what users have"
    for part, locked in {"dependencies": users, "install": users, "dev": tools, "docs": tools}.items():
        names = {_normal(re.split(r"[ \[<>=!~;]", line)[0]) for line in wanted[part]}
        assert not names - {name for name, _ in locked}, part
    assert len(tools) > 2 * len(users)  # what tests need is not installed for users


def _locked(file: str) -> set[tuple[str, str]]:
    """Names and versions."""
    found = re.findall(r"^([A-Za-z0-9._-]+)==(\S+)", (ROOT / file).read_text("utf-8"), flags=re.MULTILINE)
    return {(_normal(name), version) for name, version in found}


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_make_help_lists_every_target() -> None:
    text = (ROOT / "Makefile").read_text("utf-8")
    (phony,) = re.findall(r"^\.PHONY: (.*)$", text, re.MULTILINE)
    listed = subprocess.run(["make", "-s", "help"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    listing = [re.fullmatch(r"make ([a-z-]+) +(\S.*)", line) for line in listed.splitlines()]
    targets = set(phony.split()) - {"here"}  # a check that others begin with
    assert sorted(match.group(1) for match in listing if match) == sorted(targets)
    assert len(listing) == len(targets)


# Cards


def test_there_are_cards_of_every_kind() -> None:
    for kind in get_args(CardKind):
        assert list_cards(kind), f"no {kind} cards"


def test_dataset_cards_name_cards_that_exist() -> None:
    for name in list_cards("datasets"):
        card = load_dataset_card(name)
        assert card.renderer in list_cards("renderers"), name
        assert {sequence.scene for sequence in card.sequence} <= set(list_cards("scenes")), name


# Documents


def test_links_between_documents_lead_somewhere() -> None:
    """Those in docs/ stay in it, or are addresses: it is installed, and made into a site, without the rest."""
    repository = re.compile(r"https://github\.com/rsbench/rsbench/(blob|raw)/main/")
    broken: list[str] = []
    for document in DOCUMENTS:
        prose = re.sub(r"```.*?```|`[^`]*`", "", document.read_text("utf-8"), flags=re.DOTALL)
        named = set(re.findall(r"^\[([^\]]+)\]: ", prose, re.MULTILINE))
        broken += [
            f"{document.name}: [{name}]" for name in re.findall(r"\]\[([^\]]+)\]", prose) if name not in named
        ]
        for target in re.findall(r"\]\(([^)#\s]+)", prose):
            path = ROOT / repository.sub("", target) if repository.match(target) else None
            if path is None and "://" not in target:
                path = document.parent / target
            leaves = path is not None and "://" not in target and DOCS in document.parents
            leaves = leaves and DOCS not in path.resolve().parents
            if path is not None and (leaves or not path.exists()):
                broken.append(f"{document.name}: {target}")
    assert not broken


def test_links_to_sections_lead_to_one() -> None:
    """By the anchors that GitHub and the site give to headings."""

    def anchors(document: Path) -> set[str]:
        text = re.sub(r"^```.*?^```", "", document.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)
        titles = (re.sub(r"[^\w\- ]", "", title).strip() for title in re.findall(r"^#+ (.*)$", text, re.MULTILINE))
        return {title.lower().replace(" ", "-") for title in titles}

    broken = []
    for document in DOCUMENTS:
        prose = re.sub(r"```.*?```|`[^`]*`", "", document.read_text("utf-8"), flags=re.DOTALL)
        for path, section in re.findall(r"\]\(([^)#\s:]*)#([^)\s]+)\)", prose):
            target = document.parent / path if path else document
            if target.suffix == ".md" and section not in anchors(target):
                broken.append(f"{document.name}: {path}#{section}")
    assert broken == []


def test_the_table_of_packages_has_all_of_them_in_the_order_of_the_layers() -> None:
    contract = read_toml(ROOT / "pyproject.toml")["tool"]["importlinter"]["contracts"][0]
    layers = [re.findall(r"rsbench\.(\w+)", line) for line in contract["layers"]]
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    rows = re.findall(r"^\| `(\w+)` \| .* \| ([a-z, ]+) \|$", text, re.MULTILINE)
    packages = {path.parent.name for path in (ROOT / "rsbench").glob("*/__init__.py")}
    assert {name for name, _ in rows} == packages == {name for names in layers for name in names}
    order = {name: number for number, (name, _) in enumerate(rows)}
    for above, below in itertools.pairwise(layers):
        assert min(order[name] for name in above) > max(order[name] for name in below), (above, below)
    height = {name: -number for number, names in enumerate(layers) for name in names}
    for name, imported in rows[1:]:
        assert all(height[other] < height[name] for other in imported.split(", ")), (name, imported)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_lines_of_documents_wrap_at_100_columns(document: Path) -> None:
    """But those of tables and code, and what has an address, which cannot be broken."""
    prose = re.sub(r"^( *)(`{3,}).*?^\1\2$", "", document.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)
    whole = re.compile(r"\||    |.*\]\(|.*://")
    assert [line for line in prose.splitlines() if len(line) > 100 and not whole.match(line)] == []


def test_the_five_functions_of_a_correction_exist() -> None:
    text = (DOCS / "explanation" / "one-frame.md").read_text("utf-8")
    names = re.findall(r"^\d\. \*\*\w+\*\*: `([\w.]+)`", text, re.MULTILINE)
    assert len(names) == 5
    for name in names:
        module, _, function = name.rpartition(".")
        assert callable(getattr(importlib.import_module(module), function)), name


def test_the_conversion_to_the_papers_axes_holds() -> None:
    (code,) = blocks(ROOT / "docs" / "explanation" / "conventions.md", "python")
    exec(compile(code, "conventions.md", "exec"), {})  # asserts


def test_the_dataset_is_read_as_documented(
    smoke_dataset: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (code,) = blocks(ROOT / "docs" / "reference" / "dataset-format.md", "python")
    monkeypatch.chdir(smoke_dataset.parent)
    exec(compile(code.replace("data/smoke", str(smoke_dataset)), "dataset-format.md", "exec"), {})
    assert "(96, 128, 3)" in capsys.readouterr().out


def test_every_key_of_a_dataset_is_documented(smoke_dataset: Path) -> None:
    text = (ROOT / "docs" / "reference" / "dataset-format.md").read_text("utf-8")
    documented = set(re.findall(r"`(\w+)`", text))
    for manifest in (smoke_dataset / "dataset.json", next(smoke_dataset.glob("*/sequence.json"))):
        keys = set(re.findall(r'^  "(\w+)":', manifest.read_text("utf-8"), flags=re.MULTILINE))
        assert keys and keys <= documented


@pytest.fixture
def documented_solver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The files of docs/how-to/add-a-solver.md in a folder on the import path."""
    write_blocks(ROOT / "docs" / "how-to" / "add-a-solver.md", tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    for name in ("scipy_solver", "my_solver"):
        sys.modules.pop(name, None)


def test_the_documented_solver_works(documented_solver: Path) -> None:
    entry = load_solver_entry(documented_solver / "scipy-huber.toml")
    solver = entry.solver
    assert entry.name == "scipy-huber"
    rig = StereoRig(camera=PinholeCamera.centred(900, 900, 810.0), baseline=0.6)
    shutter = RollingShutter(height=900, readout_ratio=0.8)
    motion = LinearMotion(np.array([0.012, -0.02, 0.016]), np.array([0.2, -0.12, 0.18]))
    data = simulate(rig, shutter, motion, SimulationOptions(pairs=40), np.random.default_rng(0))
    estimate = solver.estimate(data.correspondences, rig, shutter)
    assert estimate.success, estimate.reason
    # Exact data: what remains is SciPy's own stopping rule.
    assert rotation_error(estimate.w, motion.w) < 1e-7
    assert translation_error(estimate.d, motion.d) < 1e-6


def test_the_documented_function_keeps_the_contract(documented_solver: Path) -> None:
    findings = check_solver(load_solver_entry(documented_solver / "my_solver.py"), isolated=False)
    assert [finding for finding in findings if finding.verdict in ("failed", "skipped")] == []
    assert "'e_R_deg': 0.1" in run_python("use_it.py", folder=documented_solver).stdout


@pytest.mark.slow
def test_the_page_of_solvers_shows_what_its_commands_print(
    documented_solver: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(documented_solver)
    for block in blocks(ROOT / "docs" / "how-to" / "add-a-solver.md", "console"):
        command, *lines = block.splitlines()
        shown = run_here(*command.split()[2:], COLUMNS="80").stdout
        printed = {" ".join(line.split()) for line in shown.splitlines()}
        for line in lines:
            assert line == "..." or " ".join(line.split()) in printed or "ranked among" in line, (command, line)


@pytest.mark.slow
def test_the_documented_solver_keeps_the_contract(documented_solver: Path) -> None:
    entry = load_solver_entry(documented_solver / "scipy-huber.toml")
    findings = check_solver(entry, isolated=False)
    assert [finding for finding in findings if finding.verdict in ("failed", "skipped")] == []


def test_the_documented_checks_are_those_that_run() -> None:
    text = (ROOT / "docs" / "how-to" / "add-a-solver.md").read_text("utf-8").partition("| check | fails when |")[2]
    assert re.findall(r"^\| ([a-z ]+) \|", text, flags=re.MULTILINE) == list(CHECKS)


def test_the_documented_entry_point_is_found(documented_solver: Path) -> None:
    install_project(documented_solver)
    assert "scipy" in {entry.name for entry in metadata.entry_points(group="rsbench.solvers")}
    assert "scipy" in list_solvers()
    assert load_solver_entry("scipy").name == "scipy"


OLDER = {"footage"}
"""Folders of results with files that code before 1.1 made; empty when 1.1 is released."""


def test_results_are_made_by_this_minor_version_or_listed_as_older() -> None:
    own, older = __version__.rpartition(".")[0], set[str]()
    for path in sorted(ROOT.glob("results/*/*provenance.json")):
        if read_json(path)["rsbench"].rpartition(".")[0] != own:
            older.add(path.parent.name)
    assert older == OLDER


# Packaging


def test_badges_and_citation_tell_what_the_package_says() -> None:
    readme = (ROOT / "README.md").read_text("utf-8")
    project = read_toml(ROOT / "pyproject.toml")["project"]
    (python,) = re.findall(r"badge/python-([\d.]+)%20or%20later", readme)
    (licence,) = re.findall(r"badge/licence-(\w+)-", readme)
    assert (f">={python}", licence) == (project["requires-python"], project["license"])
    citation = (ROOT / "CITATION.cff").read_text("utf-8")
    (entry,) = blocks(ROOT / "README.md", "bibtex")
    for bibtex, cff in (("title", "title"), ("version", "version"), ("url", "repository-code")):
        (shown,) = re.findall(rf"^  {bibtex} *= \{{+(.*?)\}}+,?$", entry, re.MULTILINE)
        (stated,) = re.findall(rf"^{cff}: \"?(.*?)\"?$", citation, re.MULTILINE)
        assert shown == stated
    assert RELEASE in entry


def test_the_documented_card_is_one(tmp_path: Path) -> None:
    text, *_ = blocks(DOCS / "how-to" / "make-data.md", "toml")
    (tmp_path / "mine.toml").write_text(text, "utf-8")
    card = load_dataset_card(str(tmp_path / "mine.toml"))
    assert card.camera.lens is not None and card.sensor is not None and "imu" in card.channels
