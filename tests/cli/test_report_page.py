"""The page of a reconstruction, in a real browser: it draws the model, says nothing, and asks nobody for anything."""

import re
from html.parser import HTMLParser

import numpy as np
import pytest
import torch

from lsmgeo.cameras import CameraTensors, select
from lsmgeo.data import Mesh
from lsmgeo.reconstruct.page import make_page
from lsmgeo.reconstruct.viewer import MOST_FACES, _thinned, make_viewer
from lsmgeo.reconstruct.write_results import Results, ViewResult
from tests.cli.browser import Browser

HOSTILE = "<script>document.title='taken'</script>\"'&{{ 7 * 7 }}.png"
READY = "document.getElementById('model').contentDocument?.body?.dataset.ready === 'yes'"
# Of the square that the first camera sees: left half, right half, and what is behind them.
LEFT, RIGHT, BACK = (200, 30, 30), (30, 160, 30), (30, 30, 200)


def cameras_around(count=4, distance=4.0):
    """Cameras on a ring, y down, looking at the origin; the first from -z."""
    poses = []
    for angle in np.linspace(0, np.pi, count):
        c, s = np.cos(angle), np.sin(angle)
        poses.append([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, distance], [0, 0, 0, 1]])
    K = torch.tensor([[180.0, 0, 79.5], [0, 180, 59.5], [0, 0, 1]], dtype=torch.float64)
    full = torch.full((count,), 120), torch.full((count,), 160)
    return CameraTensors(K.expand(count, 3, 3), torch.tensor(poses, dtype=torch.float64), *full)


def square():
    """Seen from -z, y down: left red, right green; and a smaller blue one behind, to be seen from +z."""
    vertices, faces, colours = [], [], []
    for x0, x1, z, colour in ((-1, 0, 0.0, LEFT), (0, 1, 0.0, RIGHT), (-1, 1, 0.2, BACK)):
        first = len(vertices)
        vertices += [(x0, -1, z), (x1, -1, z), (x1, 1, z), (x0, 1, z)]
        faces += [(first, first + 1, first + 2), (first, first + 2, first + 3)]
        colours += [colour] * 4
    return Mesh(np.array(vertices, np.float32), np.array(faces), colours=np.array(colours, np.uint8))


NOTHING = np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8)


def make_views(count, side=120):
    y, x = np.mgrid[:side, : side * 4 // 3]
    depth = np.where(np.hypot(x - 80, y - 60) < 50, 1.0 + x / 160, 0.0)
    image = np.stack([x % 256, y * 2 % 256, 0 * x + 90]) / 255
    maps = (torch.from_numpy(values).float() for values in (image, depth, y / side))
    image, depth, certain = maps
    numbers = (("kept", "40 %"),)
    cameras = cameras_around()
    return tuple(
        ViewResult(view, image, select(cameras, 0, 0), depth, certain, "confidence", numbers) for view in range(count)
    )


def results_of(views=(), points=NOTHING, mesh=None, used=(), words=()):
    return Results(words[0] if words else "page", (words,) if words else (), words[:1], views, *points, mesh, used)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    mesh = square()
    results = results_of(make_views(3), (np.array(mesh.vertices), mesh.colours), mesh, words=(HOSTILE, HOSTILE))
    path = tmp_path_factory.mktemp("page") / "report.html"
    names = [f"{view} {HOSTILE}" for view in range(4)]
    path.write_text(make_page(results, names, cameras_around()), "utf-8")
    return path


@pytest.fixture(scope="module")
def browser(page):
    with Browser() as opened:
        opened.open(page)
        opened.wait_for(READY)
        yield opened


def model_region(browser):
    """What is seen of the model's frame, above its buttons."""
    box = browser.evaluate(
        "(({ x, y, width, height }) => [x, y, width, height])(document.getElementById('model').getBoundingClientRect())"
    )
    x, y, width, height = (int(value) for value in box)
    return browser.screenshot()[y + 2 : y + height - 60, x + 2 : x + width - 2]


def middle(browser):
    """Of the model's frame."""
    script = "(({ x, y, width, height }) => [x + width / 2, y + height / 2])"
    return browser.evaluate(f"{script}(document.getElementById('model').getBoundingClientRect())")


def share(region, colour):
    return float((np.abs(region.astype(int) - colour) < 12).all(-1).mean())


def press(browser, name):
    script = "[...document.getElementById('model').contentDocument.querySelectorAll('button')]"
    browser.evaluate(f"{script}.find(button => button.textContent === '{name}').click()")


def test_the_model_is_seen_as_the_first_camera_sees_it(browser):
    press(browser, "start view")
    region = model_region(browser)
    width = region.shape[1]
    assert share(region, LEFT) > 0.05
    assert share(region, RIGHT) > 0.05
    assert share(region, BACK) == 0
    assert share(region[:, : width // 2], RIGHT) < 0.001
    assert share(region[:, width // 2 :], LEFT) < 0.001


def test_the_model_turns_with_the_mouse_and_back(browser):
    press(browser, "start view")
    before = model_region(browser)
    x, y = middle(browser)
    browser.drag((x, y), (x + 90, y))
    turned = model_region(browser)
    assert np.abs(turned.astype(int) - before).max(-1).mean() > 5
    assert 0.5 * share(before, LEFT) < share(turned, LEFT) + share(turned, BACK)
    press(browser, "start view")
    np.testing.assert_array_equal(model_region(browser), before)


def test_the_model_is_seen_from_a_view(browser):
    """The last camera stands behind, where the small square hides the others."""
    browser.evaluate("document.getElementById('model').contentWindow.lookAsView(3)")
    region = model_region(browser)
    assert share(region, BACK) > 0.05
    assert share(region, LEFT) == share(region, RIGHT) == 0
    press(browser, "start view")
    browser.evaluate("document.querySelector('button[data-view=\"2\"]').click()")
    assert share(model_region(browser), BACK) > 0.005


def test_text_from_outside_stays_text(browser):
    assert browser.evaluate("document.title") == HOSTILE
    assert browser.evaluate("document.querySelector('h1').textContent") == HOSTILE
    assert browser.evaluate("document.querySelector('h3').textContent") == f"0: 0 {HOSTILE}"
    assert browser.evaluate("[...document.images].length") == 9


def check_quiet(browser):
    """No word in the console, nothing asked of any other place."""
    assert browser.console == []
    assert all(url.startswith(("file:", "data:")) for url in browser.requests)
    assert sum(url.startswith("file:") for url in browser.requests) == 1


def test_the_pictures_are_drawn_and_nothing_is_said_or_asked(browser):
    """After those that share the page: what they did counts too."""
    browser.evaluate("for (const picture of document.images) picture.loading = 'eager'")
    browser.wait_for("[...document.images].every(picture => picture.complete && picture.naturalWidth === 160)")
    depth = browser.evaluate(
        """(() => {
            const picture = document.images[1], canvas = document.createElement("canvas");
            canvas.width = picture.naturalWidth; canvas.height = picture.naturalHeight;
            const drawing = canvas.getContext("2d", { willReadFrequently: true });
            drawing.drawImage(picture, 0, 0);
            return [[35, 60], [115, 60], [2, 2]].map(([x, y]) => [...drawing.getImageData(x, y, 1, 1).data]);
        })()"""
    )
    near, far, nothing = depth
    assert near[0] > 2 * near[2]
    assert far[2] > 2 * far[0]
    assert nothing[3] == 0
    check_quiet(browser)


def test_a_narrow_page_has_all_in_its_width_and_turns_by_touch(page, browser):
    """After the tests that see a wide one: the page is opened once more."""
    browser.resize(400, 800)
    browser.open(page)
    browser.wait_for(READY)
    assert browser.evaluate("document.documentElement.scrollWidth") <= 400
    before = model_region(browser)
    assert share(before, LEFT) > 0.05
    x, y = middle(browser)
    browser.swipe((x, y), (x + 60, y))
    assert np.abs(model_region(browser).astype(int) - before).max(-1).mean() > 5
    check_quiet(browser)


class Loads(HTMLParser):
    """What a page would load."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attributes):
        self.found += [value for name, value in attributes if name in ("src", "href", "srcset", "data", "action")]


def test_nothing_in_the_page_names_another_place(page):
    text = page.read_text("utf-8")
    parser = Loads()
    parser.feed(text)
    assert len(parser.found) == 10
    assert all(value.startswith("data:") for value in parser.found)
    assert "default-src 'none'" in text
    assert not re.search(r"\b(import|importScripts)\s*\(\s*[\"']http|url\(\s*[\"']?http|<link[^>]+http", text)


def test_fifty_views_make_a_page_of_limited_size():
    generator = torch.Generator().manual_seed(0)
    noise = [torch.rand(shape, generator=generator) for shape in ((3, 600, 800), (600, 800), (600, 800))]
    camera = select(cameras_around(), 0, 0)
    views = tuple(ViewResult(view, noise[0], camera, *noise[1:], "confidence", ()) for view in range(50))
    text = make_page(results_of(views), [str(view) for view in range(50)], cameras_around(50))
    assert len(text) < 20e6
    assert text.count("<section") == 50


def test_a_page_without_a_model_has_no_frame_for_one():
    assert "<iframe" not in make_page(results_of(make_views(1)), ["nothing"], cameras_around(1))


def test_surfaces_of_many_faces_are_thinned():
    """A wavy square of half a million faces: fewer, at the same place, in the same colours."""
    side = 520
    y, x = np.mgrid[:side, :side] / (side - 1.0)
    vertices = np.stack([x, y, 0.1 * np.sin(6 * x)], -1).reshape(-1, 3)
    index = np.arange(side * side).reshape(side, side)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, 1:].ravel(), index[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    colours = np.full((len(vertices), 3), (10, 20, 30), np.uint8)
    thin = _thinned(Mesh(vertices, faces, colours=colours))
    assert MOST_FACES / 4 < len(thin.faces) <= MOST_FACES
    assert (thin.colours == (10, 20, 30)).all()
    np.testing.assert_allclose(thin.vertices[:, 2], 0.1 * np.sin(6 * thin.vertices[:, 0]), atol=2e-3)
    corners = thin.vertices[thin.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    expected = np.hypot(1, 0.6 * np.cos(6 * np.linspace(0, 1, 100_001))).mean()
    np.testing.assert_allclose(area, expected, rtol=0.01)


def test_points_alone_make_a_model():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(100, 3)), rng.integers(0, 256, (100, 3)).astype(np.uint8)
    assert "$B64GLTF" not in make_viewer(results_of(make_views(1), points), cameras_around())
