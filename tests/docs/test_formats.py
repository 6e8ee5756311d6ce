"""The pages of file formats name what exists, show code that compiles, and leave no format out."""

import ast
import re
from pathlib import Path

import pytest

from lsmgeo import data

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGES = sorted((DOCS / "formats").glob("*.rst"))
CAMERAS = ast.parse((DOCS / "figures" / "format_cameras.py").read_text(encoding="utf-8"))


def blocks(page: Path) -> list[str]:
    found = re.findall(r"\.\. code-block:: python\n\n((?:   .*\n|\n)+)", page.read_text(encoding="utf-8"))
    return [re.sub(r"(?m)^   ", "", block) for block in found]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_what_a_page_names_exists(page):
    code = blocks(page)
    assert code
    for block in code:
        ast.parse(block)
    named = re.findall(r"\bdata\.(\w+)", page.read_text(encoding="utf-8"))
    assert named
    assert set(named) <= {*data.__all__, "open"}


def test_every_format_and_its_reader_stand_in_the_table():
    text = (DOCS / "formats" / "index.rst").read_text(encoding="utf-8")
    readers = {found.read.__name__ for found in data.FORMATS}
    assert readers <= set(re.findall(r"`data\.(\w+)`", text))
    writers = {name for name in data.__all__ if re.fullmatch(r"write_(colmap|transforms|cameras_json)", name)}
    assert writers <= set(re.findall(r"`data\.(\w+)`", text))


def test_every_page_is_linked_and_draws_its_convention():
    text = (DOCS / "formats" / "index.rst").read_text(encoding="utf-8")
    functions = {node.name for node in CAMERAS.body if isinstance(node, ast.FunctionDef)}
    drawn = set()
    for page in PAGES:
        if page.stem == "index":
            continue
        assert re.search(rf":doc:`{page.stem}`", text), page
        plots = re.findall(r"\.\. plot:: figures/(\S+)(?: (\w+))?\n   :alt: .+", page.read_text(encoding="utf-8"))
        assert plots, page
        for script, function in plots:
            assert (DOCS / "figures" / script).is_file(), script
            if script == "format_cameras.py":
                drawn.add(function)
    assert drawn == functions
