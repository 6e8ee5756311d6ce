"""Each correction on the troubleshooting page fixes its error."""

import ast
import re
from pathlib import Path

import pytest
import torch

from lsmgeo import cameras
from tests.diagnosis.textured import erroneous

PAGE = Path(__file__).resolve().parents[2] / "docs" / "troubleshooting.rst"
HEIGHT, WIDTH = 48, 64


def corrections() -> dict[str, str]:
    """The code under each heading of the third rank."""
    sections = re.split(r"\n([^\n]+)\n~{3,}\n", PAGE.read_text(encoding="utf-8"))
    found = {}
    for title, text in zip(sections[1::2], sections[2::2], strict=True):
        text = re.split(r"\n[^\n]+\n-{3,}\n", text)[0]
        block = re.search(r"\.\. code-block:: python\n\n((?:   .*\n|\n)+)", text)
        if block:
            found[title] = re.sub(r"(?m)^   ", "", block[1])
    return found


def right_cameras() -> cameras.CameraTensors:
    azimuths = torch.tensor([10.0, 75.0, -40.0], dtype=torch.float64)
    views = cameras.orbit(azimuths, 25.0, 2.0, focal_length=70.0, height=HEIGHT, width=WIDTH)
    views = cameras.perturb(cameras.to(views, torch.float64), 5.0, generator=torch.Generator().manual_seed(0))
    shift = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, -2.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    return views._replace(intrinsics=views.intrinsics + shift)


def planted(name: str, views: cameras.CameraTensors) -> cameras.CameraTensors:
    """The error; with the number or order of the page, if the page has one."""
    K, E = views.intrinsics, views.cam_from_world
    if name == "frames shuffled":
        K, E = K[[2, 0, 1]], E[[2, 0, 1]]
    elif name == "focal length off":
        K = K * torch.tensor([[2.0, 2.0, 1.0], [2.0, 2.0, 1.0], [1.0, 1.0, 1.0]]).to(K)
    elif name == "other camera axes":  # forward, left, up
        E = torch.tensor([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]).to(E) @ E
    else:
        K, E = map(torch.from_numpy, erroneous(K.numpy(), E.numpy(), name))
    return views._replace(intrinsics=K, cam_from_world=E)


OF_CAMERAS = (
    "poses inverted",
    "OpenGL axes",
    "y flipped",
    "half a pixel",
    "K of another resolution",
    "frames shuffled",
    "rotation transposed",
    "centre taken as translation",
    "focal length off",
    "translation negated",
    "other camera axes",
)


def literals() -> set[str]:
    """All string literals in the code that reports errors."""
    files = (PAGE.parents[1] / "lsmgeo" / "diagnosis").glob("*.py")
    trees = [ast.parse(file.read_text(encoding="utf-8")) for file in files]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    return {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}


def test_the_page_has_the_names_that_are_reported():
    text = PAGE.read_text(encoding="utf-8")
    titles = set(re.findall(r"\n([^\n]+)\n~{3,}\n", text)) - {"Calibrations and voxels"}
    assert set(OF_CAMERAS) < titles
    assert titles <= literals()
    assert set(re.findall(r'"([^"]+)" (?:says|is the other)', text)) <= literals()


@pytest.mark.parametrize("name", OF_CAMERAS)
def test_the_correction_fixes_the_error(name):
    expected = right_cameras()
    names = {
        "torch": torch,
        "cameras": cameras,
        "views": planted(name, expected),
        "height": HEIGHT,
        "width": WIDTH,
        "names_of_cameras": ["c", "a", "b"],
        "names_of_photos": ["a", "b", "c"],
    }
    assert not torch.equal(names["views"].cam_from_world, expected.cam_from_world) or not torch.equal(
        names["views"].intrinsics, expected.intrinsics
    )
    exec(compile(corrections()[name], f"{PAGE}: {name}", "exec"), names)
    for found, right in zip(names["views"], expected, strict=True):
        torch.testing.assert_close(torch.as_tensor(found), torch.as_tensor(right).expand(torch.as_tensor(found).shape))


def test_distance_along_the_ray_becomes_depth():
    views = right_cameras()
    rows, columns = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    pixels = torch.stack((columns, rows, torch.ones_like(rows)), -1).double()
    rays = torch.linalg.solve(views.intrinsics[:, None, None], pixels[..., None])[..., 0]  # z is 1
    expected = torch.full((3, HEIGHT, WIDTH), 1.7, dtype=torch.float64)
    names = {"cameras": cameras, "views": views, "depth": expected * rays.norm(dim=-1)}
    exec(compile(corrections()["depth along the ray"], str(PAGE), "exec"), names)
    torch.testing.assert_close(names["depth"], expected)
