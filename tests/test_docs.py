"""Documentation: pages that are cited and code that is named exist, and every image is listed with its command."""

from __future__ import annotations

import ast
import re
import runpy
from functools import cache
from pathlib import Path

import pytest

import egs_warp
from egs_warp.assets import BUILT_IN_SCENES, scene
from egs_warp.io import read_capture
from egs_warp.motions.keyframes import read_keyframes

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
TEXTS = sorted(
    [path for room in ("egs_warp", "tests", "benchmarks", "examples", "docs") for path in (ROOT / room).rglob("*.py")]
    + [ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "THIRD_PARTY.md", "mkdocs.yml")]
    + [path for path in DOCS.rglob("*.md") if path.parent.name != "vendor"]
)
CITED = re.compile(r"\bdocs/[\w/]+\.md\b")
SHOWN = re.compile(r'(?:\(|src="|poster=")((?:\.\./)?assets/[\w.]+)(?![\w./])')


SCRIPT = runpy.run_path(str(DOCS / "make_pictures.py"))
PICTURES = {picture.name: picture for picture in SCRIPT["PICTURES"]}


def test_cited_pages_exist() -> None:
    cited = {(str(path.relative_to(ROOT)), page) for path in TEXTS for page in CITED.findall(path.read_text())}
    assert len(cited) > 40
    assert not [pair for pair in sorted(cited) if not (ROOT / pair[1]).is_file() and "NAME" not in pair[1]]


def test_no_missing_page_is_cited() -> None:
    """No text refers to a design document, because docs/concepts describes the design."""
    elsewhere = re.compile(r"\bDESIGN\b(?! of the first days)")
    assert not [str(path) for path in TEXTS if elsewhere.search(path.read_text())]


def test_images_are_small_and_made_by_the_script() -> None:
    made = [path for path in (DOCS / "assets").iterdir() if path.suffix in (".webp", ".mp4")]
    assert {path.name for path in made} == set(PICTURES)
    assert (DOCS / "assets" / "hop.mp4").stat().st_size <= 1e6
    assert sum(path.stat().st_size for path in (DOCS / "assets").iterdir()) <= 4e6


def test_the_site_has_the_accent_colours_of_the_pages() -> None:
    controls = (ROOT / "egs_warp" / "web" / "client" / "src" / "controls.css").read_text()
    dark, light = re.findall(r"--accent: var\(--egs-accent, (#\w+)\)", controls)
    site = (DOCS / "assets" / "site.css").read_text()
    assert re.findall(r"--md-accent-fg-color: (#\w+)", site) == [light, dark]


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=lambda page: str(page.relative_to(DOCS)))
def test_every_picture_has_its_command_on_its_page(page: Path) -> None:
    text = page.read_text()
    for shown in SHOWN.findall(text):
        picture = PICTURES[Path(shown).name]
        assert picture.command in text, f"{page.name} shows {picture.name}, not how it is made: {picture.command}"


def test_the_gallery_opens_the_pages_that_the_script_makes_and_has_no_dead_link() -> None:
    text = (DOCS / "index.md").read_text()
    linked = set(re.findall(r"assets/pages/(\w+)\.html", text))
    assert linked == {page.run for page in SCRIPT["PAGES"]}
    assert all(page.command in text for page in SCRIPT["PAGES"])
    hook = runpy.run_path(str(DOCS / "page_links.py"))["on_page_markdown"]

    class Files:
        """Substitute for the files of a site, of which only one page exists."""

        def get_file_from_path(self, path: str) -> str | None:
            return path if path == "assets/pages/jump.html" else None

    shown = hook(text, files=Files())
    assert re.findall(r"assets/pages/(\w+)\.html", shown) == ["jump"]
    assert len(shown.splitlines()) == len(text.splitlines()) - len(linked) + 1


def test_every_page_of_concepts_names_its_code() -> None:
    for page in (DOCS / "concepts").glob("*.md"):
        for room in re.findall(r"`(egs_warp/[\w/]+?)/?`", page.read_text()):
            assert (ROOT / room).exists() or (ROOT / f"{room}.py").exists(), f"{page.name}: no {room}"


def test_stages_of_a_step_are_in_the_files_that_the_architecture_names() -> None:
    tables = re.findall(r"^\| stage \|.*\n\|[-|]+\n((?:\|.*\n)+)", (DOCS / "architecture.md").read_text(), re.MULTILINE)
    cells = [cell for table in tables for row in table.splitlines() for cell in row.strip("|").split("|")[1:]]
    assert len(tables) == 4 and len(cells) > 50
    for cell in cells:
        folder = ROOT / "egs_warp"
        for name in re.findall(r"`(\S+)`", cell):
            if not name.endswith(".py"):
                owner, _, method = name.partition(".")
                texts = [path.read_text() for path in (ROOT / "egs_warp" / "locomotion").glob("*.py")]
                assert any(f"class {owner}" in text and f"def {method}(" in text for text in texts), name
                continue
            folder = ROOT / "egs_warp" / Path(name).parent if "/" in name else folder
            assert (folder / Path(name).name).is_file(), f"{name} in {cell}"


def test_python_files_that_a_page_names_exist() -> None:
    """Placeholders in the names of files are in capitals."""
    folders = ("egs_warp", "tests", "benchmarks", "examples", "docs", ".ci")
    files = [f"/{path.relative_to(ROOT)}" for folder in folders for path in (ROOT / folder).rglob("*.py")]
    pages = [path for path in DOCS.rglob("*.md") if path.parent.name not in ("vendor", "notebook")]
    named = {
        (page.name, name)
        for page in [*pages, ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
        for name in re.findall(r"`([\w./-]+\.py)\b", page.read_text())
    }
    assert len(named) > 200
    missing = [(page, name) for page, name in named if not any(file.endswith(f"/{name}") for file in files)]
    assert not [pair for pair in sorted(missing) if not re.search(r"\b(PACKAGE|NAME|test_NAME|X)\b", pair[1])]


@pytest.mark.example
def test_pages_start_from_captures_and_keys_that_can_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made_once = cache(scene)
    monkeypatch.setattr(egs_warp, "scene", made_once)
    runpy.run_path(str(ROOT / "examples" / "captures.py"))["main"](["--out", str(tmp_path)])
    for name in BUILT_IN_SCENES:
        made = made_once(name)
        assert read_capture(tmp_path / f"{name}.ply").cloud.count == made.object.count
        assert read_capture(tmp_path / f"{name}_in_room.ply").cloud.count == made.whole()[0].count
    assert {key.part for key in read_keyframes(ROOT / "examples" / "bow.csv")} == {"head"}


def test_every_package_docstring_names_input_output_and_the_part_of_the_paper() -> None:
    packages = sorted((ROOT / "egs_warp").glob("*/__init__.py"))
    assert len(packages) > 15
    for package in packages:
        text = ast.get_docstring(ast.parse(package.read_text())) or ""
        assert re.search(r"\bIn(put)?: ", text) and re.search(r"\bOut(put)?: ", text), package.parent.name
        assert re.search(r"sections? \d|Eq\. \d|paper", text), package.parent.name
        assert len(text.splitlines()) <= 4, package.parent.name
