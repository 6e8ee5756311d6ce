"""Models by name, and by the settings that they keep."""

from __future__ import annotations

import json

import pytest
import torch

from lsmgeo.errors import DTypeError, OptionError
from lsmgeo.models import Model, create, from_settings, settings_of
from lsmgeo.models.creating import MODELS, PRESETS
from tests.models.inputs import count, look

# So that a change of a preset's weights, which makes files of weights useless, is seen.
COUNTS = {
    ("voxel-lsm", "paper"): 3_412_609,
    ("voxel-lsm", "compact"): 1_125_264,
    ("voxel-lsm", "standard"): 1_125_264,
    ("voxel-lsm", "tiny"): 35_840,
    ("depth-lsm", "paper"): 4_830_785,
    ("depth-lsm", "compact"): 1_326_489,
    ("depth-lsm", "standard"): 1_326_489,
    ("depth-lsm", "tiny"): 41_729,
}


@pytest.mark.parametrize(("name", "preset"), COUNTS)
def test_presets_have_their_counts_of_parameters(name, preset):
    model = create(name, preset=preset)
    assert count(model) == COUNTS[name, preset]


@pytest.mark.parametrize("name", MODELS)
def test_tiny_models_say_what_they_are(name):
    model = create(name, preset="tiny")
    assert isinstance(model, Model)
    assert model.name == name
    assert count(model) < 60_000
    size = model.image_size
    result = model.run(*look(1, 2, size))
    if model.output == "voxels":
        assert tuple(result.occupancy.shape) == (1, *[model.resolution] * 3) == (1, *model.grid.shape)
    else:
        assert tuple(result.depth.shape) == (1, 2, size, size)


@pytest.mark.parametrize("name", MODELS)
def test_settings_go_through_json(name):
    torch.manual_seed(0)
    model = create(name, preset="tiny", image_size=48)
    settings = json.loads(json.dumps(settings_of(model)))
    for other in (from_settings(settings), create(**settings)):
        assert other.settings == model.settings
        assert other.name == model.name
        other.load_state_dict(model.state_dict())
        found, expected = other.run(*look(1, 1, 48)), model.run(*look(1, 1, 48))
        assert torch.equal(found[0], expected[0])


@pytest.mark.parametrize("name", ["voxel-lsm", "depth-lsm"])
def test_the_release_goes_through_its_settings(name):
    model = create(name, variant="release", image_size=32, grid_size=16)
    assert model.settings.variant == "release"
    assert create(**settings_of(model)).state_dict().keys() == model.state_dict().keys()


def test_weights_follow_the_seed():
    def weights(seed):
        torch.manual_seed(seed)
        return torch.cat([item.flatten() for item in create("voxel-lsm", preset="tiny").parameters()])

    assert torch.equal(weights(0), weights(0))
    assert not torch.equal(weights(0), weights(1))


def test_every_model_has_the_four_presets():
    assert {name: set(presets) for name, presets in PRESETS.items()} == {
        name: {"paper", "compact", "standard", "tiny"} for name in MODELS
    }


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: create("voxels-lsm"),
            r"name must be one of the models; got str 'voxels-lsm'; did you mean voxel-lsm\?",
        ),
        (lambda: create("voxel-lsm", preset="small"), "preset must be one of 'paper', 'compact', 'standard', 'tiny'"),
        (lambda: create("voxel-lsm", variant="original"), "variant must be one of 'paper', 'release'"),
        (
            lambda: create("voxel-lsm", preset="tiny", variant="release"),
            "variant 'release' is for .* of preset 'paper'",
        ),
        (lambda: create("r2n2", variant="release"), "variant 'release' is for"),
        (
            lambda: create("voxel-lsm", preset="tiny", hiden_channels=4),
            r"there is no setting 'hiden_channels'; did you mean hidden_channels\?",
        ),
        (lambda: create("voxel-lsm", preset="tiny", planes=4), "there is no setting 'planes'"),
        (lambda: create("voxel-lsm", preset="tiny", image_size=30), "image_size must be a multiple of 4"),
        (lambda: create("voxel-lsm", preset="tiny", image_size=4), "and at least twice that; got 4"),
        (lambda: create("voxel-lsm", preset="tiny", grid_size=4), "grid_size must be a multiple of 4"),
        (lambda: create("voxel-lsm", preset="tiny", feature_stride=3), "feature_stride must be one of 2, 4"),
        (
            lambda: create("voxel-lsm", preset="tiny", encoder_channels=()),
            r"encoder_channels must be tuple\[int, ...\]",
        ),
        (
            lambda: create("r2n2", preset="tiny", decoder=[4] * 65),
            r"decoder must be tuple\[int, ...\] of length 1 to 64, from 1 to 4096",
        ),
        (
            lambda: create("voxel-lsm", preset="tiny", encoder_channels=(8, 0)),
            r"encoder_channels must be tuple\[int, ...\] of length 1 to 64, from 1 to 4096; got tuple \(8, 0\)",
        ),
        (
            lambda: create("voxel-lsm", preset="tiny", fusion="median"),
            r"fusion must be Literal\['gru', 'lstm', 'mean', 'variance', 'max'\]; got str 'median'",
        ),
        (lambda: create("voxel-lsm", preset="tiny", grid_skip=1), "grid_skip must be bool; got int 1"),
        (lambda: create("voxel-lsm", variant="release", upsample=2), "upsample must be 1 in the variant 'release'"),
        (lambda: create("depth-lsm", preset="tiny", near=3.0), "near must be less than far = 3.0; got 3.0"),
        (lambda: create("depth-lsm", preset="tiny", planes=1), "planes must be int, from 2 to 4096; got int 1"),
        (lambda: create("depth-lsm", preset="tiny", ray_channels=(8,)), "ray_channels must be two numbers"),
        (lambda: create("depth-lsm", preset="tiny", map_stride=8), "map_stride must be one of 2, 4"),
        (lambda: create("depth-lsm", preset="tiny", projection="cubic"), "projection must be Literal"),
        (lambda: create("depth-lsm", preset="tiny", skips="yes"), "skips must be bool; got str 'yes'"),
        (lambda: from_settings({"image_size": 32}), "settings must have a 'name'"),
        (lambda: from_settings({"name": "v-lsm"}), "name must be one of"),
        (lambda: from_settings({"name": "voxel-lsm", "channels": 3}), "there is no setting 'channels'"),
    ],
)
def test_what_cannot_be_built_is_named(call, message):
    with pytest.raises(OptionError, match=message):
        call()


def test_settings_of_another_module():
    with pytest.raises(DTypeError, match=r"model must be one of lsmgeo\.models\.create, not wrapped"):
        settings_of(torch.nn.Linear(1, 1))
