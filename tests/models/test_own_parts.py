"""Fusions without weights and encoders from outside fit the networks; files of weights hold what can be loaded."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from lsmgeo.errors import OptionError, ShapeError
from lsmgeo.fusion import Max
from lsmgeo.models import create, load, settings_of, write_weights
from tests.models.inputs import look, some

NETWORKS = ("voxel-lsm", "depth-lsm")


def backbone(channels: int = 5) -> nn.Module:
    return nn.Sequential(nn.Conv2d(3, channels, 3, stride=2, padding=1), nn.ReLU())


def assert_it_learns(model: nn.Module) -> None:
    """Every weight has a gradient, and a short step along it lowers the mean square."""
    images, cameras = look(1, 3)
    before = model(images, cameras, steps="last")[0].square().mean()
    before.backward()
    squares = [float(weights.grad.square().sum()) for weights in model.parameters()]
    assert min(squares) > 0
    with torch.no_grad():
        for weights in model.parameters():
            weights -= 1e-3 * before / sum(squares) * weights.grad
        assert float(model(images, cameras, steps="last")[0].square().mean()) < float(before)


@pytest.mark.parametrize("settings", [{}, {"lift": 2, "grid_skip": False}])
@pytest.mark.parametrize("fusion", ["mean", "variance", "max"])
@pytest.mark.parametrize("name", NETWORKS)
def test_a_statistic_fuses_views_learns_and_comes_back(tmp_path, name, fusion, settings):
    torch.manual_seed(0)
    model = create(name, preset="tiny", fusion=fusion, **settings)
    assert_it_learns(model)
    images, cameras = look(2, 3)
    mask = torch.tensor([[True, True, True], [True, False, True]])
    loaded = load(write_weights(tmp_path / "a.safetensors", model))
    assert settings_of(loaded)["fusion"] == fusion
    with torch.no_grad():
        expected = model(images, cameras, mask)[0]
        torch.testing.assert_close(loaded(images, cameras, mask)[0], expected, rtol=0, atol=0)
        first = model(images[:, :1], some(cameras, slice(2), slice(1)))[0]
    if name == "voxel-lsm":
        torch.testing.assert_close(expected[:, :1], first)  # later views change nothing before them
        torch.testing.assert_close(expected[1, 1], expected[1, 0])  # a masked view changes nothing


def test_the_mean_of_equal_views_is_that_of_one():
    torch.manual_seed(0)
    model = create("voxel-lsm", preset="tiny", fusion="mean")
    images, cameras = look(1, 1)
    twice = type(cameras)(*(torch.as_tensor(item).repeat_interleave(2, 1) for item in cameras))
    with torch.no_grad():
        one, two = model(images.repeat(1, 2, 1, 1, 1), twice).logits[0]
    torch.testing.assert_close(one, two, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("name", "options"), [("voxel-lsm", {}), ("depth-lsm", {"skips": False})])
def test_an_encoder_of_ones_own(tmp_path, name, options):
    torch.manual_seed(0)
    model = create(name, preset="tiny", encoder=backbone(), feature_channels=5, **options)
    assert_it_learns(model)
    images, cameras = look(1, 2, 44)  # no multiple of the built-in encoder's stride, which is 4 by 2 levels
    assert model(images[..., :40, :40], cameras._replace(height=40, width=40))[0].shape[1] == 2
    with pytest.raises(OptionError, match="image_encoder is of type Sequential, and load makes ImageEncoder"):
        write_weights(tmp_path / "a.safetensors", model)
    assert list(tmp_path.iterdir()) == []
    again = create(name, preset="tiny", encoder=backbone(), feature_channels=5, **options)
    again.load_state_dict(model.state_dict())


def test_encoders_that_do_not_fit_are_refused():
    with pytest.raises(OptionError, match="encoder must be a module or None; got str 'resnet'"):
        create("voxel-lsm", encoder="resnet")
    with pytest.raises(OptionError, match="skips must be False with an encoder"):
        create("depth-lsm", preset="tiny", encoder=backbone())
    model = create("voxel-lsm", preset="tiny", encoder=backbone(6), feature_channels=5)
    with pytest.raises(ShapeError, match=r"encoder must give features \(3, 5, h, w\).*; got \(3, 6, 16, 16\)"):
        model(*look(1, 3))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda model: model.double(), r"the file holds \S+ as .* float64; the model has .* float32"),
        (
            lambda model: model.add_module("head", nn.Linear(2, 2)),
            r"the file holds head\.bias, which",
        ),
        (lambda model: setattr(model, "fusion", nn.Identity()), "fusion is of type Identity, and load makes ConvGRU3d"),
        (lambda model: model.out.add_module("norm", nn.ReLU()), "out.norm is of type ReLU, and load makes Identity"),
        (lambda model: setattr(model, "name", "mine"), "the file holds settings of no model"),
    ],
)
def test_a_model_that_load_could_not_build_is_not_written(tmp_path, change, message):
    model = create("voxel-lsm", preset="tiny")
    change(model)
    with pytest.raises(OptionError, match=f"load can build from its settings; {message}"):
        write_weights(tmp_path / "a.safetensors", model)
    assert list(tmp_path.iterdir()) == []


def test_subclasses_and_swapped_statistics_are_not_written(tmp_path):
    """Their weights would fit, and load would make something else of them."""

    class Mine(type(create("voxel-lsm", preset="tiny"))):
        pass

    with pytest.raises(OptionError, match="it is of type Mine, and load makes VoxelLSM"):
        write_weights(tmp_path / "a.safetensors", Mine(create("voxel-lsm", preset="tiny").settings))
    model = create("voxel-lsm", preset="tiny", fusion="mean")
    model.fusion = Max()
    with pytest.raises(OptionError, match="fusion is of type Max, and load makes Mean"):
        write_weights(tmp_path / "a.safetensors", model)
    with pytest.raises(OptionError, match="about must be shorter than"):
        write_weights(tmp_path / "a.safetensors", create("voxel-lsm", preset="tiny"), about={"notes": "x" * (1 << 22)})
    assert list(tmp_path.iterdir()) == []
