"""The documentation site builds without a warning, is one tree, and works in a browser, on a phone too."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from html import unescape
from pathlib import Path
from urllib.parse import unquote, urldefrag

import pytest
from browser import CHROMIUM, Browser, started

import rsbench

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PHONE, DESKTOP = 390, 1280


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As `make docs` builds it."""
    out = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "docs", str(out)]
    run = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr
    return out


def _pages() -> list[str]:
    return sorted(str(p.relative_to(DOCS).with_suffix("")) for p in DOCS.rglob("*") if p.suffix in (".md", ".rst"))


def _children(page: str) -> list[str]:
    """The pages that a page's tables of contents name, from the top of the documents."""
    path = DOCS / f"{page}.md"
    text = path.read_text("utf-8") if path.is_file() else ""
    entries: list[str] = []
    for block in re.findall(r"^```\{toctree\}\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        entries += [line.strip() for line in block.splitlines() if line.strip() and not line.startswith(":")]
    return [os.path.normpath(Path(page).parent / entry) for entry in entries]


def test_every_page_stands_in_one_place_of_one_tree() -> None:
    named = Counter(child for page in _pages() for child in _children(page))
    assert [page for page, times in named.items() if times > 1] == []
    assert sorted(named) == [page for page in _pages() if page != "index"]
    reached, open_pages = set(), ["index"]
    while open_pages:
        page = open_pages.pop()
        reached.add(page)
        open_pages += _children(page)
    assert sorted(reached) == _pages()


def test_a_section_says_of_each_of_its_pages_what_it_is_for() -> None:
    for page in _pages():
        text = (
            re.sub(r"```.*?```", "", (DOCS / f"{page}.md").read_text("utf-8"), flags=re.DOTALL)
            if _children(page)
            else ""
        )
        links = re.findall(r"\]\(([^)#\s]+)", text)
        linked = {os.path.splitext(os.path.normpath(Path(page).parent / link))[0] for link in links}
        assert set(_children(page)) <= linked, page


@pytest.mark.slow
def test_every_public_name_is_in_the_reference(site: Path) -> None:
    page = (site / "reference" / "python.html").read_text("utf-8")
    assert [name for name in rsbench.__all__ if f'id="rsbench.{name}"' not in page] == []


def _own(site: Path) -> list[Path]:
    """Pages of the documents; the boards' own are tested where they are made."""
    return [path for path in site.rglob("*.html") if path.relative_to(site).parts[0] != "boards"]


@pytest.mark.slow
def test_pages_load_nothing_from_elsewhere(site: Path) -> None:
    for page in _own(site):
        text = page.read_text("utf-8")
        for marker in ('src="http', 'rel="stylesheet" href="http', "fonts.googleapis", "url(http"):
            assert marker not in text, f"{page.name}: {marker}"


@pytest.mark.slow
def test_links_and_their_anchors_lead_somewhere(site: Path) -> None:
    pages = {path.resolve(): path.read_text("utf-8") for path in _own(site)}
    ids = {path: set(map(unescape, re.findall(r'\sid="([^"]+)"', text))) for path, text in pages.items()}
    broken = []
    for path, text in pages.items():
        targets = map(unescape, re.findall(r'<(?:a|img)\s(?:[^>]*\s)?(?:href|src)="([^"]+)"', text))
        for target in (each for each in targets if "://" not in each):
            file, anchor = urldefrag(target)
            to = (path.parent / unquote(file)).resolve() if file else path
            missing = anchor and to in pages and unquote(anchor) not in ids[to]
            if not to.exists() or missing:
                broken.append(f"{path.relative_to(site.resolve())}: {target}")
    assert broken == []


def _boards(site: Path) -> list[str]:
    """What the page of the boards shows in its frame: addresses below the site."""
    text = (site / "results-leaderboard.html").read_text("utf-8")
    (first,) = re.findall(r'<iframe class="board" name="board" [^>]*src="([^"]+)"', text)
    return [first, *re.findall(r'href="([^"]+)" target="board"', text)]


@pytest.mark.slow
def test_every_board_of_frames_and_points_opens_in_the_page_of_the_boards(site: Path) -> None:
    found = _boards(site)
    assert {each.split("/")[1] for each in found} == {"laws", "leaderboard", "footage", "handheld"}
    assert (site / found[0]).is_file()
    for address in found[1:]:
        file, anchor = urldefrag(address)
        assert f'<section class="split" id="{anchor}"' in (site / file).read_text("utf-8"), address
    protocols = {urldefrag(each)[1].partition("--")[0] for each in found[1:]}
    assert protocols == {
        *("points-1", "points-2", "pose-1", "pose-2", "readout-1", "readout-3", "depth-1"),
        *("correction-1", "correction-3", "correction-mono-1", "trajectory-1"),
    }, "of recordings there are tables alone"


# In a browser


@pytest.fixture(scope="module")
def page(site: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("needs a chromium: what the pages do, and look like")
    with started(tmp_path_factory.mktemp("profile")) as browser:
        yield browser


@pytest.mark.slow
def test_no_page_scrolls_sideways(site: Path, page: Browser) -> None:
    wide = []
    for path in _own(site):
        page.open(path.as_uri())
        for width in (PHONE, DESKTOP):
            page.appear(width=width)
            found = page.run("[document.documentElement.scrollWidth, innerWidth]")
            if found[0] > found[1]:
                wide.append((str(path.relative_to(site)), found))
    assert wide == []


@pytest.mark.slow
@pytest.mark.parametrize("width", [PHONE, DESKTOP])
def test_a_board_fits_its_frame(site: Path, page: Browser, width: int) -> None:
    """On a screen no column is cut; on a phone name, rank and score are seen, and names keep to few lines."""
    page.appear(width=width)
    page.open((site / "results-leaderboard.html").as_uri())
    frame = page.run("document.querySelector('iframe.board').clientWidth")
    assert frame >= min(width, 0.75 * DESKTOP)
    page.appear(width=frame)
    for board in sorted({urldefrag(each)[0] for each in _boards(site)}):
        page.open((site / board).as_uri())
        room = "[...document.querySelectorAll('.wide')].map((e) => [e.scrollWidth, e.clientWidth])"
        score = "th[data-key=failure] button"
        sort = f"document.querySelectorAll('section').forEach((each) => each.querySelector('{score}').click())"
        for click in ("", f"{sort}, ", "document.querySelectorAll('.reset').forEach((each) => each.click()), "):
            wide = page.run(f"({click}{room})")
            assert width < DESKTOP or all(needed <= has for needed, has in wide), (board, wide)
        edges = page.run(
            "[...document.querySelectorAll('table')].map((each) =>"
            " each.querySelector('tr.entry td[data-value] + td').getBoundingClientRect().right)"
        )
        rows = page.run("[...document.querySelectorAll('tr.entry')].map((row) => row.clientHeight)")
        assert max(edges) <= frame and max(rows) < 60, board


@pytest.mark.parametrize("width", [PHONE, DESKTOP])
@pytest.mark.slow
def test_the_front_page_has_four_doors_that_open(site: Path, page: Browser, width: int) -> None:
    page.appear(width=width)
    page.open((site / "index.html").as_uri())
    shown = page.run(
        "[...document.querySelectorAll('.door')].map((door) => { const box = door.getBoundingClientRect();"
        " return [door.querySelector('a').textContent, box.left >= 0 && box.right <= innerWidth,"
        " box.height > 99 && door.querySelector('img').naturalWidth > 0] })"
    )
    assert shown == [[name, True, True] for name in ("Get started", "How to", "Reference", "Explanation")]
    rows = page.run("new Set([...document.querySelectorAll('.door')].map((d) => d.offsetTop)).size")
    assert rows == (4 if width == PHONE else 2)
    for door in range(4):
        page.open((site / "index.html").as_uri())
        page.run(f"document.querySelectorAll('.door')[{door}].querySelector('a').href")
        address = page.run(f"document.querySelectorAll('.door a')[{door}].href")
        page.open(address)
        assert page.run("document.querySelector('h1').textContent").startswith(shown[door][0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        ("readout time", "how-to/inspect"),
        ("COLMAP", "how-to/export"),
        ("undistort", "how-to/correct"),
    ],
)
def test_the_search_finds(site: Path, page: Browser, words: str, wanted: str) -> None:
    page.appear(width=DESKTOP)
    page.open(f"{(site / 'search.html').as_uri()}?q={words.replace(' ', '+')}")
    found = page.run(
        "new Promise((done) => { const look = () => {"
        " const links = [...document.querySelectorAll('#search-results li a')];"
        " const over = document.querySelector('.search-summary')?.textContent.includes('found');"
        " if (over && links.length) done(links.map((link) => link.getAttribute('href')));"
        " else setTimeout(look, 20) };  setTimeout(look, 20); setTimeout(() => done([]), 20000) })"
    )
    assert any(link.startswith(f"{wanted}.html") for link in found[:5]), found
