"""The leaderboard's pages: numbers of the CSV, nothing of a stranger's unescaped, and a browser can use them."""

from __future__ import annotations

import csv
import json
import re
import shutil
import statistics
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from analytic_dataset import write_analytic_dataset
from browser import CHROMIUM, Browser, started
from leaderboards import erring, named, small_split, truth_lines, write

from rsbench.benchmark.leaderboard.board import ORACLES, add
from rsbench.benchmark.leaderboard.submissions import write_truth
from rsbench.benchmark.leaderboard.track import Split
from rsbench.benchmark.leaderboard.tracks import TRACKS
from rsbench.components.motion_models import LinearMotion
from rsbench.core.camera import PinholeCamera
from rsbench.core.rig import StereoRig
from rsbench.core.shutter import RollingShutter
from rsbench.report.board_figures import ErrorLine, curves, drawable
from rsbench.report.board_page import build_site
from rsbench.storage.files import read_depth, read_png, write_depth

SPLIT = small_split(30)
ID = f"points-1--{SPLIT.name}"
HOSTILE = {
    "description": "<script>document.title = 'caught'</script>",
    "authors": "\"'><img src=x onerror=alert(1)>",
    "paper": "javascript:alert(1)",
    "code": 'https://example.org/"onmouseover="alert(1)',
    "tuned_on": "=HYPERLINK(1)",
}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three methods that err more and more, of which the second uses more than the others, and the truth."""
    folder = tmp_path_factory.mktemp("site")
    truth = truth_lines(SPLIT)
    for name, size, shift, uses in (
        ("best_one", 0.002, 0.01, ("left",)),
        ("middle", 0.02, 0.02, ("left", "readout")),
        ("weak", 0.06, 0.04, ("left",)),
    ):
        lines = erring(truth[1:], size, shift)
        if name == "best_one":
            spread = np.diag([size**2] * 3 + [shift**2] * 3).tolist()
            lines = [{**line, "metric": True, "covariance": spread} for line in lines]
        head = {**truth[0], **(HOSTILE if name == "weak" else {})}
        add(folder / "board", write(folder / "x.jsonl", named([head, *lines], name, uses)), SPLIT, {})
    add(folder / "board", write(folder / "x.jsonl", truth), SPLIT, {"command": ORACLES})
    build_site(folder / "board", folder / "out")
    return folder / "out"


def _with_an_entry(board: Path, split: Split) -> Path:
    """The truth of a split as an entry of a board."""
    lines = named(truth_lines(split), "mine", ("left",))
    add(board, write(board.with_name("x.jsonl"), lines), split, {})
    return board


def test_of_a_secret_split_no_problem_is_told(tmp_path: Path) -> None:
    """From a few exact errors of one problem its truth could be computed."""
    page = build_site(_with_an_entry(tmp_path / "board", replace(SPLIT, public=False)), tmp_path / "out")
    pages = list((tmp_path / "out").rglob("*.html"))
    assert sorted(path.name for path in pages) == ["index.html", "mine.html"] and page in pages
    names = [each.name for each in SPLIT.truths]
    for path in (tmp_path / "out").rglob("*.*"):
        text = path.read_text("utf-8")
        assert "problems.html" not in text and not any(re.search(rf"\b{name}\b", text) for name in names)
    assert f"{len(names)} problems" in page.read_text("utf-8")


def test_where_there_is_a_secret_split_it_comes_first_and_ranks(tmp_path: Path) -> None:
    words, board = ("Secret: it ranks.", "Its truth is public: for practice."), tmp_path / "board"
    text = build_site(_with_an_entry(board, SPLIT), tmp_path / "out").read_text("utf-8")
    assert not any(word in text for word in words)
    _with_an_entry(board, replace(SPLIT, public=False, label="secret", seed=12))
    text = build_site(board, tmp_path / "out").read_text("utf-8")
    assert 0 < text.index(words[0]) < text.index(words[1])


def test_tables_that_the_folder_has_already_stay_on_the_first_page(site: Path, tmp_path: Path) -> None:
    out, board = tmp_path / "out", _with_an_entry(tmp_path / "board", replace(SPLIT, label="other", seed=12))
    shutil.copytree(site, out)
    for _ in range(2):  # written again, the page is the same
        text = build_site(board, out).read_text("utf-8")
        assert text.count("<section ") == 2 and text.count(f'href="#{ID}"') == 1 and "best_one" in text
    (out / f"{ID}.csv").unlink()
    assert build_site(board, out).read_text("utf-8").count("<section ") == 1


class _Cells(HTMLParser):
    """Keys of the columns, and of each entry the values by column."""

    def __init__(self) -> None:
        super().__init__()
        self.keys: list[str] = []
        self.rows: list[tuple[str, list[str]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {key: value or "" for key, value in attrs}
        if tag == "th" and "data-key" in found:
            self.keys.append(found["data-key"])
        if tag == "tr" and "data-method" in found:
            self.rows.append((found["data-method"], []))
        if tag == "td" and "data-value" in found:
            self.rows[-1][1].append(found["data-value"])


def test_the_page_holds_the_numbers_of_the_csv(site: Path) -> None:
    page = _Cells()
    page.feed((site / "index.html").read_text("utf-8"))
    table = {row["method"]: row for row in csv.DictReader((site / f"{ID}.csv").read_text("utf-8").splitlines())}
    assert [method for method, _ in page.rows] == list(table) == ["best_one", "weak", "middle", "truth"]
    for method, values in page.rows:
        numbers = dict(zip(page.keys[2:-2], values, strict=True))
        assert set(numbers) < set(table[method])
        for key, value in numbers.items():
            expected = table[method][key]
            same = value == expected or float(value.replace("Infinity", "inf")) == float(expected)
            assert same, (method, key)


def test_what_strangers_write_is_text(site: Path) -> None:
    pages = {path.name: path.read_text("utf-8") for path in site.rglob("*.html")}
    assert "&lt;script&gt;document.title" in pages["weak.html"] and "&lt;img src=x" in pages["weak.html"]
    for text in pages.values():
        assert "<img" not in text and "document.title =" not in text.replace("&lt;script&gt;document.title =", "")
        assert not re.search(r'href="javascript', text) and not re.search(r'"onmouseover="', text)
        assert "default-src 'none'" in text
        assert not re.search(r"""(src|url|@import)\s*[=(]\s*["']?\s*(https?:|//)""", text)
    assert "=HYPERLINK" not in (site / f"{ID}.csv").read_text("utf-8")


def test_tables_for_papers_hold_the_same_lines(site: Path) -> None:
    markdown, latex = ((site / f"{ID}.{end}").read_text("utf-8") for end in ("md", "tex"))
    for text in (markdown, latex):
        assert r"best\_one" in text and "1 [1, " in text
    assert len({line.count("|") for line in markdown.splitlines()}) == 1
    rows = [line for line in latex.splitlines() if line.endswith(r"\\")]
    assert len(rows) == 5 and len({row.count("&") for row in rows}) == 1


def test_curves_are_medians_of_parts() -> None:
    rng = np.random.default_rng(0)
    facts, errors = pd.Series(np.repeat([1.0, 2.0, 4.0], 20)), rng.lognormal(size=60)
    lines = drawable(
        [ErrorLine("<a>", errors, False), ErrorLine("truth", 0.0 * errors, True), ErrorLine("bound", errors, True)]
    )
    assert [line.name for line in lines] == ["<a>", "bound"]  # the truth does not err
    scenes = [str(k) for k in range(60)]
    drawn = curves(facts, lines, scenes)
    medians = ", ".join(f"{statistics.median(errors[20 * k : 20 * k + 20]):.3g}" for k in range(3))
    assert drawn is not None and f"at 1, 2, 4: &lt;a&gt;: {medians}; bound" in drawn
    # Each interval is drawn from its upper to its lower end: the 6th and the 15th of 20 values (binomial table).
    axis = re.findall(r'<path d="((?:M[\d.]+ [\d.]+V[\d.]+)+)"', drawn)
    places = np.array(re.findall(r"M[\d.]+ ([\d.]+)V([\d.]+)", axis[0]), dtype=float)
    ends = np.log10([[part[14], part[5]] for part in np.sort(errors.reshape(3, 20), axis=1)])
    slope = np.diff(places.ravel()) / np.diff(ends.ravel())
    np.testing.assert_allclose(slope, slope[0], rtol=0.02)  # places are rounded to 0.1 px
    assert curves(pd.Series(["box", "plane"] * 30), lines, scenes) is not None
    assert curves(pd.Series(np.ones(60)), lines, scenes) is None


# In a browser


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("needs a chromium: what the pages do, and look like")
    with started(tmp_path_factory.mktemp("browser")) as found:
        yield found


@pytest.fixture
def page(site: Path, browser: Browser) -> Iterator[Browser]:
    """At the index; nothing may be said to the console, or be asked of another machine."""
    browser.said.clear()
    browser.asked.clear()
    browser.appear()
    browser.open((site / "index.html").as_uri())
    yield browser
    assert browser.said == []
    assert all(address.startswith(("file:", "data:")) for address in browser.asked)


SEEN = "[...document.querySelectorAll('tr.entry')].filter((row) => !row.hidden).map((row) => row.dataset.method)"


def _click(page: Browser, selector: str) -> None:
    page.run(f"document.querySelector({selector!r}).click()")


def test_tables_sort_and_filter(page: Browser) -> None:
    assert page.run(SEEN) == ["best_one", "weak", "middle", "truth"]
    _click(page, "th[data-key=auc_5] button")
    assert page.run(SEEN) == ["truth", "best_one", "middle", "weak"]
    _click(page, "th[data-key=auc_5] button")
    assert page.run(SEEN) == ["weak", "middle", "best_one", "truth"]
    assert page.run("location.hash") == f"#{ID}?dir=up&sort=auc_5"
    _click(page, "input[value=readout]")
    assert page.run(SEEN) == ["weak", "best_one", "truth"]
    _click(page, ".reset")
    find = "const find = document.querySelector('input[type=search]')"
    page.run(f"{{ {find}; find.value = 'WEA'; find.dispatchEvent(new Event('input')); }}")
    assert page.run(SEEN) == ["weak"]
    assert page.run("document.querySelector('output').textContent") == "1 of 4 entries"
    assert page.run("document.title") == "rsbench leaderboard"  # no script of a stranger ran


def test_addresses_lead_to_a_table_an_entry_and_a_problem(site: Path, page: Browser) -> None:
    page.open(f"{(site / 'index.html').as_uri()}#{ID}?sort=e_R_deg&dir=down&uses=left+truth")
    assert page.run(SEEN) == ["weak", "best_one", "truth"]
    assert page.run("document.querySelector('th[data-key=e_R_deg]').getAttribute('aria-sort')") == "descending"
    _click(page, "tr[data-method=weak] a")
    page.open((site / ID / "weak.html").as_uri())
    problem = page.run("document.querySelector('#worst + div tbody a').href")
    page.open(problem)
    name = page.run("document.querySelector('tr:target th').textContent")
    assert problem.endswith(f"#{name}")
    place = page.run(
        "(({top}) => [top, innerHeight])(document.querySelector('tr:target').getBoundingClientRect())"
    )
    assert 0.0 <= place[0] < place[1]


def test_the_keyboard_is_enough(page: Browser) -> None:
    """Each control is reached with Tab in the order of the page, shows that, and works."""
    reached = []
    for _ in range(100):
        page.press("Tab")
        told = page.run(
            "(({tagName, textContent, outerHTML}, style) => [tagName, textContent, style.outlineStyle])"
            "(document.activeElement, getComputedStyle(document.activeElement))"
        )
        if told[0] == "BODY":
            break
        assert told[2] != "none", told
        reached.append(told[1])
    every = "[...document.querySelectorAll('a, button, input, [tabindex]')]"
    links = page.run(f"{every}.filter((each) => each.checkVisibility()).length")
    assert len(reached) >= links - 1  # the end of the page may be the browser's own
    page.run("document.querySelector('th[data-key=auc_5] button').focus()")
    page.press("Enter", text="\r")
    assert page.run(SEEN) == ["truth", "best_one", "middle", "weak"]
    page.run("document.querySelector('input[value=readout]').focus()")
    page.press(" ", text=" ")
    assert page.run(SEEN) == ["truth", "best_one", "weak"]


def _pages(site: Path) -> list[Path]:
    return [site / "index.html", site / ID / "best_one.html", site / f"{ID}--problems.html"]


def test_a_phone_scrolls_no_page_sideways(site: Path, page: Browser) -> None:
    page.appear(width=375)
    for path in _pages(site):
        page.open(path.as_uri())
        wide = page.run("[document.documentElement.scrollWidth, innerWidth]")
        assert wide[0] <= wide[1] == 375, path.name
        rows = page.run("[...document.querySelectorAll('tbody tr')].map((row) => row.clientHeight)")
        assert max(rows) < 60, (path.name, "names stand in a column of letters")


COLUMNS = "[...document.querySelectorAll('thead th')].filter((h) => !h.hidden).map((h) => h.dataset.key)"


def test_the_first_columns_fit_a_screen_and_all_are_one_click_away(page: Browser) -> None:
    telling = ["method", "rank", "auc_5", "flip", "failure", "e_R_deg", "e_T_deg"]
    telling += ["covers_95", "log_score", "log_rank"]
    assert page.run(COLUMNS) == telling
    for width in (1280, 768):
        page.appear(width=width)
        room = page.run(
            "(({scrollWidth, clientWidth}) => [scrollWidth, clientWidth])(document.querySelector('.wide'))"
        )
        assert width < 1000 or room[0] <= room[1]
        assert max(page.run("[...document.querySelectorAll('tr.entry')].map((row) => row.clientHeight)")) < 30
    page.appear(width=390)
    edge = page.run("document.querySelector('tr.entry td[data-value] + td').getBoundingClientRect().right")
    assert edge <= 390  # name, rank and score
    _click(page, "input.all")
    assert page.run("location.hash") == f"#{ID}?columns=all"
    assert set(telling) < {*page.run(COLUMNS)} and {"uses", "auc_1", "ties"} < {*page.run(COLUMNS)}


def test_ranks_stand_below_what_their_group_uses(page: Browser) -> None:
    """A rank counts among those that use no more; by another column all are sorted together, with their uses."""
    shown = "[...document.querySelectorAll('tbody tr')].filter((r) => !r.hidden).map((r) => r.textContent.trim())"
    _click(page, "th[data-key=rank] button")
    heads = [row for row in page.run(shown) if row.startswith("uses")]
    assert heads == ["uses left, ranked among 2", "uses left + readout, ranked among 3", "uses truth"]
    assert page.run(SEEN) == ["best_one", "weak", "middle", "truth"] and "uses" not in page.run(COLUMNS)
    _click(page, "th[data-key=auc_5] button")
    assert not any(row.startswith("uses") for row in page.run(shown))
    beside = "[...document.querySelectorAll('.uses')].map((each) => [each.textContent, each.checkVisibility()])"
    assert page.run(beside) == [["truth", True], ["left", True], ["left + readout", True], ["left", True]]


AXE = find_spec("axe_core_python")


@pytest.mark.skipif(AXE is None, reason="needs axe-core-python: the rules of accessibility")
def test_pages_have_no_serious_fault_of_accessibility(site: Path, rendered_site: Path, page: Browser) -> None:
    """Names of controls, headers of tables, landmarks, contrast: on the screen, in the dark and in print."""
    assert AXE is not None and AXE.submodule_search_locations is not None
    script = (Path(AXE.submodule_search_locations[0]) / "axe.min.js").read_text("utf-8")
    for number, path in enumerate([*_pages(site), _page_of(rendered_site, "correction")]):
        page.open(path.as_uri())
        page.run(f"{script}\n;0")
        for media, dark in (("", False), ("", True), ("print", True))[: 3 if number == 0 else 1 + number % 2]:
            page.appear(media=media, dark=dark)
            only = "resultTypes: ['violations']" + (", runOnly: ['color-contrast']" if media or dark else "")
            told = page.run(
                f"axe.run(document, {{{only}}}).then((found) => found.violations.map("
                "(v) => [v.impact, v.id, v.nodes.map((n) => n.html.slice(0, 200)).slice(0, 3)]))"
            )
            grave = [fault for fault in told if fault[0] in ("serious", "critical")]
            assert not grave, (path.name, media, dark, grave)


# Rendered frames


HALF = (33, 145, 140)
"""The middle of viridis, #21918c."""


@pytest.fixture(scope="module")
def rendered_site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sequence: its true motion; depth wrong by 1.5 px; frames too bright by 32, an eighth not drawn."""
    folder = tmp_path_factory.mktemp("rendered")
    rig = StereoRig(camera=PinholeCamera.centred(96, 72, 80.0), baseline=0.2)
    motion = LinearMotion(np.array([0.01, -0.02, 0.01]), np.array([0.1, 0.0, 0.2]))
    shutter = RollingShutter(height=72, readout_ratio=0.8)
    write_analytic_dataset(folder / "data", rig, shutter, motion, twins=(36,))
    splits = {track: TRACKS[track].split(folder / "data") for track in ("pose", "depth", "correction")}
    truth = write(folder / "x.jsonl", truth_lines(splits["pose"]))
    add(folder / "board", truth, splits["pose"], {"command": ORACLES})
    for track in ("depth", "correction"):
        path = write_truth(splits[track], folder / track)
        lines = [json.loads(line) for line in path.read_text("utf-8").splitlines()]
        for picture in (path.parent / "pictures" / "planes").iterdir():
            if track == "depth":
                depth = read_depth(picture).astype(np.float64)
                write_depth(picture, (16.0 / (16.0 / depth + 1.5)).astype(np.float32))
            else:
                alpha = np.full((72, 96, 1), 255, dtype=np.uint8)
                alpha[:9] = 0
                shown = np.dstack([read_png(picture)[..., ::-1] + np.uint8(32), alpha])
                cv2.imwrite(str(picture), shown)
        add(folder / "board", write(path, named(lines, "slip", ("images",))), splits[track], {})
    build_site(folder / "board", folder / "out", [folder / "data"])
    return folder / "out"


def _page_of(site: Path, track: str) -> Path:
    (page,) = site.glob(f"{track}-1--*/problem/planes.html")
    return page


def _picture(page: Path, title: str) -> np.ndarray:
    """RGB, of the only picture with that title."""
    (file,) = re.findall(rf'<img src="([^"]+)" alt="{title}"', page.read_text("utf-8"))
    read = cv2.imread(str(page.parent / file))
    assert read is not None
    return np.asarray(read[..., ::-1], dtype=float)


def test_a_sequence_has_its_pictures(rendered_site: Path) -> None:
    page = _page_of(rendered_site, "pose")
    true = [read_png(rendered_site.parent / f"data/planes/rs/left_{k}.png").astype(float) for k in (0, 1)]
    for frame in (0, 1):
        shown = _picture(page, f"rolling-shutter frame {frame}")
        own, other = (np.mean(np.abs(shown - each)) for each in (true[frame], true[1 - frame]))
        assert own < 0.6 * other  # colours of these fine waves are what JPEG keeps least
    (entry,) = rendered_site.glob("pose-1--*/truth.html")
    thumbs = re.findall(r'<img src="([^"]+)"', entry.read_text("utf-8"))
    assert thumbs and all((entry.parent / file).is_file() for file in thumbs)
    assert sum(path.stat().st_size for path in rendered_site.rglob("*")) < 15e6


def test_error_maps_show_what_is_wrong(rendered_site: Path) -> None:
    """Half of the largest error of each map, so the middle of its colours; JPEG costs some levels."""
    depth = _picture(_page_of(rendered_site, "depth"), "slip, error")
    np.testing.assert_allclose(np.median(depth, axis=(0, 1)), HALF, atol=4)
    for row in ("first", "middle"):
        frame = _picture(_page_of(rendered_site, "correction"), f"slip, {row} row, error")
        np.testing.assert_allclose(np.median(frame[16:], axis=(0, 1)), HALF, atol=4)
        np.testing.assert_allclose(np.median(frame[:6], axis=(0, 1)), (60, 60, 66), atol=4)  # not drawn


def test_the_divider_cuts_the_upper_picture(rendered_site: Path, browser: Browser) -> None:
    browser.said.clear()
    browser.appear(width=375)
    browser.open(_page_of(rendered_site, "correction").as_uri())
    over = "document.querySelector('.compare img.over')"
    assert browser.run(f"{over}.decode().then(() => {over}.naturalWidth)") == 96
    assert browser.run(f"{over}.style.clipPath") == "inset(0px 50% 0px 0px)"
    browser.run("document.querySelector('.compare input').focus()")
    browser.press("Home")
    assert browser.run(f"{over}.style.clipPath") == "inset(0px 100% 0px 0px)"
    browser.press("ArrowRight")
    assert browser.run(f"{over}.style.clipPath") == "inset(0px 99% 0px 0px)"
    sources = browser.run("['over', 'under'].map((n) => document.querySelector(`.compare img.${n}`).alt)")
    assert sources == ["rolling-shutter frame 1", "slip, first row"]
    assert browser.run("document.documentElement.scrollWidth") <= 375
    assert browser.said == []
