"""D-LSM: the released layers, what lies along a ray, other views, and what holds for any number of views."""

from __future__ import annotations

import pytest
import torch

from lsmgeo import PlaneSweepProject, VoxelGrid, depth_planes
from lsmgeo.cameras import CameraTensors
from lsmgeo.errors import OptionError, ShapeError
from lsmgeo.models import create
from tests.models.inputs import count, look, shapes_at, some
from tests.models.released_layers import reduce_rays
from tests.tolerances import BATCHED


@pytest.fixture(scope="module")
def tiny():
    torch.manual_seed(0)
    return create("depth-lsm", preset="tiny")


@pytest.fixture(scope="module")
def free():
    """A model without skips, which can look from anywhere."""
    torch.manual_seed(0)
    return create("depth-lsm", preset="tiny", skips=False)


@pytest.fixture(scope="module")
def release():
    torch.manual_seed(0)
    return create("depth-lsm", variant="release")


def test_the_release_has_its_counts_of_parameters(release):
    assert count(release) == 3_888_673
    assert count(release.rays) + count(release.rise) + count(release.out) == 1_160_609
    assert count(release.sweep) == 0


def test_the_release_has_its_shapes_at_every_stage(release):
    stages = ("sweep", "rays.0", "rays.1", "rise.0", "rise.1", "out")
    assert shapes_at(release, stages, *look(1, 1, 224)) == {
        "sweep": (1, 1, 2048, 56, 56),
        "rays.0": (1, 512, 56, 56),
        "rays.1": (1, 64, 56, 56),
        "rise.0": (1, 32, 112, 112),
        "rise.1": (1, 32, 224, 224),
        "out": (1, 1, 224, 224),
    }


def test_the_release_is_its_layers_written_out():
    torch.manual_seed(1)
    model = create("depth-lsm", variant="release", image_size=32, grid_size=16).double().requires_grad_(False)
    for name, parameter in model.named_parameters():
        if name.endswith("bias"):
            torch.nn.init.normal_(parameter, std=0.3)
    images, cameras = look(1, 2)
    swept = []
    hook = model.sweep.register_forward_hook(lambda module, given, made: swept.append(made.maps))
    found = model(images.double(), cameras).depth
    hook.remove()
    maps = model.image_encoder(images[0].double()).maps
    assert tuple(swept[0].shape) == (2, 2, 2048, 8, 8)  # two steps of one scene, two views
    for step in range(2):
        expected = reduce_rays(swept[0][step], list(maps), model.state_dict())
        torch.testing.assert_close(found[0, step], expected)


def test_the_paper_s_net_reduces_the_stacked_planes(tiny):
    """The fused sweep is the plain sweep, depth and direction with it, and a 1x1 convolution."""
    images, cameras = look(1, 2)
    fed, made_of = [], []
    first = tiny.sweep.register_forward_hook(lambda module, given, made: made_of.append((given, made.maps)))
    second = tiny.rays.register_forward_hook(lambda module, given, made: fed.append(given[0]))
    with torch.no_grad():
        tiny(images, cameras, steps="last")
    first.remove()
    second.remove()
    (grids, sent, _), maps = made_of[0]
    planes = depth_planes(1.0, 3.0, 8)
    sweep = PlaneSweepProject(VoxelGrid(8), planes, size=(8, 8), augment=("depth", "direction"))
    stacked = sweep(grids, sent).maps[0]
    assert stacked.shape[1] == (8 + 8 + 4) * 8 == tiny.sweep.weight.shape[1]  # network, fused grid, depth, direction
    torch.testing.assert_close(stacked[:, 16 * 8 : 17 * 8, 0, 0], planes.expand(2, 8))
    expected = torch.nn.functional.conv2d(stacked, tiny.sweep.weight)
    torch.testing.assert_close(maps[0], expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(fed[0], maps.flatten(0, 1))


def test_nearest_and_trilinear_projection_differ():
    def depth(projection):
        torch.manual_seed(0)
        return create("depth-lsm", preset="tiny", projection=projection).run(*look(1, 2)).depth

    assert not torch.allclose(depth("nearest"), depth("trilinear"), atol=1e-3)
    assert create("depth-lsm", image_size=32).sweep.mode == "nearest"  # the paper's


def test_depth_starts_in_the_middle_of_the_planes():
    torch.manual_seed(0)
    model = create("depth-lsm", preset="tiny", near=4.0, far=6.0)
    with torch.no_grad():
        model.out.convolution.weight.zero_()
        depth = model(*look(1, 2)).depth
    torch.testing.assert_close(depth, torch.full((1, 2, 2, 32, 32), 5.0))


def test_any_number_of_views_runs(tiny):
    images, cameras = look(1, 20)
    for views in (1, 2, 20):
        result = tiny.run(images[:, :views], some(cameras, 0, slice(views)))
        assert tuple(result.depth.shape) == (1, views, 32, 32)
        assert bool(result.depth.isfinite().all())
        assert result.by_view is None


def test_steps_are_those_of_all_and_know_no_later_view(tiny):
    images, cameras = look(2, 3)
    with torch.no_grad():
        every = tiny(images, cameras).depth
        assert tuple(every.shape) == (2, 3, 3, 32, 32)
        for steps, indices in (("last", [2]), ([0, 1], [0, 1])):
            found = tiny(images, cameras, steps=steps).depth
            torch.testing.assert_close(found, every[:, indices], rtol=0, atol=BATCHED)
        fewer = tiny(images[:, :2], some(cameras, slice(2), slice(2))).depth
        torch.testing.assert_close(fewer, every[:, :2, :2], rtol=0, atol=BATCHED)
    by_view = tiny.run(images, cameras, by_view=True).by_view
    torch.testing.assert_close(by_view, every, rtol=0, atol=BATCHED)


def test_ragged_scenes_equal_their_scenes_alone(tiny):
    images, cameras = look(2, 3)
    counts = [3, 1]
    mask = torch.arange(3) < torch.tensor(counts)[:, None]
    with torch.no_grad():
        found = tiny(images, cameras, mask, steps="last").depth[:, 0]
        for scene, views in enumerate(counts):
            alone = tiny(images[scene : scene + 1, :views], some(cameras, scene, slice(views)), steps="last").depth
            torch.testing.assert_close(found[scene, :views], alone[0, 0], rtol=0, atol=BATCHED)
    assert bool((found[1, 1:] == 0).all())
    assert bool((found[mask] != 0).all())


def test_views_that_are_no_input_can_be_predicted(free):
    images, cameras = look(2, 3)
    others = look(2, 5, seed=1)[1]
    own = free.run(images, cameras).depth
    again = free.run(images, cameras, target_cameras=cameras).depth
    torch.testing.assert_close(again, own, rtol=0, atol=BATCHED)
    found = free.run(images, cameras, target_cameras=others).depth
    assert tuple(found.shape) == (2, 5, 32, 32)
    one = free.run(images, cameras, target_cameras=some(others, slice(2), [3])).depth
    torch.testing.assert_close(one, found[:, [3]], rtol=0, atol=BATCHED)
    # Cameras in a row, view fastest, are the same cameras.
    row = CameraTensors(*(torch.as_tensor(field).flatten(0, 1) for field in others))
    torch.testing.assert_close(free.run(images, cameras, target_cameras=row).depth, found, rtol=0, atol=0)
    # The mask is of the inputs, not of what is predicted.
    mask = torch.tensor([[True, True, False], [True, True, True]])
    assert bool((free.run(images, cameras, mask, target_cameras=others).depth != 0).all())


def test_a_model_with_skips_predicts_only_its_inputs(tiny):
    images, cameras = look(1, 2)
    with pytest.raises(OptionError, match="create it with skips=False"):
        tiny(images, cameras, target_cameras=cameras)


def test_cameras_of_other_scenes_are_refused(free):
    images, cameras = look(2, 2)
    with pytest.raises(ShapeError, match="cameras must be"):
        free(images, cameras, target_cameras=look(3, 1)[1])


def test_depth_is_float32_under_autocast(tiny):
    images, cameras = look(2, 2)
    with torch.no_grad():
        expected = tiny(images, cameras).depth
    tiny.zero_grad()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = tiny(images, cameras).depth
    assert found.dtype == torch.float32
    found.square().mean().backward()
    assert all(bool(weights.grad.isfinite().all()) for weights in tiny.parameters())
    assert float((found.detach() - expected).abs().mean() / expected.std()) < 0.05


def test_maps_of_another_stride():
    model = create("depth-lsm", preset="tiny", map_stride=2)
    assert len(model.rise) == 1
    assert tuple(model.run(*look(1, 2)).depth.shape) == (1, 2, 32, 32)


def test_the_release_s_rules_of_a_sweep():
    """Rays through (j + 0.5, i + 0.5) of scaled intrinsics, and voxel round((X + 0.5) n), as the release has it."""
    torch.manual_seed(0)
    model = create("depth-lsm", variant="release", image_size=32, grid_size=16, pixel_rules="release", planes=5)
    images, cameras = look(1, 1)
    swept = []
    model.sweep.register_forward_hook(lambda module, given, made: swept.append((given[0], made.maps)))
    with torch.no_grad():
        model(images, cameras)
    grid, maps = swept[0]
    K, E = cameras.intrinsics[0, 0].double().clone(), cameras.cam_from_world[0, 0].double()
    K[:2] /= 4
    depths = torch.linspace(1.0, 3.0, 5, dtype=torch.float64)
    rows, columns = torch.meshgrid(torch.arange(8.0), torch.arange(8.0), indexing="ij")
    pixels = torch.stack((columns + 0.5, rows + 0.5, torch.ones(8, 8)), -1).double()
    rays = pixels @ torch.linalg.inv(K).T
    points = (depths[:, None, None, None] * rays - E[:3, 3]) @ E[:3, :3]
    index = ((points + 0.5) * 16).round().long()  # x, y, z
    inside = ((index >= 0) & (index < 16)).all(-1)
    x, y, z = torch.where(inside[..., None], index, 0).unbind(-1)
    expected = torch.where(inside, grid[0][:, z, y, x], 0.0)
    found = maps.unflatten(2, (-1, 5))[0, 0]
    # A ray may pass the border of a voxel, where a bit decides.
    assert float((found == expected).all(0).double().mean()) > 0.995
    assert int(inside.sum()) > 50


def test_no_scenes(tiny):
    images, cameras = look(1, 2)
    output = tiny(images[:0], cameras.at(slice(0, 0)))
    assert output.depth.shape == tiny(images, cameras).depth[:0].shape
