"""When values are looked at, what dropped views are allowed to hold, and arrays that hold nothing."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import pytest
import torch

import lsmgeo
from lsmgeo import CameraTensors, cameras, debugging, depth_planes, functional
from lsmgeo.debugging import can_inspect
from lsmgeo.errors import CameraError, GridError, ShapeError
from tests.fuzz.calls import sweep, unproject, with_value
from tests.fuzz.positions import DEPTHS, FEATURES, GRID, MAP, MASK, VIEWS, B, V, right_cameras


class TestDebug:
    """`debug` matters for tensors whose values a device would have to be waited for; one is played here."""

    elsewhere = SimpleNamespace(device=torch.device("cuda"), is_meta=False)

    @pytest.fixture(autouse=True)
    def _plays_a_tensor(self, monkeypatch):
        monkeypatch.setattr(debugging, "PLAIN", (*debugging.PLAIN, SimpleNamespace))

    def test_what_holds_no_values_is_never_read(self):
        with lsmgeo.debug():
            assert not can_inspect(torch.ones(1, device="meta"))

    def test_values_are_read_on_the_cpu_and_in_the_context(self):
        assert can_inspect(torch.ones(1))
        assert not can_inspect(self.elsewhere)
        with lsmgeo.debug():
            assert can_inspect(self.elsewhere)
            with lsmgeo.debug():
                assert can_inspect(self.elsewhere)
            assert can_inspect(self.elsewhere)
        assert not can_inspect(self.elsewhere)

    def test_an_error_closes_the_context(self):
        with pytest.raises(GridError), lsmgeo.debug():
            depth_planes(2.0, 1.0, 3)
        assert not can_inspect(self.elsewhere)

    def test_other_threads_are_not_in_the_context(self):
        seen = []
        with lsmgeo.debug():
            thread = threading.Thread(target=lambda: seen.append(can_inspect(self.elsewhere)))
            thread.start()
            thread.join()
        assert seen == [False]

    def test_results_do_not_change(self):
        with lsmgeo.debug():
            inside = unproject()
        torch.testing.assert_close(inside, unproject(), rtol=0, atol=0)

    @pytest.mark.gpu
    def test_values_on_a_gpu_are_checked_in_the_context_alone(self):
        bad = cameras.to(with_value("intrinsics", (1, 0, 0, 2), float("nan")), "cuda")
        volume, _ = unproject(FEATURES.cuda(), bad)
        assert volume[0].isfinite().all()
        with pytest.raises(CameraError, match=r"cameras\[1, 0\]: intrinsics must be finite"), lsmgeo.debug():
            unproject(FEATURES.cuda(), bad)


def test_bad_values_pass_unread_under_transforms():
    def value_of(K: torch.Tensor) -> torch.Tensor:
        return unproject(views=VIEWS._replace(intrinsics=K)).volume.sum()

    K = VIEWS.intrinsics.clone()
    K[0, 0, 0, 0] = 0.0
    with pytest.raises(CameraError):
        value_of(K)
    gradient, value = torch.func.grad_and_value(value_of)(K)
    assert gradient.shape == K.shape
    assert value.shape == ()


def test_shapes_are_checked_under_transforms_too():
    with pytest.raises(ShapeError, match="features must be"):
        torch.vmap(lambda features: functional.unproject(features, VIEWS, GRID).volume)(FEATURES)


def spoil(views: CameraTensors, mask: torch.Tensor, value: float) -> CameraTensors:
    """Cameras that hold `value` everywhere where the mask drops them, their sizes 0."""
    K, E, height, width = views
    keep = mask[..., None, None]
    return CameraTensors(
        torch.where(keep, K, value),
        torch.where(keep, E, value),
        torch.where(mask, height, 0),
        torch.where(mask, width, 0),
    )


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 0.0, -1e38])
class TestDroppedViews:
    def test_unproject_reads_neither_features_nor_cameras(self, value):
        features = torch.where(MASK[..., None, None, None], FEATURES, value).requires_grad_()
        bad = spoil(VIEWS, MASK, value)
        K, E = (matrix.clone().requires_grad_() for matrix in bad[:2])
        options = {"augment": ("depth", "direction"), "view_mask": MASK}
        for reduce in (None, ("mean", "variance", "max")):
            volume, visible = unproject(features, CameraTensors(K, E, *bad[2:]), reduce=reduce, **options)
            expected, expected_visible = unproject(reduce=reduce, **options)
            torch.testing.assert_close(volume, expected, rtol=0, atol=0)
            assert torch.equal(visible, expected_visible)
            assert visible[MASK].any()
            assert not visible[~MASK].any()
            if reduce is None:
                assert not volume[~MASK].any()
            gradients = torch.autograd.grad(volume.sum(), (features, K, E))
            for gradient in gradients:
                assert gradient.isfinite().all()
                assert gradient[MASK].any()
                assert not gradient[~MASK].any()

    def test_unproject_points(self, value):
        points = torch.rand(B, 11, 3, generator=torch.Generator().manual_seed(1)) - 0.5
        bad = functional.unproject_points(FEATURES, spoil(VIEWS, MASK, value), points, view_mask=MASK, augment="depth")
        good = functional.unproject_points(FEATURES, VIEWS, points, view_mask=MASK, augment="depth")
        torch.testing.assert_close(bad, good, rtol=0, atol=0)
        assert good.volume[MASK].any()

    def test_sweep_reads_neither_cameras_nor_depths(self, value):
        bad = spoil(VIEWS, MASK, value)
        K, E = (matrix.clone().requires_grad_() for matrix in bad[:2])
        depths = torch.where(MASK[..., None], DEPTHS.expand(B, V, -1), value).requires_grad_()
        views = CameraTensors(K, E, *bad[2:])
        maps, visible = sweep(views=views, depths=depths, view_mask=MASK, augment=("depth", "direction"))
        expected = sweep(view_mask=MASK, augment=("depth", "direction"))
        torch.testing.assert_close((maps, visible), tuple(expected), rtol=0, atol=0)
        assert maps[MASK].any()
        assert not maps[~MASK].any()
        for gradient in torch.autograd.grad(maps.sum(), (K, E, depths)):
            assert gradient.isfinite().all()
            assert gradient[MASK].any()
            assert not gradient[~MASK].any()

    def test_the_dropped_view_is_named_once_it_is_kept(self, value):
        with pytest.raises(CameraError, match=r"cameras\[0, 1\]"):
            unproject(views=spoil(VIEWS, MASK, value))


@pytest.mark.parametrize(("scenes", "channels"), [(0, 4), (2, 0), (0, 0)])
class TestEmpty:
    def test_unproject(self, scenes, channels):
        features = torch.rand(scenes, V, channels, 5, 7, requires_grad=True)
        for reduce, axes in ((None, (V, channels + 4)), (("mean", "max"), (2 * (channels + 4),))):
            views = right_cameras(scenes, V)
            K = views.intrinsics.requires_grad_()
            volume, visible = unproject(features, views, reduce=reduce, augment=("depth", "direction"))
            assert volume.shape == (scenes, *axes, *GRID.shape)
            assert visible.shape == (scenes, V, *GRID.shape)
            of_features, of_K = torch.autograd.grad(volume.sum(), (features, K))
            assert of_features.shape == features.shape
            assert of_K.shape == K.shape
            assert of_K.isfinite().all()

    def test_sweep(self, scenes, channels):
        volume = torch.rand(scenes, channels, *GRID.shape, requires_grad=True)
        maps, visible = sweep(volume, right_cameras(scenes, V), augment="depth")
        assert maps.shape == (scenes, V, (channels + 1) * 5, *MAP)
        assert visible.shape == (scenes, V, 5, *MAP)
        (gradient,) = torch.autograd.grad(maps.sum(), volume)
        assert gradient.shape == volume.shape

    def test_points_and_pixels(self, scenes, channels):
        features = torch.rand(scenes, V, channels, 5, 7, requires_grad=True)
        for count in (0, 3):
            points = torch.zeros(scenes, count, 3)
            volume, visible = functional.unproject_points(features, right_cameras(scenes, V), points)
            assert volume.shape == (scenes, V, channels, count)
            assert visible.shape == (scenes, V, count)
            assert visible.all()
            assert torch.autograd.grad(volume.sum(), features)[0].shape == features.shape
            pixels, depth = torch.zeros(scenes, V, count, 2), torch.ones(scenes, V, count)
            volume, visible = functional.sample_views(features, pixels, depth, depth > 0)
            assert volume.shape == (scenes, V, channels, count)
            assert visible.all()

    def test_project_reduce(self, scenes, channels):
        volume = torch.rand(scenes, channels, *GRID.shape, requires_grad=True)
        weight, bias = torch.rand(2, channels * 5, requires_grad=True), torch.tensor([1.0, 2.0])
        maps, _ = lsmgeo.rays.project_reduce(volume, right_cameras(scenes, V), GRID, DEPTHS, weight, bias, MAP)
        assert maps.shape == (scenes, V, 2, *MAP)
        if channels == 0:
            assert torch.equal(maps, bias[:, None, None].expand_as(maps))
        assert torch.autograd.grad(maps.sum(), weight)[0].shape == weight.shape


def test_no_view_is_an_error_everywhere():
    none = torch.ones(B, 0, 3, dtype=torch.bool)
    calls = (
        lambda: unproject(torch.rand(B, 0, 4, 5, 7), right_cameras(B, 0)),
        lambda: unproject(torch.rand(0, 0, 4, 5, 7), right_cameras(0, 0)),
        lambda: functional.unproject_points(torch.rand(B, 0, 4, 5, 7), right_cameras(B, 0), torch.zeros(B, 1, 3)),
        lambda: functional.sample_views(torch.rand(B, 0, 4, 5, 7), torch.rand(B, 0, 3, 2), torch.rand(B, 0, 3), none),
        lambda: sweep(views=right_cameras(B, 0)),
        lambda: functional.view_statistics(torch.rand(B, 0, 4, 5), torch.ones(B, 0, 5, dtype=torch.bool), "mean"),
    )
    for call in calls:
        with pytest.raises(ShapeError, match=r"at least (1|one)"):
            call()


def test_every_view_dropped_gives_zeros():
    none = torch.zeros(B, V, dtype=torch.bool)
    for reduce in (None, "mean", "variance", "max"):
        volume, visible = unproject(view_mask=none, reduce=reduce, augment="depth")
        assert not volume.any()
        assert not visible.any()
