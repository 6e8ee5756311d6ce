"""Models by name: from a preset, and from the settings that a model keeps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from difflib import get_close_matches
from typing import Any

from torch import nn

from lsmgeo._checks import check_choice, describe
from lsmgeo.errors import DTypeError, OptionError
from lsmgeo.models.depth_lsm import DepthLSM
from lsmgeo.models.model import Model
from lsmgeo.models.presets import PRESETS, RELEASES
from lsmgeo.models.r2n2 import R2N2
from lsmgeo.models.settings import VARIANTS
from lsmgeo.models.voxel_lsm import VoxelLSM

__all__ = ["MODELS", "create", "from_settings", "settings_of"]

MODELS: dict[str, type[Model]] = {
    "voxel-lsm": VoxelLSM,
    "depth-lsm": DepthLSM,
    "r2n2": R2N2,
    "r2n2-pose": R2N2,
}


def create(name: str, *, preset: str = "paper", variant: str = "paper", **overrides: Any) -> Model:
    """Build a model with weights that start at random (from PyTorch's generator).

    Args:
        name: "voxel-lsm", "depth-lsm", "r2n2" or "r2n2-pose".
        preset: "paper" (224 pixels, 32^3 voxels), "compact" (128 pixels, 32^3 voxels, made for training on a CPU
            core in half an hour), "standard" (what the experiments use, which is compact) or "tiny" (32 pixels, 16^3
            voxels, made for tests).
        variant: "paper", or "release" for the layers of the released network, of "voxel-lsm" and "depth-lsm" alone.
        **overrides: settings by name in place of the preset's, see `VoxelSettings`, `DepthSettings` and `R2N2Settings`.

    Returns:
        The model. It keeps its `settings`, and ``create(name, **settings)`` builds the same again.

    Raises:
        OptionError: an unknown name or setting, or an impossible value.

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
    check_choice("create", "variant", variant, VARIANTS)
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
    """A model's name and settings as a dictionary that JSON can hold.

    Args:
        model: from `create`.

    Returns:
        "name", and every setting by its name.

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
    """Build the model that `settings_of` described, with weights that start at random.

    Args:
        settings: "name", and settings; those that are missing are the paper's.

    Returns:
        The model.

    Raises:
        OptionError: an unknown name or setting, or an impossible value.

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
        close = get_close_matches(name, MODELS, 1) if isinstance(name, str) else []
        hint = f" (is {close[0]!r} meant?)" if close else ""
        raise OptionError(f"create: name must be one of {', '.join(map(repr, MODELS))}; got {describe(name)}{hint}")
    return MODELS[name]
