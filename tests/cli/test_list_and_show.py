"""Names: listed, shown and completed; and what holds for every command."""

from __future__ import annotations

import itertools
import json
import re
import subprocess
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

import pytest
from commands import install_package, run_apart, run_here

from rsbench.cli import console
from rsbench.cli.main import app
from rsbench.cli.names import COMPONENTS, kind_names, names_of, parameters_of
from rsbench.components.cards import FORMER_NAMES, CardKind, list_cards, read_toml
from rsbench.solvers.engine.base import list_solvers, load_solver_entry


def rsbench(*arguments: str, path: Path | None = None, **environment: str) -> subprocess.CompletedProcess[str]:
    """In this process, or in a new one that finds the packages in ``path``."""
    if path is None:
        return run_here(*arguments, **environment)
    return run_apart(*arguments, path=path, **environment)


def answer(*arguments: str) -> Any:
    result = rsbench(*arguments, "--json")
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


# list


@pytest.mark.parametrize("kind", kind_names())
def test_every_kind_is_listed(kind: str) -> None:
    listed = answer("list", kind)
    assert [row["name"] for row in listed] == names_of(kind) and listed
    for row in listed:
        assert row["description"] and row["broken"] is None
        assert row["origin"] == "rsbench"


def test_the_kinds_are_listed_without_one() -> None:
    found = answer("list")
    assert isinstance(found, list)
    assert {row["kind"] for row in found} == set(kind_names())
    assert set(COMPONENTS) <= set(kind_names())


# show


@pytest.mark.parametrize("name", list_solvers())
def test_a_solver_is_shown_as_it_declares_itself(name: str) -> None:
    from rsbench.cli.names import _about

    about, entry = _about(name, "solvers"), load_solver_entry(name)
    spec = entry.solver.spec
    assert about["needs"] == sorted(spec.needs) and about["minimum"] == dict(spec.minimum)
    for key in ("metric", "motion_model", "shutter", "reference_point", "reference", "assumes"):
        assert about[key] == getattr(spec, key)
    assert about["robust"] == entry.options.robust and about["time_limit_s"] == entry.options.time_limit_s
    assert about["key"] == entry.key and about["card"] == str(entry.path)
    values = {row["parameter"]: row["value"] for row in about["parameters"]}
    for parameter, value in entry.parameters.items():
        assert values[parameter] == value
    json.dumps(about)


def test_every_name_of_every_kind_can_be_shown() -> None:
    from rsbench.cli.names import _about, _print

    for kind in kind_names():
        for name in names_of(kind):
            about = _about(name, kind)
            assert about["name"] == name and about["kind"] == kind
            json.dumps(about, default=str)
            _print(about)


def test_show_prints_for_people_and_for_programs(tmp_path: Path) -> None:
    text = rsbench("show", "rs-stereo-refined", COLUMNS="150").stdout
    for word in ("needs", "left = 7, right = 7", "reference point", "iterations", "60", "time limit"):
        assert word in text
    both = answer("show", "castle")
    assert isinstance(both, list) and [about["kind"] for about in both] == ["builders", "scenes"]
    one = answer("show", "castle", "--kind", "scenes")
    assert isinstance(one, dict) and one["content"]["parameters"]["trees"] == 26
    assert "# on the hills around" in rsbench("show", "castle", "--kind", "scenes").stdout
    card = tmp_path / "mine.toml"
    card.write_text(
        'class = "rsbench.solvers.linear:LinearSolver"\n[parameters]\nextraction = "symmetric"', "utf-8"
    )
    assert "--kind" in rsbench("show", str(card)).stderr
    mine = answer("show", str(card), "--kind", "solvers")
    values = {each["parameter"]: each["value"] for each in mine["parameters"]}
    assert values["extraction"] == "symmetric"
    assert "did you mean 'castle'" in rsbench("show", "casle").stderr


@dataclass(frozen=True)
class Base:
    first: int
    """What comes
    first."""


@dataclass(frozen=True)
class Whole(Base):
    second: tuple[float, float] = (1.0, 2.0)
    third: Base = field(default_factory=lambda: Base(3))
    """The third."""


def test_parameters_have_defaults_values_and_meanings() -> None:
    shown = {row["parameter"]: row for row in parameters_of(Whole, Whole(7))}
    assert list(shown) == ["first", "second", "third"]
    assert shown["first"]["meaning"] == "What comes first." and shown["first"]["default"] == "required"
    assert shown["first"]["value"] == 7 and shown["second"]["default"] == [1.0, 2.0]
    assert shown["third"]["default"] == {"first": 3} and shown["third"]["meaning"] == "The third."


# Every command


def commands() -> list[str]:
    return sorted(str(each.name or each.callback.__name__).replace("_", "-") for each in app.registered_commands)  # pyrefly: ignore[missing-attribute]


@pytest.mark.parametrize("command", commands())
def test_examples_work_away_from_the_repository(command: str) -> None:
    """Names of cards in examples exist, and no path leads into the repository."""
    text = rsbench(command, "--help", COLUMNS="300", NO_COLOR="1").stdout
    examples = re.findall(r"^\W*(?:Examples?)?\W*(rsbench .*?)\W*$", text, flags=re.MULTILINE)
    examples = [example for example in examples if not example.startswith("rsbench " + command + " [OPTIONS]")]
    assert examples, "help shows an example"
    folders = {*kind_names(), "docs", "tests", "results", "rsbench", "benchmarks"}
    known = {name for kind in kind_names() for name in names_of(kind)}
    options = {"--solver": "solvers", "--matcher": "matchers", "--correct-with": "solvers", "--kind": None}
    options |= {"--features": "features", "--corrector": "correctors", "--metric": "metrics"}
    for example in examples:
        words = example.split("(")[0].split()
        assert words[1] in commands(), example
        for option, word in itertools.pairwise(words):
            assert word.split("/")[0] not in folders or "/" not in word or word.startswith("results/"), example
            if (kind := options.get(option)) is not None and not word.endswith((".toml", ".py")):
                assert word in names_of(kind), example
        if words[1] in ("generate", "simulate", "show", "check-solver") and not words[2].endswith(
            (".toml", ".py")
        ):
            assert words[2] in known, example


def test_quiet_leaves_results_alone() -> None:
    loud, quiet = rsbench("list", "scenes"), rsbench("--quiet", "list", "scenes")
    assert "castle" in loud.stdout and quiet.stdout == quiet.stderr == ""
    assert rsbench("-q", "list", "scenes", "--json").stdout == rsbench("list", "scenes", "--json").stdout
    assert "does not exist" in rsbench("-q", "list", "nothing").stderr


def test_progress_is_never_on_stdout_and_quiet_ends_it(capsys: pytest.CaptureFixture[str]) -> None:
    for quiet in (False, True):
        console.be_quiet(quiet)
        try:
            with console.progress_bar("working", 2) as advance:
                advance("one")
                advance("two")
        finally:
            console.be_quiet(False)
        captured = capsys.readouterr()
        assert captured.out == "" and ("working" in captured.err) != quiet


def test_colours_are_left_out_where_they_are_not_wanted() -> None:
    colour = re.compile(r"\x1b\[[0-9;]*3[0-9]m")
    for arguments in (("--help",), ("list", "--help"), ("list", "scenes"), ("list", "nothing")):
        result = rsbench(*arguments, NO_COLOR="1", FORCE_COLOR="1")
        assert not colour.search(result.stdout + result.stderr)
    assert colour.search(rsbench("--help", FORCE_COLOR="1", TERM="xterm").stdout)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("rsbench show rs-stereo-l", {"rs-stereo-linear", "rs-stereo-linear-symmetric"}),
        ("rsbench list so", {"solvers"}),
        ("rsbench generate smo", {"smoke"}),
        ("rsbench check-solver gs-8", {"gs-8pt", "gs-8pt-scaled"}),
    ],
)
def test_a_shell_completes_names(words: str, expected: set[str]) -> None:
    count = str(len(words.split()) - 1)
    result = rsbench(_RSBENCH_COMPLETE="complete_bash", COMP_WORDS=words, COMP_CWORD=count)
    assert set(result.stdout.split()) == expected, result.stderr


def test_completion_offers_what_packages_offer(tmp_path: Path) -> None:
    install_package(tmp_path, "some_package", "[rsbench.solvers]\nzz-mine = nowhere:Nothing\n")
    environment = {"_RSBENCH_COMPLETE": "complete_bash", "COMP_WORDS": "rsbench show zz-", "COMP_CWORD": "2"}
    assert rsbench(path=tmp_path, **environment).stdout.split() == ["zz-mine"]
    # Which shell this is cannot be found out where there is none, as in CI: it is named instead.
    named = rsbench("--show-completion", "bash", _TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION="1")
    assert "complete" in named.stdout


# Former names


def test_no_list_shows_a_former_name_and_each_leads_to_a_component_of_today() -> None:
    for kind, names in FORMER_NAMES.items():
        listed = names_of(kind)
        assert not names.keys() & {*listed} and {*names.values()} <= {*listed}


@pytest.mark.filterwarnings("ignore:.*is now called:FutureWarning")
def test_a_former_name_stands_for_the_name_of_today(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.warns(
        FutureWarning, match="'rs-stereo' is now called 'rs-stereo-refined'; the old name is read until"
    ):
        entry = load_solver_entry("rs-stereo")
    assert entry.name == "rs-stereo-refined" and entry.key == load_solver_entry("rs-stereo-refined").key
    monkeypatch.chdir(tmp_path)  # no card lies here: as in another's folder, or with a wheel
    with pytest.warns(FutureWarning, match="is now called"):
        assert load_solver_entry("solvers/rs-stereo.toml").name == "rs-stereo-refined"
    assert "formerly" in rsbench("show", "rs-stereo", COLUMNS="150").stdout
    about = answer("show", "rs-stereo")
    assert (about["name"], about["formerly"]) == ("rs-stereo-refined", ["rs-stereo"])
    assert answer("show", "rs-stereo-tracks")["formerly"] == []


def test_no_two_cards_say_the_same() -> None:
    """Class, parameters and options: what people read (description, use, comments) makes no second thing."""
    for kind in get_args(CardKind):
        seen = {}
        for name, path in list_cards(kind).items():
            content = {k: v for k, v in read_toml(path).items() if k not in ("description", "use")}
            same = seen.setdefault(json.dumps(content, sort_keys=True, default=str), name)
            assert same == name, f"{kind}: {same} and {name}"
