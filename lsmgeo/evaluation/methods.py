"""The methods under test, how they were trained, and the options of an evaluation."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from lsmgeo._checks import check_number, check_whole
from lsmgeo.cameras import to
from lsmgeo.cameras.tensors import CameraTensors
from lsmgeo.data.shards.background_sources import Background
from lsmgeo.data.shards.shape_transforms import resize_views
from lsmgeo.errors import OptionError
from lsmgeo.scenes.synthetic13 import CLASS_SPLITS

__all__ = ["Method", "Options", "Training", "open_methods", "shared"]

TITLES = {"voxel-lsm": "V-LSM", "depth-lsm": "D-LSM", "r2n2": "3D-R2N2", "r2n2-pose": "3D-R2N2 w/pose"}


@dataclass(frozen=True, kw_only=True)
class Options:
    """How reports measure; each report uses the options that concern it.

    Attributes:
        views: the largest number of views; None for as many as the paper has.
        threshold: of probabilities, for IoU.
        batch: shapes at a time.
        seed: of the orders of views and of the noise in poses.
        background: for "backgrounds": "random", a folder of images or a colour.
        degrees: for "pose-noise", the largest angles by which cameras are rotated.
        orders: for "order", the number of orders of the views.
        planes: for "depth" and "clouds", the number of planes of the plane sweep.
        window: side of its patches in pixels.
        progress: whether to show progress bars (on a terminal).
    """

    views: int | None = None
    threshold: float = 0.4
    batch: int = 4
    seed: int = 0
    background: Background = "random"
    degrees: tuple[float, ...] = (0.0, 5.0, 10.0, 15.0, 20.0)
    orders: int = 8
    planes: int = 300
    window: int = 5
    progress: bool = False

    def __post_init__(self) -> None:
        if self.views is not None:
            check_whole("evaluate", "views", self.views, 1, 1000)
        check_number("evaluate", "threshold", self.threshold, "a number")
        for name, least in (("batch", 1), ("seed", 0), ("orders", 2), ("planes", 3), ("window", 1)):
            check_whole("evaluate", name, getattr(self, name), least, 2**32 - 1)
        if not [check_number("evaluate", "degrees", angle, "from 0 to 180", 0, 180) for angle in self.degrees]:
            raise OptionError("evaluate: degrees must be from 0 to 180; got none")


@dataclass(frozen=True)
class Training:
    """The training data of a model, as far as reports depend on it.

    Attributes:
        categories: "all", "first" or "second", or names.
        background: behind the objects.
        pose_noise: largest angle by which cameras were rotated, degrees.
    """

    categories: str | tuple[str, ...] = "all"
    background: str = "white"
    pose_noise: float = 0.0

    @property
    def seen(self) -> frozenset[str] | None:
        """The categories that it was trained on; None for all."""
        if isinstance(self.categories, str):
            return None if self.categories == "all" else frozenset(CLASS_SPLITS[self.categories])
        return frozenset(self.categories)

    @property
    def words(self) -> str:
        """How it differs from the usual training, to follow a name."""
        named = isinstance(self.categories, str)
        parts = [
            "" if self.categories == "all" else f"on {self.categories if named else ', '.join(self.categories)}",
            "" if self.background == "white" else "w/bg",
            f"noise {self.pose_noise:g}" if self.pose_noise else "",
        ]
        return " ".join(filter(None, parts))


@dataclass(frozen=True, eq=False)
class Method:
    """A model under test.

    Attributes:
        name: its name in tables.
        model: a network with the methods and attributes that `lsmgeo.models` documents.
        training: its training data.
        path: the file or folder that it was read from.
    """

    name: str
    model: nn.Module
    training: Training = Training()
    path: str = ""

    @property
    def kind(self) -> str:
        """The name of its network."""
        return str(self.model.name)

    @property
    def title(self) -> str:
        """The name of its network in the paper."""
        return TITLES.get(self.kind, self.kind)

    @property
    def size(self) -> int:
        """Height and width of its input images."""
        return int(self.model.image_size)  # type: ignore[arg-type]

    @property
    def resolution(self) -> int:
        """Voxels along a side of its output."""
        return int(self.model.resolution)  # type: ignore[arg-type]

    @property
    def has_depth(self) -> bool:
        """Whether it predicts depth; if not, voxels."""
        return bool(self.model.output == "depth")

    def occupancies(self, images: Tensor, cameras: CameraTensors, *, every: bool = True) -> Tensor:
        """Probabilities after every view, (B, V, D, H, W) on the CPU, or after the last, (B, D, H, W).

        Args:
            images: (B, V, 3, H, W) of any size.
            cameras: leading shape (B, V).
            every: whether to return all of them, not only the last.
        """
        result = self._run(images, cameras, by_view=every)
        found: Tensor = result.by_view if every else result.occupancy
        return found.float().cpu()

    def depths(self, images: Tensor, cameras: CameraTensors) -> Tensor:
        """Depth of every view (B, V, H, W) on the CPU.

        Args:
            images: (B, V, 3, H, W) of any size.
            cameras: leading shape (B, V).
        """
        found: Tensor = self._run(images, cameras).depth
        return found.float().cpu()

    def _run(self, images: Tensor, cameras: CameraTensors, **options: Any) -> Any:
        images, cameras = resize_views(images, cameras, self.size)
        device = next(self.model.parameters(), torch.zeros(())).device
        return self.model.run(images.to(device), to(cameras, device), **options)  # type: ignore[operator]


def open_methods(checkpoints: str, device: str | torch.device = "cpu") -> list[Method]:
    """Read the models of an evaluation.

    Args:
        checkpoints: weights, checkpoints or run folders, separated by commas, each as PATH or NAME=PATH. The default
            name is that of the network and of what is unusual in its training.
        device: the device that they run on.

    Returns:
        Models in evaluation mode.

    Raises:
        OptionError: no model is given, or two models have the same name.
        CheckpointError: a model cannot be read.
    """
    from lsmgeo.models.weights import load

    found: list[Method] = []
    for item in filter(None, (part.strip() for part in checkpoints.split(","))):
        match = re.fullmatch(r"([^=/\\]+)=(.+)", item)
        path = Path(match[2] if match else item)
        model = load(path).to(device).eval()
        training = read_training(model.about)
        plain = f"{TITLES.get(str(model.name), str(model.name))} {training.words}".strip()
        found.append(Method(match[1].strip() if match else plain, model, training, str(path)))
    if not found:
        raise OptionError(f"evaluate: checkpoints must name at least one model; got {checkpoints!r}")
    names = [method.name for method in found]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise OptionError(f"evaluate: models must have different names, as NAME=PATH; two are called {twice[0]!r}")
    return found


def read_training(about: Mapping[str, Any]) -> Training:
    """How a model was trained, from the notes in its file; the usual training if they do not say."""
    training = about.get("training")
    data = training.get("data") if isinstance(training, Mapping) else None
    if not isinstance(data, Mapping):
        return Training()
    categories = data.get("categories", "all")
    if categories != "all" and not (isinstance(categories, str) and categories in CLASS_SPLITS):
        categories = (categories,) if isinstance(categories, str) else tuple(map(str, categories))
    background = data.get("background", "white")
    background = background if isinstance(background, str) else "colour"
    return Training(categories, background, float(data.get("pose_noise", 0.0)))


def shared(methods: Sequence[Method], attribute: str) -> int:
    """The ``resolution`` or ``size`` of all models.

    Raises:
        OptionError: they differ.
    """
    found: dict[str, int] = {method.name: getattr(method, attribute) for method in methods}
    if len(set(found.values())) != 1:
        words = {"resolution": "resolution of voxels", "size": "size of images"}[attribute]
        raise OptionError(f"evaluate: models must have the same {words}; got {found}")
    return next(iter(found.values()))
