"""What reports say of models whose answers are known, against figures worked out by hand."""

import csv
import io
import json
import math
import re

import numpy as np
import pytest
import torch

from lsmgeo.cameras import orbit, rays
from lsmgeo.errors import OptionError
from lsmgeo.evaluation import Method, Options, Training, evaluate, format_table, write_report
from lsmgeo.evaluation.baselines import DepthMaps, sweep_views
from tests.evaluation.fakes import SIZE, FakeDepths, FakeShapes, FakeVoxels, iou

# Three chairs and one lamp: a mean over shapes is not the mean of the categories.
WIDTHS, NAMES = (4, 4, 2, 8), ("chair", "chair", "chair", "lamp")


def by_count(images, _):
    return len(images)


def values(report, key, row):
    table = next(table for table in report.tables if table.key == key)
    return [cell.value for line in table.rows if line.name == row for cell in line.cells if cell is not None]


def errors(report, key, row):
    table = next(table for table in report.tables if table.key == key)
    return [cell.error for line in table.rows if line.name == row for cell in line.cells if cell is not None]


def mean_of(scores):
    """The mean of the categories of four numbers, in per cent."""
    return 100 * (np.mean(scores[:3]) + scores[3]) / 2


def slabs():
    return FakeShapes(WIDTHS, NAMES)


def test_iou_is_the_mean_of_the_categories_after_every_view():
    report = evaluate([Method("fake", FakeVoxels(by_count))], slabs(), "iou", Options(views=5))
    expected = [mean_of([iou(views, width) for width in WIDTHS]) for views in range(1, 6)]
    np.testing.assert_allclose(values(report, "views", "fake"), expected, rtol=1e-12)
    # (0.5 + 0.5 + 1) / 3 and 2 / 8 with two views.
    np.testing.assert_allclose(expected[1], 100 * (2 / 3 + 1 / 4) / 2, rtol=1e-12)
    columns = next(table for table in report.tables if table.key == "categories of fake")
    assert columns.columns == ["chair", "lamp", "mean"]
    np.testing.assert_allclose(values(report, "categories of fake", "views: 2"), [200 / 3, 25, expected[1]], rtol=1e-12)
    assert [shape["iou"]["fake"][1] for shape in report.shapes] == [0.5, 0.5, 1.0, 0.25]


def test_the_threshold_and_the_paper_s_figures():
    fake = Method("fake", FakeVoxels(by_count))
    high = evaluate([fake], slabs(), "iou", Options(views=2, threshold=0.42))
    assert values(high, "views", "fake") == [0.0, 0.0]
    assert values(high, "views", "paper, V-LSM") == [61.5, 72.1]
    low = evaluate([fake], slabs(), "iou", Options(views=2, threshold=0.38))
    np.testing.assert_allclose(values(low, "views", "fake"), [mean_of([w / 8 for w in WIDTHS])] * 2, rtol=1e-12)


def test_standard_errors_are_of_the_mean_of_the_categories():
    report = evaluate([Method("fake", FakeVoxels(by_count))], slabs(), "iou", Options(views=2))
    chairs = np.array([0.5, 0.5, 1.0])
    # The lamp is alone: it takes the chairs' variance.
    expected = 100 * math.sqrt(chairs.var(ddof=1) / 3 + chairs.var(ddof=1)) / 2
    np.testing.assert_allclose(errors(report, "views", "fake")[1], expected, rtol=1e-12)


def test_the_hull_of_full_silhouettes_is_all_that_is_seen():
    """Every silhouette is the whole picture, which holds the whole cube from two units away."""
    report = evaluate([Method("fake", FakeVoxels(by_count))], slabs(), "iou", Options(views=1))
    for name in ("visual hull", "visual hull, strict"):
        # The object's pixel that is missing in the corner hides no more than a few voxels of 512.
        np.testing.assert_allclose(values(report, "views", name), mean_of([w / 8 for w in WIDTHS]), rtol=0.1)


class HalfSilhouettes(FakeShapes):
    """View 1 shows the half y > 0 of the cube, from the axis z, view 2 the half z < 0, from x, and the others all."""

    def read(self, index, views, **options):
        sample = super().read(index, views, **options)
        mask = torch.ones(views, SIZE, SIZE, dtype=torch.bool)
        mask[0, SIZE // 2 :] = False
        mask[1:2, :, : SIZE // 2] = False
        azimuths = torch.tensor([90.0, 0.0, 180.0, 270.0, 90.0])[:views]
        # Every voxel's centre is in the pictures, and more than half a pixel off the edges of the silhouettes.
        cameras = orbit(azimuths, 0.0, 2.0, focal_length=1.5 * SIZE, height=SIZE, width=SIZE)
        return sample._replace(mask=mask, cameras=cameras)


def test_the_hull_after_a_view_is_of_the_views_so_far():
    """Slabs of 4 and of 2 planes, 256 and 128 of 512 voxels, against a half, a quarter and three quarters of them."""
    shapes = HalfSilhouettes((4, 2), ("chair", "lamp"))
    report = evaluate([Method("fake", FakeVoxels(by_count))], shapes, "iou", Options(views=5))
    scores = np.array(
        [[shape["iou"][name] for name in ("visual hull", "visual hull, strict")] for shape in report.shapes]
    )
    # After one view y > 0: half of either slab is among its 256 voxels.
    np.testing.assert_allclose(scores[..., 0].T, [[128 / 384, 64 / 320]] * 2, rtol=1e-12)
    # After two y > 0 and z < 0: 128 voxels, that is half of the thick slab, and half of the thin one is in them.
    np.testing.assert_allclose(scores[..., 1].T, [[128 / 256, 64 / 192]] * 2, rtol=1e-12)
    # After five, four views of five are enough for the paper's rule: y > 0 or z < 0, 384 voxels with both slabs.
    np.testing.assert_allclose(scores[..., 4].T, [[256 / 384, 128 / 384], [128 / 256, 64 / 192]], rtol=1e-12)
    for name, of_rule in zip(("visual hull", "visual hull, strict"), scores.mean(0), strict=True):
        np.testing.assert_allclose(values(report, "views", name), 100 * of_rule, rtol=1e-12)


@pytest.mark.parametrize("report", ["iou", "order", "pose-noise"])
def test_the_size_of_a_batch_changes_nothing(report):
    fake = Method("fake", FakeVoxels(lambda images, R: 1 + int(20 * float(images[0, 0, 5, 5])) % 4))
    first, second = (
        evaluate([fake], slabs(), report, Options(views=3, batch=batch, orders=3, degrees=(0, 5))) for batch in (1, 3)
    )
    for one, other in zip(first.tables, second.tables, strict=True):
        for row, same in zip(one.rows, other.rows, strict=True):
            assert row.name == same.name
            numbers = [[cell or (math.nan, math.nan) for cell in line.cells] for line in (row, same)]
            np.testing.assert_allclose(*numbers, rtol=1e-9, atol=1e-9)


def test_backgrounds_stand_behind_the_objects():
    fake = Method("fake", FakeVoxels(lambda images, R: 4 if float(images[0, 0, 0, 0]) == 1 else 2))
    report = evaluate([fake], slabs(), "backgrounds", Options(views=2))
    white, other = ([mean_of([iou(width, true) for true in WIDTHS])] * 2 for width in (4, 2))
    np.testing.assert_allclose(values(report, "views", "fake, white behind"), white, rtol=1e-12)
    np.testing.assert_allclose(values(report, "views", "fake, random behind"), other, rtol=1e-12)


def test_unseen_categories_cost_what_the_full_model_has_more():
    # Chairs are of the first part of the categories, cars of the second.
    shapes = FakeShapes((4, 4, 4), ("chair", "chair", "car"))
    models = [
        Method("all", FakeVoxels(lambda images, R: 4)),
        Method("first", FakeVoxels(lambda images, R: 1), Training("first")),  # does not know cars
        Method("second", FakeVoxels(lambda images, R: 3), Training("second")),  # does not know chairs
    ]
    report = evaluate(models, shapes, "unseen", Options(views=2))
    np.testing.assert_allclose(values(report, "drop", "V-LSM"), [50.0, 50.0], rtol=1e-12)  # of 25 and 75 points
    np.testing.assert_allclose(values(report, "drop", "first"), [75.0, 75.0], rtol=1e-12)
    np.testing.assert_allclose(values(report, "drop", "second"), [25.0, 25.0], rtol=1e-12)
    np.testing.assert_allclose(values(report, "categories", "V-LSM"), [75.0, 25.0, 50.0], rtol=1e-12)


def test_unseen_asks_for_a_model_trained_on_all():
    with pytest.raises(OptionError, match="of V-LSM there are: first \\(on first\\)"):
        evaluate([Method("first", FakeVoxels(by_count), Training("first"))], slabs(), "unseen")


def test_pose_noise_turns_each_camera_by_no_more_than_its_angle_about_one_axis():
    turns = {}

    def look(images, R):
        turns.setdefault(len(turns), R)
        return 4

    report = evaluate([Method("fake", FakeVoxels(look))], slabs(), "pose-noise", Options(degrees=(20, 0, 10), batch=4))
    assert next(table for table in report.tables).columns == ["0°", "10°", "20°"]
    rotations = torch.stack(list(turns.values())).unflatten(0, (3, 4)).double()  # angles, shapes, views
    turned = rotations[0].transpose(-1, -2) @ rotations[1:]
    angle = torch.rad2deg(torch.arccos(((turned.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1)))
    assert bool((angle[0] <= 10.001).all())
    assert float(angle[1].max()) > 10
    torch.testing.assert_close(angle[1], 2 * angle[0], rtol=1e-3, atol=1e-3)
    assert angle[0].flatten().unique().numel() == 16  # each camera has noise of its own


def test_order_measures_the_spread_over_orders():
    firsts = []

    def by_first(images, _):
        firsts.append(float(images[0, 0, 5, 5]))
        return 4 if firsts[-1] < 0.075 else 2  # the first view is 0.05 bright

    shapes = FakeShapes((4,), ("chair",))
    report = evaluate([Method("fake", FakeVoxels(by_first))], shapes, "order", Options(views=2, orders=6))
    scores = [1.0 if first < 0.075 else 0.5 for first in firsts]
    assert len(scores) == 6
    assert set(scores) == {0.5, 1.0}
    mean, deviation, reach, voxels, changing, of_the_set = values(report, "order of fake", "2 views")
    np.testing.assert_allclose(of_the_set, 50.0)  # of one shape
    np.testing.assert_allclose([mean, deviation, reach], [100 * np.mean(scores), 100 * np.std(scores, ddof=1), 50.0])
    # Of the 256 voxels that are ever occupied half go from 0.41 to 0.39.
    np.testing.assert_allclose(changing, 50.0)
    np.testing.assert_allclose(voxels, 0.5 * 100 * np.std([0.02 * (s == 1.0) for s in scores], ddof=1), rtol=1e-5)


def test_a_model_that_minds_no_order_has_no_spread():
    report = evaluate([Method("fake", FakeVoxels(by_count))], slabs(), "order", Options(views=4, orders=3))
    for row in ("2 views", "4 views"):
        assert values(report, "order of fake", row)[1:] == [0.0] * 5


def test_depth_counts_the_pixels_that_plane_sweep_has(monkeypatch):
    half = SIZE // 2
    swept = torch.full((3, SIZE, SIZE), 2.05)
    swept[:, :, half:] = 0.0
    sure = torch.zeros(3, SIZE, SIZE)
    sure[:, 4:6, :2] = 0.5
    monkeypatch.setattr("lsmgeo.evaluation.report_depth.sweep_views", lambda *given, **options: DepthMaps(swept, sure))
    off = torch.full((SIZE, SIZE), 0.03)
    off[0] = -0.03
    off[:, half:] = 0.5  # where plane sweep has nothing
    off[:, :2] = 0.04
    off[0, 0] = -7.0  # the background
    shapes = FakeShapes((4, 2), ("chair", "lamp"))
    report = evaluate([Method("fake", FakeDepths(2.0 + off))], shapes, "depth", Options(views=3))
    np.testing.assert_allclose(values(report, "categories", "fake"), [0.03] * 3, rtol=1e-5)
    np.testing.assert_allclose(values(report, "categories", "plane sweep"), [0.05] * 3, rtol=1e-5)
    left, all_pixels = (np.abs(maps.numpy()).ravel()[1:] for maps in (off[:, :half], off))
    pixels = SIZE * SIZE - 1
    expected = [np.median(left), left.mean(), 0.04, np.median(all_pixels), all_pixels.mean(), 100.0, 400 / pixels]
    np.testing.assert_allclose(values(report, "measures", "fake"), expected, rtol=1e-5)
    share = 100 * (half * SIZE - 1) / pixels
    np.testing.assert_allclose(values(report, "measures", "plane sweep"), [0.05] * 5 + [share, 400 / pixels], rtol=1e-5)
    assert values(report, "categories", "paper, D-LSM") == [0.023, 0.027, 0.024]


def test_plane_sweep_finds_a_plane():
    """A wall that faces the first camera, seen by three: its pattern is a function of the place on it."""
    cameras = orbit(torch.tensor([0.0, 6.0, -6.0]), 0.0, 2.0, focal_length=60.0, height=32, width=32)
    origins, directions = rays(cameras)
    reach = (0.2 - origins[:, None, None, 0]) / directions[..., 0]  # the wall is at x = 0.2
    place = origins[:, None, None] + reach[..., None] * directions
    grey = 0.5 + 0.25 * torch.sin(40 * place[..., 1]) + 0.25 * torch.sin(33 * place[..., 2] + 1)
    depth = sweep_views(grey[:, None].expand(-1, 3, -1, -1), cameras, planes=100, window=5).depth
    inner = depth[0, 6:-6, 6:-6]
    torch.testing.assert_close(inner, torch.full_like(inner, 1.8), atol=0.02, rtol=0)


@pytest.mark.parametrize(
    ("report", "model", "message"),
    [
        ("iou", FakeDepths(torch.ones(SIZE, SIZE)), "report 'iou' measures voxels; fake predicts depth"),
        ("depth", FakeVoxels(by_count), "report 'depth' measures depth; fake predicts voxels"),
        ("nonsense", FakeVoxels(by_count), "report must be one of 'iou'"),
    ],
)
def test_reports_refuse_what_they_are_not_about(report, model, message):
    with pytest.raises(OptionError, match=message):
        evaluate([Method("fake", model)], slabs(), report)


def test_models_of_different_resolutions_share_no_table():
    other = FakeVoxels(by_count)
    other.resolution = 16
    with pytest.raises(OptionError, match=re.escape("the same resolution of voxels; got {'one': 8, 'two': 16}")):
        evaluate([Method("one", FakeVoxels(by_count)), Method("two", other)], slabs(), "iou")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"views": 0}, "views"),
        ({"batch": 0}, "batch"),
        ({"orders": 1}, "orders"),
        ({"threshold": math.nan}, "threshold"),
        ({"degrees": (190.0,)}, "degrees"),
        ({"degrees": ()}, "degrees"),
    ],
)
def test_options_are_checked(options, message):
    with pytest.raises(OptionError, match=message):
        Options(**options)


def test_fewer_views_than_wanted_are_told():
    shapes = slabs()
    shapes.most_views = 3
    report = evaluate([Method("fake", FakeVoxels(by_count))], shapes, "iou")
    assert report.notes == ["the shapes have 3 views; 8 were wanted"]
    assert len(values(report, "views", "fake")) == 3


def test_a_report_is_written_whole(tmp_path):
    report = evaluate([Method("fake", FakeVoxels(by_count))], slabs(), "iou", Options(views=2))
    assert sorted(path.name for path in write_report(report, tmp_path / "new")) == ["iou.csv", "iou.json", "iou.png"]
    written = json.loads((tmp_path / "new" / "iou.json").read_text())
    assert written["facts"]["data"] == "slabs"
    row = next(row for row in written["tables"][0]["rows"] if row["name"] == "fake")
    np.testing.assert_allclose(row["values"], values(report, "views", "fake"), atol=1e-8)
    lines = list(csv.DictReader(io.StringIO((tmp_path / "new" / "iou.csv").read_text())))
    line = next(line for line in lines if line["row"] == "fake" and line["table"] == "views" and line["column"] == "2")
    np.testing.assert_allclose(float(line["value"]), values(report, "views", "fake")[1], rtol=1e-5)
    assert any(line["other_data"] == "1" and line["value"] == "61.5" for line in lines)


@pytest.mark.parametrize(("width", "falls"), [(1, True), (4, False)])
def test_the_hull_that_falls_has_a_footnote(width, falls):
    """After four views 128 voxels are left, after five 384: slabs of 64 voxels and of 256, half of them in the 128."""
    shapes = HalfSilhouettes((width,), ("chair",))
    report = evaluate([Method("fake", FakeVoxels(by_count))], shapes, "iou", Options(views=5))
    expected = [100 * 32 * width / (128 + 32 * width), 100 * 64 * width / 384]
    np.testing.assert_allclose(values(report, "views", "visual hull")[3:], expected, rtol=1e-12)
    assert report.tables[0].footnote.startswith("The 0.75 hull drops") == falls
    assert ("0.75 hull drops" in format_table(report.tables[0])) == falls
    four = evaluate([Method("fake", FakeVoxels(by_count))], shapes, "iou", Options(views=4))
    assert four.tables[0].footnote == ""


def test_enlarged_images_are_noted():
    large = FakeVoxels(by_count)
    large.image_size = 2 * SIZE
    report = evaluate([Method("large", large), Method("fake", FakeVoxels(by_count))], slabs(), "iou", Options(views=1))
    assert [note for note in report.notes if "enlarged" in note] == [
        f"images of {SIZE} pixels were enlarged to the {2 * SIZE} of large, which expects more detail"
    ]


def test_a_shape_without_voxels_counts_nowhere():
    shapes = FakeShapes((4, 0), ("chair", "lamp"))
    report = evaluate([Method("fake", FakeVoxels(by_count))], shapes, "iou", Options(views=1))
    np.testing.assert_allclose(values(report, "views", "fake"), [100 * iou(1, 4)])
    assert math.isnan(report.shapes[1]["iou"]["fake"][0])
