"""The shapes of Synthetic-13: varied, upright, connected, without coincident faces."""

import hashlib
import importlib

import numpy as np
import pytest
import torch
from scipy.ndimage import label

from lsmgeo import scenes
from lsmgeo.cameras import CameraTensors
from lsmgeo.data.shards import shape_sources
from lsmgeo.errors import OptionError, ShapeError
from lsmgeo.scenes import synthetic13
from lsmgeo.scenes.synthetic13.parameters import Parameters, random_palette

CATEGORIES = tuple(synthetic13.CATEGORIES)


@pytest.fixture(scope="module")
def shapes():
    return [synthetic13.shape(3, index) for index in range(20 * 13)]


def materials(shape):
    return [solid.material for solid in shape.scene.solids]


def linear_parts(shape):
    return np.stack([solid.world_from_local[:, :3] for solid in shape.scene.solids])


@pytest.mark.parametrize("category", CATEGORIES)
def test_a_category_is_varied(category):
    found = synthetic13.measure(category, count=24)
    assert found.structures >= 6
    assert found.fewest >= 8
    assert 0 < found.iou <= 0.6


def test_the_variety_is_measured():
    found = synthetic13.measure("sofa", count=5, size=16)
    made = [synthetic13.shape(0, index, "sofa") for index in range(5)]
    centers = (np.arange(16) + 0.5) / 16 - 0.5
    points = torch.from_numpy(np.stack(np.meshgrid(centers, centers, centers, indexing="ij")[::-1], -1))
    volumes = [scenes.occupancy([item.scene], points[None])[0].numpy() for item in made]
    ratios = [
        (volumes[i] & volumes[j]).sum() / (volumes[i] | volumes[j]).sum() for i in range(5) for j in range(i + 1, 5)
    ]
    np.testing.assert_allclose(found.iou, np.mean(ratios), rtol=1e-5)
    np.testing.assert_allclose(found.fill, np.mean(volumes), rtol=1e-5)
    assert found.structures == len({item.structure for item in made})
    assert found.parts == np.mean([len(item.scene.solids) for item in made])


def test_the_box_without_cuts_is_centred_with_a_diagonal_of_one(shapes):
    for shape in shapes:
        low, high = shape.scene.bounds()
        np.testing.assert_allclose(low, -high, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(high - low), 1.0, rtol=1e-12)


def test_no_part_is_thinner_than_a_fortieth(shapes):
    least = min(2 * np.linalg.svd(linear_parts(shape), compute_uv=False).min() for shape in shapes)
    assert least >= 1 / 40


def test_shapes_are_cheap_to_render(shapes):
    counts = [len(shape.scene.solids) for shape in shapes]
    assert 8 <= np.mean(counts) <= 25
    assert max(counts) <= 40
    assert max(len(solid.cuts) for shape in shapes for solid in shape.scene.solids) <= 3


def test_a_shape_is_one_body():
    bodies, shares = [], []
    for index in range(4 * 13):
        volume = scenes.voxels([synthetic13.shape(1, index).scene], 64)[0].numpy()
        pieces, count = label(volume, np.ones((3, 3, 3)))
        bodies.append(count)
        shares.append(np.bincount(pieces.ravel())[1:].max() / volume.sum())
    assert np.mean(np.array(bodies) == 1) >= 0.96
    assert min(shares) > 0.95


def mean_x_of_the_top(shape):
    """The mean x of the highest quarter of the object."""
    volume = scenes.voxels([shape.scene], 32)[0].numpy()  # (z, y, x)
    _, y, x = np.nonzero(volume)
    return (x[y >= y.max() - (y.max() - y.min()) / 4].mean() + 0.5) / 32 - 0.5


def one_above_another(material):
    """Parts of different sizes, all with a face at y = 1 above (0, 0) except for growth by their index."""
    down, sizes = ((0, 1, 0), (0, -1, 0)), (2.0, 1.0, 2 / 3, 1 / 2)  # size times index is the same for three of them
    parts = [scenes.box((0, 1 - size / 2, 0), (size, size, size), material) for size in sizes]
    parts += [scenes.cylinder((0, 0, 0), (0, 1, 0), radius, material) for radius in (0.4, 0.7)]
    parts += [parts[0].moved((0.1, 0.6, 0)).minus(scenes.half_space(*down)) for _ in range(2)]
    basins = [scenes.cylinder((0, 1, 0), (0, 3, 0), radius) for radius in (0.5, 0.2)]
    parts += [scenes.box((0, 1, 0), (2, 2, 2), material).minus(basin) for basin in basins]
    return [*parts, scenes.cone((0, 0, 0), (0, 1, 0), 0.5, 0.3, material)]


def heights(solids, at=(0.0, 0.0)):
    """The height at which each single solid is hit from above, -infinity without a hit."""
    origin = torch.tensor([at[0], 2.0, at[1]], dtype=torch.float64)
    down = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    alone = [scenes.Scene([solid]) for solid in solids]
    hits = scenes.trace(alone, origin.expand(len(alone), 1, 3), down.expand(len(alone), 1, 3))
    return 2 - hits.distance[:, 0].numpy()


def test_coincident_faces_are_separated(monkeypatch):
    paint = scenes.Material()
    made = one_above_another(paint)
    np.testing.assert_allclose(heights(made), 1, atol=1e-12)
    monkeypatch.setattr("lsmgeo.scenes.synthetic13.lamp.build", lambda parameters, colours: made)
    solids = synthetic13.shape(0, 0, "lamp").scene.solids
    basins = [bool(solid.cuts) and solid.cuts[0].kind is scenes.Kind.CYLINDER for solid in solids]
    assert sum(basins) == 2
    # The faces of a cut grow with those of its solid: the floor of a basin sinks.
    for some, sign in ((np.flatnonzero(np.invert(basins)), 1), (np.flatnonzero(basins), -1)):
        steps = sign * np.diff(heights([solids[place] for place in some])) / np.diff(some)
        np.testing.assert_allclose(steps, steps[0], rtol=1e-6)
        assert 5e-6 < steps[0] < 5e-5


def test_a_flush_hole_stays_open(monkeypatch):
    hole = scenes.cylinder((0, -1, 0), (0, 1, 0), 0.5)
    made = [scenes.box((0, 0, 0), (2, 2, 2)).minus(hole) for _ in range(40)]
    monkeypatch.setattr("lsmgeo.scenes.synthetic13.lamp.build", lambda parameters, colours: made)
    shape = synthetic13.shape(0, 0, "lamp")
    assert np.isneginf(heights(shape.scene.solids)).all()
    assert np.isfinite(heights(shape.scene.solids, (0.2, 0.2))).all()


def parts_seen(shape, views, dtype):
    """The index of the part in each pixel, -1 for none, and the depth."""
    count = len(shape.scene.solids)
    marked = [
        solid.painted(scenes.Material(((place + 1) / count, 0, 0))) for place, solid in enumerate(shape.scene.solids)
    ]
    plain = scenes.Lights(torch.zeros(0, 3), torch.zeros(0, 3), torch.ones(3))
    picture = scenes.render([scenes.Scene(marked)], views, plain, background=(0, 0, 0), dtype=dtype)
    return (picture.images[0, :, 0] * count).round().long() - 1, picture.depth[0]


def test_colours_do_not_depend_on_rounding():
    """Of parts with different colours at one depth, float32 renders the same one as float64."""
    for index in range(13 * 10):
        shape = synthetic13.shape(0, 80 + index)
        views = synthetic13.views(0, 80 + index, 2, 112)
        views = CameraTensors(*(torch.as_tensor(value)[None] for value in views))
        (single, depth), (double, exact) = (parts_seen(shape, views, dtype) for dtype in (torch.float32, torch.float64))
        colours = {material: number for number, material in enumerate(dict.fromkeys(materials(shape)))}
        colour = torch.tensor([colours[material] for material in materials(shape)] + [-1])
        # At silhouettes rounding may decide, but then depths differ.
        flipped = (colour[single] != colour[double]) & ((depth - exact).abs() < 1e-3)
        seen = double >= 0
        assert flipped[seen].sum() <= 1e-3 * seen.sum(), shape.name


def test_objects_are_upright_and_face_x():
    """The back of a chair or a sofa and the tail of an airplane are high and at the rear."""
    chairs = [synthetic13.shape(2, index, "chair") for index in range(12)]
    sofas = [synthetic13.shape(2, index, "sofa") for index in range(24)]
    planes = [synthetic13.shape(2, index, "airplane") for index in range(24)]
    looked_at = [shape for shape in chairs if "back=none" not in shape.structure]
    looked_at += [shape for shape in sofas if "plan=straight" in shape.structure and "arms=none" in shape.structure]
    looked_at += [shape for shape in planes if "tail=T" in shape.structure and "kind=airliner" in shape.structure]
    assert len(looked_at) > 10
    for shape in looked_at:
        assert mean_x_of_the_top(shape) < -0.05, shape.name


def test_cars_stand_on_their_wheels():
    for index in range(6):
        shape = synthetic13.shape(2, index, "car")
        low, _ = shape.scene.bounds()
        dark = min(shape.scene.solids, key=lambda solid: solid.bounds()[0][1])
        assert dark.kind is scenes.Kind.CYLINDER
        # A wheel is round about z, and wheels are on both sides.
        lower, upper = dark.bounds()
        np.testing.assert_allclose(upper[0] - lower[0], upper[1] - lower[1], rtol=1e-9)
        assert low[1] == pytest.approx(lower[1])


def test_most_parts_have_one_colour_of_few(shapes):
    plain = [material.texture == "plain" for shape in shapes for material in materials(shape)]
    assert 0.8 <= np.mean(plain) < 1
    assert all(len(set(materials(shape))) <= 4 for shape in shapes)
    assert len({material.texture for shape in shapes for material in materials(shape)}) == 4


def test_categories_are_cycled(shapes):
    assert [shape.category for shape in shapes[:26]] == [*CATEGORIES, *CATEGORIES]
    assert len({shape.name for shape in shapes}) == len(shapes)
    assert shapes[17].name == "chair-00000017"


def test_the_synsets_and_the_two_halves():
    assert synthetic13.CATEGORIES["airplane"] == "02691156"
    assert synthetic13.CATEGORIES["vessel"] == "04530566"
    assert len(set(synthetic13.CATEGORIES.values())) == 13
    halves = synthetic13.CLASS_SPLITS["first"] + synthetic13.CLASS_SPLITS["second"]
    assert sorted(halves) == sorted(CATEGORIES)


def test_a_shape_depends_only_on_its_numbers(shapes):
    np.random.seed(1)  # noqa: NPY002  global state must not matter
    torch.manual_seed(1)
    for index in (200, 3, 57):
        again, before = synthetic13.shape(3, index), shapes[index]
        assert (again.structure, again.parameters, again.counts) == (
            before.structure,
            before.parameters,
            before.counts,
        )
        np.testing.assert_array_equal(linear_parts(again), linear_parts(before))
        assert materials(again) == materials(before)
        for one, other in zip(again.lights, before.lights, strict=True):
            torch.testing.assert_close(one, other, rtol=0, atol=0)
    assert synthetic13.shape(4, 3).parameters != shapes[3].parameters
    assert synthetic13.shape(3, 16).parameters != shapes[3].parameters


def test_the_numbers_are_those_of_the_seeded_stream():
    """The first draws of a chair, with numpy only: a set can be reproduced."""
    stream = np.random.Generator(np.random.PCG64(np.random.SeedSequence([5, 4, 0])))
    chair = synthetic13.shape(5, 4)
    picks = [int(stream.integers(7)), int(stream.integers(7))]
    bases = ("four legs", "four legs", "splayed legs", "pedestal", "star", "sled", "side panels")
    backs = ("solid", "vertical slats", "horizontal slats", "round", "solid", "frame", "none")
    assert chair.structure[:2] == (f"base={bases[picks[0]]}", f"back={backs[picks[1]]}")
    seats = 3 if backs[picks[1]] != "none" else 2
    stream.integers(seats)
    if backs[picks[1]] != "none":
        stream.integers(3)
    assert chair.parameters["seat_height"] == pytest.approx(0.3 + 0.45 * stream.random(), rel=1e-12)


DIGESTS_OF_VERSION = 1
DIGESTS = {
    "airplane": "c3477cf5edae",
    "bench": "e5d66bbd32c9",
    "cabinet": "2eca2384937a",
    "car": "83218fc2d871",
    "chair": "225289afe722",
    "display": "ab93372069d9",
    "lamp": "f032567e3221",
    "speaker": "acbd7624655b",
    "rifle": "30b714e7621c",
    "sofa": "9da3e2c4d9ef",
    "table": "401130ce67bf",
    "telephone": "d14d112fec96",
    "vessel": "a0b90e2566c2",
}


def digest(category):
    """Numbers of two shapes and their views to 1e-9: LAPACK rounds differently elsewhere."""
    found = hashlib.sha256()
    for index in (0, 1):
        shape = synthetic13.shape(0, index, category)
        views = synthetic13.views(0, index, 2, 64)
        numbers = [*shape.parameters.values(), *shape.counts.values()]
        words = [shape.name, *shape.structure, *shape.parameters, *shape.counts, synthetic13.split(0, index)]
        for solid in shape.scene.solids:
            for part in (solid, *solid.cuts):
                numbers += [*part.world_from_local.ravel(), part.taper]
                words.append(part.kind.name)
            look = solid.material
            numbers += [*look.colour, *look.second, look.frequency, look.seed]
            words.append(look.texture)
        for tensor in (*shape.lights, views.intrinsics, views.cam_from_world):
            numbers += tensor.flatten().tolist()
        found.update("|".join(words).encode())
        found.update(np.rint(np.array(numbers) * 1e9).astype("<i8").tobytes())
    return found.hexdigest()[:12]


def test_shapes_of_a_seed_are_those_of_this_version():
    digests = {category: digest(category) for category in CATEGORIES}
    assert (shape_sources.VERSION, digests) == (DIGESTS_OF_VERSION, DIGESTS), (
        "What a seed gives has changed, so training sets change: raise shape_sources.VERSION, and put the new version "
        "and the new digests here."
    )


def test_views_look_at_the_origin_from_all_around():
    views = synthetic13.views(0, 7, 2000, 224)
    assert views.cam_from_world.dtype == torch.float64
    K, E = views.intrinsics.numpy(), views.cam_from_world.numpy()
    np.testing.assert_allclose(K[0], [[420, 0, 111.5], [0, 420, 111.5], [0, 0, 1]])
    centers = -np.einsum("nji,nj->ni", E[:, :3, :3], E[:, :3, 3])
    np.testing.assert_allclose(np.linalg.norm(centers, axis=1), 2, rtol=1e-12)
    np.testing.assert_allclose(E[:, :3, 3], np.tile([0, 0, 2], (2000, 1)), atol=1e-12)
    elevation = np.degrees(np.arcsin(centers[:, 1] / 2))
    azimuth = np.degrees(np.arctan2(centers[:, 2], centers[:, 0])) % 360
    # The Kolmogorov distance from the uniform distribution exceeds 0.05 once in 10^4 for 2000 draws.
    for angles, low, high in ((elevation, -20, 30), (azimuth, 0, 360)):
        assert low <= angles.min() <= angles.max() <= high
        expected = (np.sort(angles) - low) / (high - low)
        assert np.abs(expected - (np.arange(2000) + 0.5) / 2000).max() < 0.05


def test_the_first_views_do_not_depend_on_the_count():
    few, many = synthetic13.views(1, 2, 3, 64), synthetic13.views(1, 2, 9, 64)
    torch.testing.assert_close(many.cam_from_world[:3], few.cam_from_world, rtol=0, atol=0)
    other = synthetic13.views(1, 3, 3, 64)
    assert not torch.equal(other.cam_from_world, few.cam_from_world)


def test_the_split_is_seventy_ten_twenty():
    parts = [synthetic13.split(0, index) for index in range(5000)]
    for name, share in (("train", 0.7), ("val", 0.1), ("test", 0.2)):
        deviation = np.sqrt(share * (1 - share) / 5000)
        assert abs(parts.count(name) / 5000 - share) < 4 * deviation
    assert [synthetic13.split(1, index) for index in range(50)] != parts[:50]
    # Also within a category, although categories depend on the index.
    chairs = parts[4::13]
    assert 0.6 < chairs.count("train") / len(chairs) < 0.8


def test_lights_seldom_saturate_white():
    generator = np.random.default_rng(0)
    normals = generator.normal(size=(2000, 3))
    normals = torch.from_numpy(normals / np.linalg.norm(normals, axis=1, keepdims=True))
    clipped, counts = [], set()
    for _ in range(100):
        lights = synthetic13.random_lights(generator)
        counts.add(len(lights.directions))
        torch.testing.assert_close(lights.directions.norm(dim=-1), torch.ones(len(lights.directions)).double())
        assert 0.28 <= lights.ambient.min() <= lights.ambient.max() <= 0.5
        assert (lights.colours > 0).all()
        facing = (normals @ lights.directions.T).clamp_min(0)
        clipped.append(((lights.ambient + facing @ lights.colours) > 1).double().mean())
    assert counts == {2, 3}
    assert np.mean(clipped) < 0.03


def test_shapes_render():
    shape = synthetic13.shape(0, 4)
    views = synthetic13.views(0, 4, 2, 48)
    views = CameraTensors(*(torch.as_tensor(value)[None] for value in views))
    picture = scenes.render([shape.scene], views, shape.lights)
    covered = picture.mask.double().mean(dim=(-1, -2))
    assert (covered > 0.02).all()
    assert (covered < 0.9).all()
    depth = picture.depth[picture.mask]
    assert 1.4 < depth.min() < depth.max() < 2.6


def test_a_parameter_has_one_name():
    p = Parameters(np.random.default_rng(0))
    p.uniform("height", 0, 1)
    with pytest.raises(OptionError, match="'height' has been drawn already"):
        p.choice("height", ("a", "b"))


class Ends(Parameters):
    """Draws every number from the two ends of its range, where failures are likeliest."""

    def uniform(self, name, low, high):
        self.numbers[name] = low if super().uniform(name, low, high) < (low + high) / 2 else high
        return self.numbers[name]


@pytest.mark.parametrize("category", CATEGORIES)
def test_extreme_parameters_make_a_shape(category):
    build = importlib.import_module(f"lsmgeo.scenes.synthetic13.{category}").build
    generator = np.random.default_rng(0)
    for _ in range(40):
        parts = build(Ends(generator), random_palette(generator))
        assert np.isfinite(scenes.Scene(parts).bounds()).all()


@pytest.mark.parametrize("bad", [-1, 2**32, 1.0, True, "0"])
def test_seeds_and_indices_are_checked(bad):
    for call in (synthetic13.shape, synthetic13.split):
        with pytest.raises(OptionError, match="seed must be a whole number from 0 to 4294967295"):
            call(bad, 0)
        with pytest.raises(OptionError, match="index must be a whole number from 0 to 4294967295"):
            call(0, bad)


def test_invalid_requests():
    with pytest.raises(OptionError, match=r"category must be one of airplane, .*; got 'boat'"):
        synthetic13.shape(0, 0, "boat")
    with pytest.raises(ShapeError, match="count"):
        synthetic13.views(0, 0, 0, 64)
    with pytest.raises(ShapeError, match="at least 2"):
        synthetic13.measure("chair", count=1)
