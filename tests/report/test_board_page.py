"""The leaderboard's pages: numbers of the CSV, nothing of a stranger's unescaped, and a browser can use them."""

from __future__ import annotations

import csv
import json
import re
import shutil
import statistics
import subprocess
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from leaderboards import Line, named, small_split, truth_lines, write

from rsbench.benchmark.leaderboard.board import add
from rsbench.report.board_figures import ErrorLine, curves, drawable
from rsbench.report.board_page import build_site

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
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Four methods that err more and more, of which the second uses more than the others, and the truth."""
    folder = tmp_path_factory.mktemp("site")
    truth = truth_lines(SPLIT)
    rng = np.random.default_rng(0)
    for name, size, uses in (
        ("best_one", 0.002, ("left",)),
        ("middle", 0.02, ("left", "readout")),
        ("weak", 0.06, ("left",)),
    ):
        lines: list[Line] = [
            {**line, "w": (np.array(line["w"]) + size * rng.standard_normal(3)).tolist()} for line in truth[1:]
        ]
        head = {**truth[0], **(HOSTILE if name == "weak" else {})}
        add(folder / "board", write(folder / "x.jsonl", named([head, *lines], name, uses)), SPLIT, {})
    add(folder / "board", write(folder / "x.jsonl", truth), SPLIT, {})
    build_site(folder / "board", folder / "out")
    yield folder / "out"


class _Cells(HTMLParser):
    """Keys of the columns, and of each entry the values by column."""

    def __init__(self) -> None:
        super().__init__()
        self.keys: list[str] = []
        self.rows: list[tuple[str, list[str]]] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        found = {key: value or "" for key, value in attributes}
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


CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SCRIPT = """
<script>
addEventListener("load", () => {
  const section = document.querySelector("section.split");
  const rows = () => [...section.querySelectorAll("tr.entry")];
  const seen = () => rows().filter((row) => !row.hidden).map((row) => row.dataset.method);
  const press = (key) => section.querySelector(`th[data-key=${key}] button`).click();
  const out = { linked: seen(), sort: section.querySelector("th[data-key=e_R_deg]").getAttribute("aria-sort") };
  section.querySelector(".reset").click(); out.reset = seen();
  press("auc_5"); out.best = seen(); press("auc_5"); out.turned = seen(); out.hash = location.hash;
  section.querySelector("input[value=readout]").click(); out.fewer = seen();
  section.querySelector(".reset").click();
  const find = section.querySelector("input[type=search]");
  find.value = "WEA"; find.dispatchEvent(new Event("input")); out.found = seen();
  out.count = section.querySelector("output").textContent;
  out.title = document.title;
  out.asked = performance.getEntriesByType("resource").length;
  const told = document.createElement("pre");
  told.id = "told"; told.textContent = JSON.stringify(out); document.body.append(told);
});
</script>
"""


@pytest.mark.skipif(CHROMIUM is None, reason="needs a chromium: the sorting, filtering and links of the page")
def test_a_browser_sorts_filters_and_follows_links(site: Path, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text((site / "index.html").read_text("utf-8").replace("</body>", SCRIPT + "</body>"), "utf-8")
    options = (
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--enable-logging=stderr",
        f"--user-data-dir={tmp_path}/profile",
    )
    address = f"{page.as_uri()}#{ID}?sort=e_R_deg&dir=down&uses=left+truth"
    ran = subprocess.run(
        [str(CHROMIUM), *options, "--virtual-time-budget=5000", "--dump-dom", address],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    told = re.search(r'<pre id="told">(.*?)</pre>', ran.stdout)
    assert told, ran.stderr[-2000:]
    out = json.loads(told.group(1).replace("&amp;", "&"))
    assert out["linked"] == ["weak", "best_one", "truth"] and out["sort"] == "descending"
    assert out["reset"] == ["best_one", "weak", "middle", "truth"]
    assert out["best"] == ["truth", "best_one", "middle", "weak"] and out["turned"] == out["best"][::-1]
    assert out["hash"] == f"#{ID}?dir=up&sort=auc_5"
    assert out["fewer"] == ["weak", "best_one", "truth"]
    assert out["found"] == ["weak"] and out["count"] == "1 of 4 entries"
    assert out["title"] == "rsbench leaderboard" and out["asked"] == 0
    assert "CONSOLE" not in ran.stderr
