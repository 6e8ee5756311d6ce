"""V-LSM: the released layers, what goes through the geometry, and what holds for any number of views."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lsmgeo import Unproject, VoxelGrid
from lsmgeo.errors import DTypeError, OptionError, ShapeError
from lsmgeo.models import create
from lsmgeo.models.blocks import interleave
from tests.models.inputs import count, look, shapes_at, some
from tests.models.released_layers import encode, occupy, reason
from tests.tolerances import BATCHED


@pytest.fixture(scope="module")
def release():
    torch.manual_seed(0)
    return create("voxel-lsm", variant="release")


@pytest.fixture(scope="module")
def tiny():
    torch.manual_seed(0)
    return create("voxel-lsm", preset="tiny")


def test_the_release_has_its_counts_of_parameters(release):
    assert count(release) == 2_730_113
    assert count(release.image_encoder) == 920_640
    assert count(release.fusion) == 168_672
    assert count(release.grid_network) == 1_638_752
    assert count(release.out) == 2_049


def test_the_release_has_its_shapes_at_every_stage(release):
    names = [name for name, _ in release.named_modules()]
    stages = [name for name in names if name.split(".")[-1].isdigit() or name in ("image_encoder.out", "out")]
    assert shapes_at(release, stages, *look(1, 1, 224)) == {
        "image_encoder.down.0": (1, 32, 112, 112),
        "image_encoder.down.1": (1, 64, 56, 56),
        "image_encoder.down.2": (1, 128, 28, 28),
        "image_encoder.down.3": (1, 256, 14, 14),
        "image_encoder.up.0": (1, 128, 28, 28),
        "image_encoder.up.1": (1, 64, 56, 56),
        "image_encoder.up.2": (1, 32, 112, 112),
        "image_encoder.out": (1, 32, 112, 112),
        "grid_network.down.0": (1, 32, 16, 16, 16),
        "grid_network.down.1": (1, 64, 8, 8, 8),
        "grid_network.down.2": (1, 128, 4, 4, 4),
        "grid_network.up.0": (1, 64, 8, 8, 8),
        "grid_network.up.1": (1, 32, 16, 16, 16),
        "grid_network.up.2": (1, 32, 32, 32, 32),
        "out": (1, 1, 32, 32, 32),
    }


def test_the_release_is_its_layers_written_out():
    torch.manual_seed(1)
    model = create("voxel-lsm", variant="release", image_size=32, grid_size=16).double().requires_grad_(False)
    for name, parameter in model.named_parameters():
        if name.endswith("bias"):
            torch.nn.init.normal_(parameter, std=0.3)
    state = model.state_dict()
    images = look(2, 1)[0].flatten(0, 1).double()
    features, maps = model.image_encoder(images)
    expected, early = encode(images, state)
    torch.testing.assert_close(features, expected)
    for ours, theirs in zip(maps, early, strict=True):
        torch.testing.assert_close(ours, theirs)
    grid = torch.randn(2, 32, 16, 16, 16, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    found = model.grid_network(grid)
    torch.testing.assert_close(found, reason(grid, state))
    torch.testing.assert_close(model.out(found), occupy(reason(grid, state), state))


@pytest.mark.parametrize(("variant", "extra"), [("paper", 4), ("release", 1)])
def test_depth_and_direction_go_with_the_features(variant, extra):
    torch.manual_seed(0)
    model = create("voxel-lsm", variant=variant, image_size=32, grid_size=16)
    images, cameras = look(1, 2)
    fed = []
    model.unproject.register_forward_hook(lambda module, given, made: fed.append(made))
    with torch.no_grad():
        model(images, cameras)
    volume, visible = fed[0]
    assert volume.shape[2] == 32 + extra == model.fusion.in_channels
    sites = VoxelGrid(16).centers()
    for view in range(2):
        E = cameras.cam_from_world[0, view]
        depth = sites @ E[2, :3] + E[2, 3]
        torch.testing.assert_close(volume[0, view, 32], depth, rtol=0, atol=1e-5)
        if variant == "paper":
            rays = sites + E[:3, :3].T @ E[:3, 3]
            expected = torch.nn.functional.normalize(rays, dim=-1).movedim(-1, 0)
            torch.testing.assert_close(volume[0, view, 33:], expected, rtol=0, atol=1e-5)
    # Outside the images, beyond the half pixel in which features fade, there is nothing, or the release's border.
    outside = (volume[0, :, :32] == 0).all(1)
    assert not bool((outside & visible[0]).any())
    assert (int(outside.sum()) > 100) == (variant == "paper")


@pytest.mark.parametrize("fusion", ["gru", "lstm"])
def test_any_number_of_views_runs(tiny, fusion):
    model = tiny if fusion == "gru" else create("voxel-lsm", preset="tiny", fusion="lstm")
    images, cameras = look(1, 20)
    with torch.no_grad():
        found = model(images, cameras).logits
        for views in range(1, 20) if fusion == "gru" else (1, 2, 7):
            fewer = model(images[:, :views], some(cameras, 0, slice(views))).logits
            # The prediction after a view does not depend on later views.
            torch.testing.assert_close(fewer, found[:, :views], rtol=0, atol=BATCHED)
    assert tuple(found.shape) == (1, 20, 16, 16, 16)
    assert bool(found.isfinite().all())


def test_steps_are_those_of_all(tiny):
    images, cameras = look(2, 4)
    with torch.no_grad():
        every = tiny(images, cameras).logits
        for steps, indices in (("last", [3]), ([1, 2], [1, 2]), ([0], [0])):
            found = tiny(images, cameras, steps=steps).logits
            torch.testing.assert_close(found, every[:, indices], rtol=0, atol=BATCHED)


def test_ragged_scenes_equal_their_scenes_alone(tiny):
    images, cameras = look(3, 4)
    counts = [4, 1, 2]
    mask = torch.arange(4) < torch.tensor(counts)[:, None]
    with torch.no_grad():
        found = tiny(images, cameras, mask).logits
        for scene, views in enumerate(counts):
            alone = tiny(images[scene : scene + 1, :views], some(cameras, scene, slice(views))).logits
            torch.testing.assert_close(found[scene, :views], alone[0], rtol=0, atol=BATCHED)
            for view in range(views, 4):
                torch.testing.assert_close(found[scene, view], found[scene, views - 1], rtol=0, atol=BATCHED)


def test_cameras_are_used(tiny):
    images, cameras = look(1, 2)
    swapped = some(cameras, 0, [1, 0])
    with torch.no_grad():
        found, other = tiny(images, cameras).logits, tiny(images, swapped).logits
    assert not torch.allclose(found, other, atol=1e-2)


def test_bfloat16_under_autocast(tiny):
    images, cameras = look(2, 3)
    mask = torch.tensor([[True, True, True], [True, False, False]])
    tiny.zero_grad()
    with torch.no_grad():
        expected = tiny(images, cameras, mask).logits
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = tiny(images, cameras, mask).logits
    found.float().square().mean().backward()
    assert all(bool(weights.grad.isfinite().all()) for weights in tiny.parameters())
    assert float((found.detach() - expected).abs().mean() / expected.std()) < 0.05


def test_run_gives_probabilities_and_leaves_the_mode(tiny):
    images, cameras = look(2, 3)
    for mode in (True, False):
        tiny.train(mode)
        result = tiny.run(images, cameras)
        assert tiny.training == mode
        assert not result.occupancy.requires_grad
        torch.testing.assert_close(result.occupancy, result.by_view[:, -1], rtol=0, atol=0)
        expected = torch.special.expit(tiny(images, cameras).logits.detach())
        torch.testing.assert_close(result.by_view, expected, rtol=0, atol=1e-6)
        assert tiny.run(images, cameras, by_view=False).by_view is None
    tiny.train()


def test_images_of_other_sizes_run(tiny):
    """Cameras rescale with the images, so that twice the pixels are about the same scene."""
    images, cameras = look(1, 2, 32)
    larger = torch.nn.functional.interpolate(images[0], scale_factor=2.0, mode="nearest")[None]
    with torch.no_grad():
        assert tiny(larger, look(1, 2, 64)[1]).logits.shape == tiny(images, cameras).logits.shape
        assert tuple(tiny(larger[..., :32, :], cameras).logits.shape) == (1, 2, 16, 16, 16)


def test_grids_of_64():
    torch.manual_seed(0)
    model = create(
        "voxel-lsm",
        image_size=32,
        encoder_channels=(4, 6),
        feature_channels=4,
        hidden_channels=4,
        grid_size=64,
        grid_channels=(4, 6, 6, 8),
        output_channels=4,
    )
    assert model.resolution == 64
    images, cameras = look(1, 1)
    assert tuple(model.run(images, cameras).occupancy.shape) == (1, 64, 64, 64)
    # The release's own 64^3 network: a fourth level of 256, and its way back.
    release = create("voxel-lsm", variant="release", grid_size=64, grid_channels=(32, 64, 128, 256))
    level = 64 * 128 * 256 + 256 + 64 * 256 * 128 + 128
    assert count(release.grid_network) == 1_638_752 + level + 64 * (256 - 128) * 64


def test_finer_voxels_lie_between_the_grid_s():
    parts = torch.arange(8.0).reshape(1, 8, 1, 1, 1).expand(1, 8, 2, 1, 1).clone()
    parts[:, :, 1] += 10
    expected = np.zeros((4, 2, 2))
    for z, y, x in np.ndindex(4, 2, 2):
        expected[z, y, x] = 10 * (z // 2) + 4 * (z % 2) + 2 * y + x
    np.testing.assert_array_equal(interleave(parts, 2)[0, 0].numpy(), expected)


def test_a_lifted_volume_is_the_finer_one_cell_by_cell():
    """Channel ((c l + z) l + y) l + x of a cell is channel c of its sub-voxel (z, y, x); depth and rays are its own."""
    torch.manual_seed(0)
    model = create("voxel-lsm", preset="tiny", lift=2, feature_channels=3, grid_size=8)
    features, cameras = torch.randn(1, 2, 3, 16, 16), look(1, 2)[1]
    found = model._unproject(features, cameras, None).volume
    fine, _ = Unproject(VoxelGrid(16))(features, cameras)
    rays, _ = Unproject(VoxelGrid(8), augment=("depth", "direction"))(features, cameras)
    assert found.shape == (1, 2, 3 * 8 + 4, 8, 8, 8)
    assert model.fusion.in_channels == 3 * 8 + 4
    expected = np.zeros((1, 2, 3, 2, 2, 2, 8, 8, 8), np.float32)
    for z, y, x in np.ndindex(2, 2, 2):
        expected[:, :, :, z, y, x] = fine[..., z::2, y::2, x::2]
    np.testing.assert_array_equal(found[:, :, :24].numpy(), expected.reshape(1, 2, 24, 8, 8, 8))
    torch.testing.assert_close(found[:, :, 24:], rays[:, :, 3:], rtol=0, atol=0)


def test_the_release_s_rule_takes_a_pixel_to_lie_at_j_times_the_stride():
    """Maps whose values are their pixels' indices read u / stride there, and (u + 0.5) / stride - 0.5 by ours."""
    rows, columns = torch.meshgrid(torch.arange(8.0), torch.arange(8.0), indexing="ij")
    maps = torch.stack((columns, rows)).expand(1, 1, 2, 8, 8)
    _, cameras = look(1, 1)
    sites = VoxelGrid(8).centers().double()
    camera = (cameras.intrinsics[0, 0].double(), cameras.cam_from_world[0, 0].double())
    seen = (sites @ camera[1][:3, :3].T + camera[1][:3, 3]) @ camera[0].T
    pixels = (seen[..., :2] / seen[..., 2:]).movedim(-1, 0)
    for rules, expected in (("release", pixels / 4), ("exact", (pixels + 0.5) / 4 - 0.5)):
        model = create("voxel-lsm", preset="tiny", feature_channels=2, feature_stride=4, pixel_rules=rules)
        found = model._unproject(maps, cameras, None).volume[0, 0, :2].double()
        inside = ((expected > 0) & (expected < 7)).all(0)
        assert int(inside.sum()) > 100
        torch.testing.assert_close(found[:, inside], expected[:, inside], rtol=0, atol=1e-4)


def test_arguments_are_checked(tiny):
    with pytest.raises(OptionError, match="input_kernel must be odd; got 2"):
        create("voxel-lsm", preset="tiny", input_kernel=2)
    with pytest.raises(OptionError, match="lift must be int, from 1 to 4; got int 5"):
        create("voxel-lsm", preset="tiny", lift=5)
    with pytest.raises(OptionError, match=r"pixel_rules must be Literal\['exact', 'release'\]"):
        create("voxel-lsm", preset="tiny", pixel_rules="half")
    images, cameras = look(1, 2)
    with pytest.raises(ShapeError, match=r"voxel-lsm: images must be .* multiples of 4, at least 8; got"):
        tiny(images[..., :30], cameras)
    with pytest.raises(ShapeError, match="got \\(1, 2, 1, 32, 32\\)"):
        tiny(images[:, :, :1], cameras)
    with pytest.raises(DTypeError, match="images must be a tensor"):
        tiny([1], cameras)
    with pytest.raises(OptionError, match="steps must be None, 'last' or indices"):
        tiny(images, cameras, steps="first")
    with pytest.raises(OptionError, match="steps must be a whole number from 0 to 1"):
        tiny(images, cameras, steps=[2])
    with pytest.raises(ShapeError, match="view_mask must be"):
        tiny(images, cameras, torch.ones(1, 3, dtype=torch.bool))
    with pytest.raises(OptionError, match="by_view must be True or False"):
        tiny.run(images, cameras, by_view=1)
