"""What README.md shows runs, and gives the shapes that its comments promise."""

import re
from pathlib import Path

import torch

README = Path(__file__).resolve().parents[2] / "README.md"


def python_blocks() -> list[str]:
    return re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), flags=re.DOTALL)


def test_the_code_runs_and_its_shapes_are_as_said():
    (block,) = python_blocks()
    torch.manual_seed(0)
    names: dict = {}
    exec(compile(block, str(README), "exec"), names)

    assert names["volume"].shape == (1, 8, 32, 32, 32)
    assert names["maps"].shape == (1, 3, 8 * 64, 56, 56)
    assert names["visible"].shape == (1, 3, 64, 56, 56)
    assert names["visible"].dtype == torch.bool
    # The grid's centre is in front of every camera: the means of features in [0, 1) are there, and not zero.
    assert 0 < names["volume"][0, :, 16, 16, 16].min() < names["volume"].max() < 1


def test_the_example_is_short():
    (block,) = python_blocks()
    statements = [line for line in block.splitlines() if line.strip() and not line.startswith(("import", "from"))]
    assert len(statements) <= 8


def test_links_lead_to_files():
    links = re.findall(r"\]\((?!https?:)([^)#]+)\)", README.read_text(encoding="utf-8"))
    assert links
    for link in links:
        assert (README.parent / link).exists(), link
