"""Components of others: found by card or entry point, and never able to do harm to another command."""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from commands import install_package
from programs import run_python

from rsbench.components import imports
from rsbench.components.plugins import Entry, Kind, NoOptions, list_names, load_class, load_entry, offers
from rsbench.core.errors import RsbenchError


class Greeting(ABC):
    """A contract of one method."""

    @abstractmethod
    def word(self) -> str:
        """What it says."""


def _no_shouting(greeting: Greeting) -> None:
    if greeting.word().isupper():
        raise ValueError(f"word = {greeting.word()!r}: must not be shouted")


GREETINGS: Kind[Greeting, NoOptions] = Kind(
    singular="greeting",
    cards="matchers",  # any folder will do
    group="rsbench.greetings",
    base=Greeting,
    options=NoOptions,
    check=_no_shouting,
)
MODULE = """
import sys
from test_plugins_contract import Greeting

class Hello(Greeting):
    def __init__(self, times=1):
        self.times = times
    def word(self):
        return "hello " * self.times
"""


@pytest.fixture(autouse=True)
def clean_imports(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The modules and the path as they were; the contract by a name that modules of a test can import."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(imports, "_folders", [])
    monkeypatch.setattr(imports, "_beside_cards", {})
    monkeypatch.setitem(sys.modules, "test_plugins_contract", sys.modules[__name__])
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        del sys.modules[name]


def write(folder: Path, target: str = "hello:Hello", module: str = MODULE, rest: str = "") -> Path:
    """A module and a card beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "hello.py").write_text(module, "utf-8")
    card = folder / "mine.toml"
    card.write_text(f'class = "{target}"\n{rest}', "utf-8")
    return card


def word(entry: Entry[Greeting, NoOptions]) -> str:
    return entry.component.word()


def refusal(card: Path | str) -> str:
    """The one line with which it is refused."""
    with pytest.raises(RsbenchError) as caught:
        load_entry(GREETINGS, card)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, package: str, points: str) -> None:
    """Metadata of a package in a folder on the path."""
    install_package(folder, package, points)
    if str(folder) not in sys.path:
        monkeypatch.syspath_prepend(folder)


# Cards


@pytest.mark.parametrize("folder", ["with space", "Zürich-東京", "a.b"])
def test_a_card_may_lie_anywhere(tmp_path: Path, folder: str) -> None:
    entry = load_entry(GREETINGS, write(tmp_path / folder, rest="[parameters]\ntimes = 2"))
    assert word(entry) == "hello hello " and entry.name == "mine" and not entry.built_in


@pytest.mark.parametrize(
    "target", ["..:x", ":", "a:b:c", "hello", "hello:", ":Hello", "he llo:Hello", "hello:Hello()", ".hello:Hello"]
)
def test_a_class_is_a_module_and_a_name(tmp_path: Path, target: str) -> None:
    message = refusal(write(tmp_path, target))
    assert "mine.toml" in message and repr(target) in message and "'package.module:Class'" in message


@pytest.mark.parametrize(
    ("module", "parts"),
    [
        ("raise RuntimeError('no\\nluck')", ["cannot be imported", "RuntimeError: no luck"]),
        ("import sys; sys.exit(3)", ["cannot be imported", "SystemExit: 3"]),
        ("def (", ["cannot be imported", "SyntaxError"]),
        ("import nowhere_at_all", ["cannot be imported", "nowhere_at_all"]),
        ("Hello = 3", ["3 is not a greeting", "Greeting"]),
        ("class Hello: pass", ["is not a greeting", "concrete subclass"]),
        ("from test_plugins_contract import Greeting\nclass Hello(Greeting): pass", ["it lacks word"]),
        (MODULE.replace("self.times = times", "1 / 0"), ["ZeroDivisionError: division by zero"]),
        (MODULE.replace("self.times = times", "sys.exit(1)"), ["SystemExit: 1"]),
        (MODULE.replace('"hello " * self.times', '"HELLO"'), ["word = 'HELLO': must not be shouted"]),
        (MODULE.replace('"hello " * self.times', "1 / 0"), ["declares what cannot be", "ZeroDivisionError"]),
    ],
)
def test_what_a_module_does_wrong_is_one_line(tmp_path: Path, module: str, parts: list[str]) -> None:
    message = refusal(write(tmp_path, module=module))
    for part in ("mine.toml", *parts):
        assert part in message


def test_what_a_module_prints_stays_out_of_answers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    load_entry(GREETINGS, write(tmp_path, module="print('loading')\n" + MODULE))
    captured = capsys.readouterr()
    assert captured.out == "" and "loading" in captured.err


@pytest.mark.parametrize(
    ("parameters", "part"),
    [
        ("tims = 2", "unknown key 'tims' (did you mean 'times'?)"),
        ("times = nan", "times = nan: numbers must be finite"),
        ("self = 1", "unknown key 'self'"),
        ("class = 1", "unknown key 'class'"),
        ("times = 'x'", "declares what cannot be"),  # multiplies a text by a text
    ],
)
def test_parameters_are_those_of_the_constructor(tmp_path: Path, parameters: str, part: str) -> None:
    assert part in refusal(write(tmp_path, rest=f"[parameters]\n{parameters}"))


@pytest.mark.parametrize("field", ["times: 'Nowhere' = 1", "times: complex = 1j", "times: Greeting = None"])
def test_fields_that_no_card_can_hold_only_matter_when_a_card_sets_them(tmp_path: Path, field: str) -> None:
    module = f"""
from dataclasses import dataclass
from test_plugins_contract import Greeting

@dataclass(frozen=True)
class Hello(Greeting):
    {field}
    def word(self):
        return "hello"
"""
    assert word(load_entry(GREETINGS, write(tmp_path, module=module))) == "hello"
    assert "times" in refusal(write(tmp_path, module=module, rest="[parameters]\ntimes = [1]")) or "fields" in (
        refusal(tmp_path / "mine.toml")
    )


# Modules beside cards


def test_two_modules_of_one_name_are_never_taken_for_each_other(tmp_path: Path) -> None:
    first = load_entry(GREETINGS, write(tmp_path / "a"))
    message = refusal(write(tmp_path / "b", module=MODULE.replace("hello ", "bye ")))
    assert "module 'hello' is taken by" in message and str(tmp_path / "a" / "hello.py") in message
    assert word(first) == "hello "
    assert word(load_entry(GREETINGS, tmp_path / "a" / "mine.toml")) == "hello "


def test_a_module_that_is_installed_is_not_taken_for_that_beside_the_card(tmp_path: Path) -> None:
    (tmp_path / "wave.py").write_text(MODULE, "utf-8")
    card = write(tmp_path, "wave:Hello")  # also a module of the standard library
    message = refusal(card)
    assert "module 'wave' is taken by" in message and "rename" in message


def test_a_helper_beside_the_card_is_found_and_never_confused(tmp_path: Path) -> None:
    uses = MODULE.replace("import sys", "import greeting_words").replace('"hello "', "greeting_words.WORD")
    for folder, text in (("a", "hi "), ("b", "ho ")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "greeting_words.py").write_text(f"WORD = {text!r}", "utf-8")
        (tmp_path / folder / f"hello_{folder}.py").write_text(uses, "utf-8")
    assert word(load_entry(GREETINGS, write(tmp_path / "a", "hello_a:Hello"))) == "hi "
    assert "module 'greeting_words' is taken by" in refusal(write(tmp_path / "b", "hello_b:Hello"))


def test_a_module_that_is_imported_later_is_found_too(tmp_path: Path) -> None:
    module = MODULE.replace(
        "        return ", "        import greeting_words\n        return greeting_words.WORD + "
    )
    (tmp_path / "greeting_words.py").write_text("WORD = 'late '", "utf-8")
    assert word(load_entry(GREETINGS, write(tmp_path, module=module))) == "late hello "


def test_an_edited_module_is_read_again(tmp_path: Path) -> None:
    first = load_entry(GREETINGS, write(tmp_path))
    second = load_entry(GREETINGS, write(tmp_path, module=MODULE.replace("hello ", "good day ")))
    assert word(second) == "good day " and first.key != second.key


def test_an_edited_helper_is_a_change_of_the_key(tmp_path: Path) -> None:
    uses = MODULE.replace("import sys", "from greeting_words import WORD").replace('"hello "', "WORD")
    keys, words = set[str](), list[str]()
    for text in ("hi ", "servus "):
        (tmp_path / "greeting_words.py").write_text(f"WORD = {text!r}", "utf-8")
        entry = load_entry(GREETINGS, write(tmp_path, module=uses))
        keys.add(entry.key)
        words.append(word(entry))
    assert words == ["hi ", "servus "] and len(keys) == 2


# Installed packages


def test_an_installed_class_is_found_by_name_and_by_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "hello.py").write_text(MODULE, "utf-8")
    install(tmp_path, monkeypatch, "hello_package", "[rsbench.greetings]\nhi = hello:Hello\n")
    entry = load_entry(GREETINGS, "hi")
    assert word(entry) == "hello " and entry.name == "hi" and entry.path is None
    assert load_class(GREETINGS, "hi", tmp_path / "some.toml") is type(entry.component)
    assert load_class(GREETINGS, "hello:Hello", tmp_path / "some.toml") is type(entry.component)
    (offer,) = [offer for offer in offers(GREETINGS) if offer.name == "hi"]
    assert offer.origin == "hello_package"


@pytest.mark.parametrize(
    "text", ["[rsbench.greetings]\nno equals sign\n", "[rsbench.greetings\n", "\0\n", "= x\n"]
)
def test_a_package_with_unreadable_entry_points_stops_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    install(tmp_path, monkeypatch, "broken", text)
    (tmp_path / "hello.py").write_text(MODULE, "utf-8")
    install(tmp_path, monkeypatch, "sound", "[rsbench.greetings]\nhi = hello:Hello\n")
    (tmp_path / "empty-1.0.dist-info").mkdir()
    assert word(load_entry(GREETINGS, "hi")) == "hello "


def test_one_package_twice_on_the_path_is_no_clash(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in ("a", "b"):
        points = "[rsbench.greetings]\nhi = hello:Hello\n"
        install(tmp_path / folder, monkeypatch, "hello_package", points)
        (tmp_path / folder / "hello.py").write_text(MODULE, "utf-8")
    assert word(load_entry(GREETINGS, "hi")) == "hello "
    assert list_names(GREETINGS).count("hi") == 1


def test_a_clash_is_an_error_of_that_name_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "hello.py").write_text(MODULE, "utf-8")
    install(tmp_path, monkeypatch, "one", "[rsbench.greetings]\ntwice = hello:Hello\nhi = hello:Hello\n")
    install(tmp_path, monkeypatch, "two", "[rsbench.greetings]\ntwice = other:Hello\n")
    assert word(load_entry(GREETINGS, "hi")) == "hello "
    message = refusal("twice")
    assert "hello:Hello of one" in message and "other:Hello of two" in message


@dataclass(frozen=True)
class Polite(Greeting):
    inner: Greeting | None = None

    def word(self) -> str:
        return "please"


def test_what_is_ours_around_what_is_not_is_not_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stranger = load_entry(GREETINGS, write(tmp_path))
    monkeypatch.setattr(Polite, "__module__", "rsbench.polite")
    for inner, built_in in ((None, True), (stranger.component, False)):
        entry = Entry(name="x", path=None, description="", component=Polite(inner), options=NoOptions(), key="x")
        assert entry.built_in == built_in


def test_a_package_that_starts_a_thread_keeps_no_command_from_ending(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And what it says of itself moves no cursor: its escapes are shown as text."""
    module = "import threading, time\nfrom rsbench.solvers.engine.base import Solver\n"
    module += "threading.Thread(target=time.sleep, args=(3600,)).start()\n"
    module += "import atexit\natexit.register(print, 'the end')\n"
    module += 'class Mine(Solver):\n    """\x1b[2J\x1b[31mRed\x07 words.\n\n    More."""\n'
    (tmp_path / "waiting.py").write_text(module, "utf-8")
    install(tmp_path, monkeypatch, "waiting", "[rsbench.solvers]\nwaiting = waiting:Mine\n")
    ran = run_python("-m", "rsbench", "list", "solvers", path=[tmp_path])  # an hour without the mend
    assert ran.returncode == 0, ran.stderr
    assert "waiting" in ran.stdout and "rs-stereo-refined" in ran.stdout and "the end" in ran.stdout
    assert "\x1b" not in ran.stdout + ran.stderr and "\x07" not in ran.stdout
