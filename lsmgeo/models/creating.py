"""Models by name: presets, and the settings of a model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from torch import nn

from lsmgeo._checks import check_choice, describe
from lsmgeo.errors import DTypeError, OptionError
from lsmgeo.models.blocks import Model
from lsmgeo.models.depth_lsm import DepthLSM
from lsmgeo.models.r2n2 import R2N2, R2N2Settings
from lsmgeo.models.settings import DepthSettings, VoxelSettings, suggestion
from lsmgeo.models.voxel_lsm import VoxelLSM

__all__ = ["MODELS", "PRESETS", "RELEASES", "create", "from_settings", "settings_of"]

MODELS: dict[str, type[Model]] = {
    "voxel-lsm": VoxelLSM,
    "depth-lsm": DepthLSM,
    "r2n2": R2N2,
    "r2n2-pose": R2N2,
}

# Views are fused on 16^3 cells, but their features are sampled at 32^3. The recurrence's kernels are 1^3: with 3^3 it
# takes most of a step's time, and the grid network reads the neighbours.
_COMPACT: dict[str, Any] = {
    "image_size": 128,
    "grid_size": 16,
    "encoder_channels": (16, 32, 64, 96),
    "grid_channels": (48, 96),
    "feature_channels": 8,
    "feature_stride": 4,
    "lift": 2,
    "input_kernel": 1,
    "state_kernel": 1,
    "output_channels": 16,
    "grid_skip": True,
}
_TINY: dict[str, Any] = {
    "image_size": 32,
    "grid_size": 8,
    "encoder_channels": (8, 12),
    "grid_channels": (8, 12),
    "feature_channels": 8,
    "hidden_channels": 8,
    "input_kernel": 1,
    "state_kernel": 1,
    "output_channels": 8,
    "grid_skip": True,
}
_COMPACT_R2N2: dict[str, Any] = {
    "image_size": 64,
    "channels": (24, 48, 96, 128, 128),
    "shortcuts": ("none", "convolution", "convolution", "convolution", "identity"),
    "features": 256,
    "pose_features": 64,
    "hidden": 64,
    "decoder": (64, 32, 16),
    "upsample": 2,
}
_TINY_R2N2: dict[str, Any] = {
    "image_size": 32,
    "channels": (8, 12, 16, 16),
    "shortcuts": ("none", "convolution", "convolution", "identity"),
    "features": 12,
    "pose_features": 4,
    "hidden": 8,
    "decoder": (8, 8, 4),
}


def _presets(paper: Any, compact: Any, tiny: Any) -> dict[str, Any]:
    # "standard" is that of the experiments: a wider network was no better in the same time (docs/experiments).
    return {"paper": paper, "compact": compact, "standard": compact, "tiny": tiny}


PRESETS: dict[str, dict[str, Any]] = {
    "voxel-lsm": _presets(VoxelSettings(), VoxelSettings(**_COMPACT, upsample=2), VoxelSettings(**_TINY, upsample=2)),
    "depth-lsm": _presets(
        DepthSettings(),
        DepthSettings(**_COMPACT, planes=24, ray_channels=(128, 64), projection="trilinear"),
        DepthSettings(**_TINY, planes=8, ray_channels=(16, 12), projection="trilinear"),
    ),
    "r2n2": _presets(R2N2Settings(), R2N2Settings(**_COMPACT_R2N2), R2N2Settings(**_TINY_R2N2)),
    "r2n2-pose": _presets(
        R2N2Settings(pose=True),
        R2N2Settings(pose=True, **_COMPACT_R2N2),
        R2N2Settings(pose=True, **_TINY_R2N2),
    ),
}

# The released networks, layer by layer.
RELEASES: dict[str, Any] = {
    "voxel-lsm": VoxelSettings(variant="release"),
    "depth-lsm": DepthSettings(variant="release", ray_channels=(512,)),
}


def create(name: str, *, preset: str = "paper", variant: str = "paper", **overrides: Any) -> Model:
    """Build a model with random weights (from PyTorch's generator).

    Args:
        name: "voxel-lsm", "depth-lsm", "r2n2" or "r2n2-pose".
        preset: "paper" (224 pixels, 32^3 voxels), "compact" (128 pixels, 32^3 voxels, for training on a CPU core
            in half an hour), "standard" (that of the experiments, the same as compact) or "tiny" (32 pixels, 16^3
            voxels, for tests).
        variant: "paper", or "release" for the layers of the released network, of "voxel-lsm" and "depth-lsm" only.
        **overrides: settings by name in place of the preset's, see `VoxelSettings`, `DepthSettings` and `R2N2Settings`;
            of "voxel-lsm" and "depth-lsm" also an `encoder`.

    Returns:
        The model. It keeps its `settings`, and ``create(name, **settings)`` builds the same again.

    Raises:
        OptionError: an unknown name or setting, or an invalid value.

    Example:
        >>> from lsmgeo.models import create
        >>> model = create("voxel-lsm", preset="tiny", hidden_channels=4)
        >>> model.name, model.image_size, model.resolution, model.settings.hidden_channels
        ('voxel-lsm', 32, 16, 4)
        >>> sum(weights.numel() for weights in create("voxel-lsm", variant="release").parameters())
        2730113
    """
    cls = _class(name)
    check_choice("create", "preset", preset, tuple(PRESETS[name]))
    check_choice("create", "variant", variant, ("paper", "release"))
    settings = PRESETS[name][preset]
    if variant == "release":
        if preset != "paper" or name not in RELEASES:
            raise OptionError(
                f"create: variant 'release' is for {' and '.join(map(repr, RELEASES))} of preset 'paper'; "
                f"got {name!r} of {preset!r}"
            )
        settings = RELEASES[name]
    return cls(settings, **overrides)


def settings_of(model: nn.Module) -> dict[str, Any]:
    """A model's name and settings as a dictionary that JSON can hold: "name", and every setting by its name.

    Args:
        model: from `create`.

    Raises:
        DTypeError: another module.

    Example:
        >>> from lsmgeo.models import create
        >>> settings = settings_of(create("voxel-lsm", preset="tiny"))
        >>> settings["name"], settings["image_size"], settings["encoder_channels"]
        ('voxel-lsm', 32, [8, 12])
    """
    if not isinstance(model, Model):
        raise DTypeError(f"settings_of: model must be one of lsmgeo.models.create, not wrapped; got {describe(model)}")
    settings = asdict(model.settings)
    return {"name": model.name, **{key: list(v) if isinstance(v, tuple) else v for key, v in settings.items()}}


def from_settings(settings: Mapping[str, Any]) -> Model:
    """Build the model that `settings_of` described, with random weights.

    Args:
        settings: "name", and settings; missing ones are the paper's.

    Raises:
        OptionError: an unknown name or setting, or an invalid value.

    Example:
        >>> from lsmgeo.models import create
        >>> model = create("voxel-lsm", preset="tiny")
        >>> from_settings(settings_of(model)).settings == model.settings
        True
    """
    if not isinstance(settings, Mapping) or "name" not in settings:
        raise OptionError(f"from_settings: settings must have a 'name'; got {describe(settings)}")
    return _class(settings["name"])(**{key: value for key, value in settings.items() if key != "name"})


def _class(name: object) -> type[Model]:
    if not isinstance(name, str) or name not in MODELS:
        raise OptionError(
            f"create: name must be one of the models; got {describe(name)}{suggestion(name, list(MODELS))}"
        )
    return MODELS[name]
