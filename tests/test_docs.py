"""The documents are true: their links lead somewhere, the page of commands is that of today's command lines."""

import importlib.util
import json
import pkgutil
import re
import shlex
from pathlib import Path
from typing import Any

import pytest

import ground
import obbgs_core
from flightsw.icd.link.link_url import parse_link_url
from obbgs_core.methods.config import MethodConfig
from obbgs_core.settings import known_names
from tests.benchmarks import figures
from tests.benchmarks.figures import PAGES as PAGES_WITH_FIGURES
from tests.benchmarks.figures import blocks, wrong

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
LINK = re.compile(r"\]\(([^)#\s]+)[^)]*\)")
WIDEST_README = 100  # columns
LARGEST_README = 8192  # bytes
MOST_WORDS = 60_000  # of all pages in docs/
MOST_OPTIONS = 150  # and arguments, over all commands
LONGEST_RELEASE = 40  # lines of CHANGELOG.md


def test_the_changelog_counts_the_settings_that_a_wrong_name_is_answered_with():
    names = [name for name in known_names(MethodConfig) if name != "name"]
    published = sum(name.startswith("published.") for name in names)
    counts = f"{len(names) - published} settings, and {published} of published methods"
    assert counts in (ROOT / "CHANGELOG.md").read_text()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_of_a_page_leads_to_a_file(page):
    targets = [link for link in LINK.findall(page.read_text()) if "://" not in link]
    assert [link for link in targets if not (page.parent / link).exists()] == []
    if page.is_relative_to(ROOT / "docs"):  # the site holds nothing else, and is not built with such a link
        resolved = [(page.parent / link).resolve() for link in targets]
        assert [link for link in resolved if not link.is_relative_to(ROOT / "docs")] == []


def anchors(page: Path) -> set[str]:
    """Return the names of a page's headings as the site makes them (Python-Markdown's `slugify`)."""
    headings = re.findall(r"(?m)^#+ +(.*?)(?: +\{.*\})?$", page.read_text())
    words = [re.sub(r"\]\([^)]*\)", "", heading) for heading in headings]
    return {re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", text).strip().lower()) for text in words}


def test_every_link_to_a_heading_leads_to_one():
    pages = sorted((ROOT / "docs").rglob("*.md"))
    wrong_ones = [
        (page.name, f"{target}#{name}")
        for page in pages
        for target, name in re.findall(r"\]\(([^)#\s:]*)#([^)\s]+)\)", page.read_text())
        if name not in anchors((page.parent / target) if target else page)
    ]
    assert wrong_ones == []


def test_the_readme_fits_a_terminal():
    wide = [line for line in (ROOT / "README.md").read_text().splitlines() if len(line) > WIDEST_README]
    assert wide == []


def test_the_documents_are_short_enough_to_be_read():
    assert (ROOT / "README.md").stat().st_size <= LARGEST_README
    assert sum(len(page.read_text().split()) for page in (ROOT / "docs").rglob("*.md")) <= MOST_WORDS
    _, *releases = re.split(r"(?m)^(?=## )", (ROOT / "CHANGELOG.md").read_text())
    assert [r.splitlines()[0] for r in releases if len(r.strip().splitlines()) > LONGEST_RELEASE] == []


@pytest.fixture(scope="module")
def maker() -> Any:
    """The script that writes the page of commands."""
    spec = importlib.util.spec_from_file_location("make_commands", ROOT / "docs" / "make_commands.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_of_commands_is_that_of_the_command_lines(maker):
    assert (ROOT / "docs" / "commands.md").read_text() == maker.page(), "run: python docs/make_commands.py"


def test_a_name_means_the_same_in_all_commands_and_there_are_not_too_many(maker):
    meanings = maker.meanings()
    assert {name: said for name, said in meanings.items() if len(set(said.values())) > 1} == {}
    assert sum(map(len, meanings.values())) + 1 <= MOST_OPTIONS  # and --json, which all have
    commands = [command for tool in maker.TOOLS for command in maker.commands(tool)]
    assert len(commands) > 30 and "flightsw mission new" in dict(commands)
    assert [
        name for name, command in commands if not any("--json" in option.opts for option in command.params)
    ] == []
    of_today = [page for page in PAGES if page.name != "CHANGELOG.md" and page.parent.name != "experiments"]
    pages = [*of_today, *(ROOT / "examples").glob("*.ipynb")]
    text = "\n".join(path.read_text() for path in pages)
    ours = re.findall(r"(?:flightsw|ground|hil) [a-z-]+[^`|\n]*", text)
    given = {option for words in ours for option in re.findall(r"(?<![\w-])--[a-z][a-z-]*", words)}
    known = {option.strip("`") for name in meanings for option in name.split(", ")}
    assert given - known - {"--json", "--help", "--version", "--install-completion"} == set()


def shown(page: Path) -> list[list[str]]:
    """Return the words of each command of ours in a page's shell blocks."""
    blocks = re.findall(r"(?ms)^```sh\n(.*?)^```", page.read_text())
    lines = [line for block in blocks for line in re.split(r"\n|; ", block.replace("\\\n", " "))]
    words = [shlex.split(line, comments=True) for line in lines]
    return [each[: each.index(">")] if ">" in each else each for each in words if each]


def test_every_command_that_is_shown_is_one_that_is_taken(maker):
    """Each option and argument is given to its command's own parser, each link and camera to the reader of URLs."""
    known = {tuple(name.split()): command for tool in maker.TOOLS for name, command in maker.commands(tool)}
    taken = set()
    for words in [words for page in PAGES if "experiments" not in page.parts for words in shown(page)]:
        name = next((tuple(words[:n]) for n in (3, 2) if tuple(words[:n]) in known), None)
        if name is None or "..." in words:
            continue
        given = known[name].make_context(" ".join(name), words[len(name) :]).params
        if (link := given.get("link")) and not link.endswith("_URL"):  # FLIGHT_URL: as printed by hil link
            parse_link_url(link)
        camera = given.get("camera")
        assert camera is None or camera.split("://")[0] in ("hil", "gige", "mine"), words
        taken.add(name)
    assert len(taken) > 25


def test_every_public_name_of_the_library_is_there_and_says_what_it_is():
    names = re.findall(r"(?m)^::: (\S+)$", (ROOT / "docs" / "library.md").read_text())
    assert len(names) > 20
    public = set()
    for name in names:
        found = pkgutil.resolve_name(name)
        assert found.__doc__, name
        public.add(name.rpartition(".")[2])
    assert {*obbgs_core.__all__, *ground.__all__} - {
        "PRESETS"
    } <= public  # its methods are named in a sentence


def test_every_page_is_in_the_site():
    navigation = (ROOT / "mkdocs.yml").read_text()
    pages = [p.relative_to(ROOT / "docs") for p in PAGES if p.is_relative_to(ROOT / "docs")]
    assert [str(page) for page in pages if f"{page}" not in navigation] == []


@pytest.mark.parametrize("page", PAGES_WITH_FIGURES, ids=lambda page: page.name)
def test_every_figure_comes_from_rows(page):
    found = {block: problems for block in blocks(page.read_text()) if (problems := wrong(block))}
    assert found == {}


def test_a_time_to_a_quality_says_on_how_many_targets_that_is_reached(tmp_path, monkeypatch):
    def row(target: str, psnr_db: float) -> str:
        curve = [
            {"cpu_seconds": 2.0, "psnr_clean_db": 36.0},
            {"cpu_seconds": 6.0, "psnr_clean_db": psnr_db},
            {"cpu_seconds": 8.0, "psnr_clean_db": 35.0},
        ]
        what = {"method": "obbgs", "condition": "as taken", "steps_share": 1.0, "target": target}
        return json.dumps(what | {"psnr_clean_db": 36.0, "curve": curve})

    (tmp_path / "of-two-targets.jsonl").write_text(row("A", 40.0) + "\n" + row("B", 37.0))
    monkeypatch.setattr(figures, "FOLDER", tmp_path)
    monkeypatch.setitem(figures.FILES, "two", "of-two-targets")
    for queries in ("mean(two, psnr); mean(two, to38); reached(two, 38)", "line(two)"):
        text = f"At 36.0 dB it has 38 dB after 4.0 s (%d of 6). <!-- rows: {queries} given 38 -->"
        assert wrong(text % 1) == []
        assert len(wrong(text % 2)) == 2


def test_a_changed_digit_is_found():
    page = PAGES_WITH_FIGURES[0].read_text()
    changed = [
        *blocks(page.replace("**44.8 dB**", "**44.9 dB**").replace("12 reach 35 dB", "12 reach 36 dB"))
    ]
    assert sum(bool(wrong(block)) for block in changed) == 2
