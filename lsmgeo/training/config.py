"""The configuration of a training run: four groups of settings, from a TOML or JSON file and from ``key=value``."""

from __future__ import annotations

import json
import math
import os
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from lsmgeo._checks import describe
from lsmgeo.data.read_files import read_text
from lsmgeo.errors import DataError, OptionError
from lsmgeo.models.settings import check_settings, suggestion

__all__ = ["DataConfig", "ModelConfig", "OptimiserConfig", "RunConfig", "TrainingConfig", "make_config", "read_config"]

MAX_BYTES = 1 << 20
WHOLE = (1, 2**63 - 1)
SHARE = (0, 1)


@dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """The network, see `lsmgeo.models.create`.

    Attributes:
        name: "voxel-lsm", "depth-lsm", "r2n2" or "r2n2-pose".
        preset: "paper", "compact", "standard" or "tiny".
        variant: "paper" or "release".
        settings: that differ from the preset's, by name.
        weights: a file of weights to start from (`lsmgeo.models.load`), of a model with the same settings, or None.
    """

    name: str = "voxel-lsm"
    preset: str = "compact"
    variant: str = "paper"
    settings: Mapping[str, Any] = field(default_factory=dict)
    weights: str | None = None

    def __post_init__(self) -> None:
        check_settings("model", self)


@dataclass(frozen=True, kw_only=True)
class DataConfig:
    """The training data.

    Attributes:
        source: a folder of shards (``lsmgeo render``, ``lsmgeo convert``), or "synthetic-13", which is rendered during
            training, on the device that trains.
        shapes: of synthetic-13, the number of shapes in the set, before it is split.
        set_seed: of synthetic-13, which set.
        pool: of synthetic-13, the number of different views that a shape has.
        views: how many views of a shape the model reads, in random order; (low, high) for a random number of them.
        background: "white", an RGB colour in [0, 1], "random", or a folder of images.
        categories: "all", "first" or "second" (the halves of the experiment with unseen classes), or names.
        split: the split of the set for training.
        validation_split: the split for evaluation.
        validation_categories: as `categories`; None for the same.
        limit: the largest number of shapes of each split; None for all.
        pose_noise: largest random rotation of the cameras about the object, in degrees, in training only.
        workers: processes that prefetch; 0 reads in the training loop.
        on_error: "raise" where a shape cannot be read, or "skip" it, see `lsmgeo.data.ShapeDataset`.
        max_bad_fraction: the largest share of skipped shapes.
    """

    source: str = "synthetic-13"
    shapes: int = 5200
    set_seed: int = 0
    pool: int = 20
    views: int | tuple[int, int] = 4
    background: str | tuple[float, float, float] = "white"
    categories: str | tuple[str, ...] = "all"
    split: str = "train"
    validation_split: str = "val"
    validation_categories: str | tuple[str, ...] | None = None
    limit: int | None = None
    pose_noise: float = 0.0
    workers: int = 1
    on_error: Literal["raise", "skip"] = "raise"
    max_bad_fraction: float = 0.001

    def __post_init__(self) -> None:
        seeds = (0, 2**32 - 1)
        limits = {"set_seed": seeds, "workers": seeds, "background": SHARE, "max_bad_fraction": SHARE}
        check_settings("data", self, (1, 2**32 - 1), pose_noise=(0, 180), **limits)
        low, high = self.view_range
        if not low <= high:
            raise OptionError(f"data: views must be a number or [low, high], low <= high; got {self.views!r}")
        if self.source == "synthetic-13" and high > self.pool:
            raise OptionError(f"data: views must be at most data.pool = {self.pool}; got {self.views!r}")

    @property
    def view_range(self) -> tuple[int, int]:
        """The least and the largest number of views."""
        return self.views if isinstance(self.views, tuple) else (self.views, self.views)


@dataclass(frozen=True, kw_only=True)
class OptimiserConfig:
    """Adam and its learning rate.

    Attributes:
        learning_rate: of Adam.
        betas: of Adam.
        weight_decay: of AdamW; 0 is Adam.
        schedule: "constant", or "cosine", down to 0 at ``run.steps``.
        warm_up: steps over which the learning rate grows linearly.
        clip_norm: gradients of a larger norm are scaled down to it; None for no clipping.
    """

    learning_rate: float = 1e-3
    betas: tuple[float, float] = (0.9, 0.999)
    weight_decay: float = 0.0
    schedule: Literal["constant", "cosine"] = "constant"
    warm_up: int = 0
    clip_norm: float | None = None

    def __post_init__(self) -> None:
        check_settings("optimiser", self, warm_up=(0, 2**63 - 1), weight_decay=(0, math.inf), betas=SHARE)
        if max(self.betas) == 1:
            raise OptionError(f"optimiser: betas must be two numbers in [0, 1); got {self.betas!r}")


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """How long and how to train, and what to keep.

    Attributes:
        steps: the number of steps; None for no limit.
        minutes: the largest training time, over all resumes; None for no limit.
        cpu_minutes: where `steps` is None, the CPU time of the process, evaluations included. The first 30 steps are
            timed, and `steps` is computed once, for ``config.json``, the schedule and every resumption. A cosine begins
            after these 30. The time of workers is not counted.
        seed: of the weights, of the order of the shapes and of their views.
        batch: shapes per batch and process.
        accumulation: batches per step: a step takes batch x accumulation x processes shapes.
        device: "auto" is a GPU where there is one; or "cpu".
        precision: "no", "bf16" or "fp16": of mixed precision (weights stay float32). "auto" is bf16 where the hardware
            multiplies it faster (GPUs with bf16, CPUs with AMX), chosen once for the run.
        channels_last: whether feature maps are channels-last in memory; None to choose the faster for the network.
        loss: of voxels: "bce", the paper's cross-entropy, or "bce+iou", see `lsmgeo.models.compute_loss`.
        loss_views: the loss is computed after "every" view, after a "random" one (later views are not read, and have
            no loss of depth), or only after the "last".
        region: of depth, the pixels of the loss: the "object", or "all" with the background far away.
        evaluate_every: steps between evaluations; the last step is always evaluated.
        evaluate_shapes: number of shapes of the validation split, always the same.
        evaluate_views: number of views of each, always the same; None for the largest number in training.
        pictures: how many of these shapes are drawn after each evaluation.
        checkpoint_every: steps between checkpoints; the last step is always saved.
        keep: number of checkpoints kept besides the best.
        log_every: steps between lines of the log.
        tensorboard: whether to write TensorBoard files too.
        max_bad_steps: the run stops after this many steps in a row whose loss or gradient is not finite.
        max_bad_fraction: the run stops where such steps are more than this share of all.
    """

    steps: int | None = None
    minutes: float | None = None
    cpu_minutes: float | None = None
    seed: int = 0
    batch: int = 4
    accumulation: int = 1
    device: Literal["auto", "cpu"] = "auto"
    precision: Literal["auto", "no", "bf16", "fp16"] = "no"
    channels_last: bool | None = None
    loss: Literal["bce", "bce+iou"] = "bce"
    loss_views: Literal["every", "random", "last"] = "every"
    region: Literal["object", "all"] = "object"
    evaluate_every: int = 500
    evaluate_shapes: int = 52
    evaluate_views: int | None = None
    pictures: int = 4
    checkpoint_every: int = 500
    keep: int = 3
    log_every: int = 10
    tensorboard: bool = True
    max_bad_steps: int = 3
    max_bad_fraction: float = 0.001

    def __post_init__(self) -> None:
        check_settings("run", self, WHOLE, seed=(0, 2**63 - 1), pictures=(0, 2**63 - 1), max_bad_fraction=SHARE)
        if self.steps is None and self.minutes is None and self.cpu_minutes is None:
            raise OptionError("run: steps, minutes or cpu_minutes must say when the run ends; got none")


# Settings that a resumed run may change: none affects the result of a step.
FREE = (
    *("data.source", "data.workers", "data.on_error", "data.max_bad_fraction", "model.weights"),
    *("run.steps", "run.minutes", "run.device", "run.evaluate_every", "run.evaluate_shapes", "run.evaluate_views"),
    *("run.pictures", "run.checkpoint_every", "run.keep", "run.log_every", "run.tensorboard", "run.max_bad_steps"),
    "run.max_bad_fraction",
)


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """All settings of a run; equal settings on one computer give equal weights.

    Attributes:
        model: the network.
        data: the training data.
        optimiser: Adam and its learning rate.
        run: how long and how to train, and what to keep.

    Example:
        >>> config = TrainingConfig(model=ModelConfig(preset="tiny"), run=RunConfig(steps=100))
        >>> config.optimiser.learning_rate, config.data.views
        (0.001, 4)
    """

    model: ModelConfig = field(default_factory=ModelConfig)
    data: DataConfig = field(default_factory=DataConfig)
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)
    run: RunConfig

    def __post_init__(self) -> None:
        low, high = self.data.view_range
        if self.run.loss_views == "random" and low != high:
            raise OptionError(
                "run: loss_views must be 'every' or 'last' where numbers of views differ; "
                f"got 'random' with data.views = {self.data.views!r}"
            )
        if self.optimiser.schedule == "cosine" and self.run.steps is None and self.run.cpu_minutes is None:
            raise OptionError(
                "run: steps or cpu_minutes must be given with optimiser.schedule = 'cosine', which ends there"
            )

    def to_dict(self) -> dict[str, Any]:
        """The settings in types that JSON has."""
        return json.loads(json.dumps(asdict(self)))

    def free(self) -> tuple[str, ...]:
        """The settings that may change when a run is resumed, by their dotted names."""
        # A cosine's learning rate depends on the number of steps.
        is_fixed = self.optimiser.schedule == "cosine"
        return tuple(name for name in FREE if not (is_fixed and name == "run.steps"))


GROUPS = {"model": ModelConfig, "data": DataConfig, "optimiser": OptimiserConfig, "run": RunConfig}


def make_config(values: Mapping[str, Any]) -> TrainingConfig:
    """A configuration from nested mappings, as TOML and JSON give them.

    Args:
        values: groups "model", "data", "optimiser", "run", each a mapping; missing values take their defaults.

    Raises:
        OptionError: an unknown key, with the nearest known one; a value of the wrong kind or out of range.

    Example:
        >>> make_config({"run": {"stepz": 100}})
        Traceback (most recent call last):
        lsmgeo.errors.OptionError: there is no run.stepz; did you mean run.steps?
    """
    if not isinstance(values, Mapping):
        raise OptionError(f"a configuration must be a table of groups; got {describe(values)}")
    known = [f"{group}.{item.name}" for group, form in GROUPS.items() for item in fields(form)]
    groups = {}
    # A run without settings says that steps or minutes are missing.
    for group, content in {"run": {}, **values}.items():
        if group not in GROUPS:
            raise OptionError(f"there is no group {group!r}{_nearest(group, [*GROUPS, *known])}")
        if not isinstance(content, Mapping):
            raise OptionError(f"{group} must be a table of settings; got {describe(content)}")
        for key in content:
            if f"{group}.{key}" not in known:
                raise OptionError(f"there is no {group}.{key}{_nearest(f'{group}.{key}', known)}")
        groups[group] = GROUPS[group](**content)
    return TrainingConfig(**groups)


def read_config(path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> TrainingConfig:
    """Read the configuration of a run.

    Args:
        path: a TOML or JSON file with the tables model, data, optimiser and run.
        overrides: settings in place of the file's, such as "run.steps=100" or "data.views=[1,4]"; "none" for None.

    Raises:
        DataError: the file cannot be read, or is not a configuration.
        OptionError: an invalid override.
    """
    path = Path(path)
    text = read_text(path, MAX_BYTES)
    try:
        values = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
        if not overrides or not isinstance(values, Mapping):
            return make_config(values)
    except (ValueError, RecursionError) as error:  # OptionError is one
        raise DataError(path, str(error)) from error
    changed = {group: dict(content) if isinstance(content, Mapping) else content for group, content in values.items()}
    for override in overrides:
        key, equals, text = override.partition("=")
        group, dot, name = key.strip().partition(".")
        if not equals or not dot:
            raise OptionError(f"an override must be group.key=value, such as run.steps=100; got {override!r}")
        table = changed.setdefault(group, {})
        if name.startswith("settings.") and group == "model" and isinstance(table, dict):
            table["settings"] = table = dict(table.get("settings", {}))
            name = name.removeprefix("settings.")
        if isinstance(table, dict):
            table[name] = _parsed(text.strip())
    try:
        return make_config(changed)
    except OptionError as error:
        raise OptionError(f"{path} with {', '.join(overrides)}: {error}") from error


def _parsed(text: str) -> Any:
    """A TOML value; anything else is text."""
    if text.lower() == "none":
        return None
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (tomllib.TOMLDecodeError, KeyError):
        return text


def _nearest(key: str, known: Sequence[str]) -> str:
    # The right name in the wrong group takes precedence over a similar one in the right group.
    near = [name for name in known if "." in key and name.rpartition(".")[2] == key.rpartition(".")[2]]
    return f"; did you mean {near[0]}?" if near else suggestion(key, known)
