"""The models of one evaluation, what they are called, and how they were trained."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from lsmgeo.cameras import to
from lsmgeo.cameras.tensors import CameraTensors
from lsmgeo.data.shards.shape_transforms import resize_views
from lsmgeo.errors import OptionError
from lsmgeo.scenes.synthetic13 import CLASS_SPLITS

__all__ = ["Contender", "Training", "open_contenders", "shared"]

TITLES = {"voxel-lsm": "V-LSM", "depth-lsm": "D-LSM", "r2n2": "3D-R2N2", "r2n2-pose": "3D-R2N2 w/pose"}


@dataclass(frozen=True)
class Training:
    """What a model was trained on, as far as reports depend on it.

    Attributes:
        categories: "all", "first" or "second", or names.
        background: behind the objects.
        pose_noise: largest angle by which cameras were turned, degrees.
    """

    categories: str | tuple[str, ...] = "all"
    background: str = "white"
    pose_noise: float = 0.0

    @property
    def seen(self) -> frozenset[str] | None:
        """The categories that it has seen; None for all."""
        if isinstance(self.categories, str):
            return None if self.categories == "all" else frozenset(CLASS_SPLITS[self.categories])
        return frozenset(self.categories)

    @property
    def words(self) -> str:
        """What is unusual about it, to stand behind a name."""
        named = isinstance(self.categories, str)
        parts = [
            "" if self.categories == "all" else f"on {self.categories if named else ', '.join(self.categories)}",
            "" if self.background == "white" else "w/bg",
            f"noise {self.pose_noise:g}" if self.pose_noise else "",
        ]
        return " ".join(filter(None, parts))


@dataclass(frozen=True, eq=False)
class Contender:
    """One model of an evaluation.

    Attributes:
        name: what tables call it.
        model: with the methods and attributes that `lsmgeo.models` promises.
        training: what it was trained on.
        path: where it was read from.
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
        """What the paper calls its network."""
        return TITLES.get(self.kind, self.kind)

    @property
    def size(self) -> int:
        """Height and width of the pictures that it takes."""
        return int(self.model.image_size)  # type: ignore[arg-type]

    @property
    def resolution(self) -> int:
        """Voxels a side of what it gives."""
        return int(self.model.resolution)  # type: ignore[arg-type]

    @property
    def has_depth(self) -> bool:
        """Whether it predicts depth, not voxels."""
        return bool(self.model.output == "depth")

    def occupancies(self, images: Tensor, cameras: CameraTensors, *, every: bool = True) -> Tensor:
        """Probabilities after every view, (B, V, D, H, W) on the CPU, or after the last, (B, D, H, W).

        Args:
            images: (B, V, 3, H, W) of any size.
            cameras: leading shape (B, V).
            every: whether after every view.
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


def open_contenders(checkpoints: str, device: str | torch.device = "cpu") -> list[Contender]:
    """Read the models of an evaluation.

    Args:
        checkpoints: files of weights, checkpoints or run folders with commas between, each as PATH or NAME=PATH. By
            default a model is called what it is, with what is unusual in its training.
        device: where they shall work.

    Returns:
        Models in evaluation mode.

    Raises:
        OptionError: nothing is named, or two models are named alike.
        CheckpointError: a model cannot be read.
    """
    from lsmgeo.models.weights import load

    found: list[Contender] = []
    for item in filter(None, (part.strip() for part in checkpoints.split(","))):
        match = re.fullmatch(r"([^=/\\]+)=(.+)", item)
        path = Path(match[2] if match else item)
        model = load(path).to(device).eval()
        training = read_training(model.about)
        plain = f"{TITLES.get(str(model.name), str(model.name))} {training.words}".strip()
        found.append(Contender(match[1].strip() if match else plain, model, training, str(path)))
    if not found:
        raise OptionError(f"evaluate: checkpoints must name a model at least; got {checkpoints!r}")
    names = [contender.name for contender in found]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise OptionError(f"evaluate: models must be named apart, as NAME=PATH; two are called {twice[0]!r}")
    return found


def read_training(about: Mapping[str, Any]) -> Training:
    """How a model was trained.

    Args:
        about: the notes that its file holds, of which ``training`` is the configuration of the run.

    Returns:
        The usual training where they do not say.
    """
    training = about.get("training")
    data = training.get("data") if isinstance(training, Mapping) else None
    if not isinstance(data, Mapping):
        return Training()
    categories = data.get("categories", "all")
    if categories != "all" and not (isinstance(categories, str) and categories in CLASS_SPLITS):
        categories = (categories,) if isinstance(categories, str) else tuple(map(str, categories))
    background = data.get("background", "white")
    return Training(
        categories,
        background if isinstance(background, str) else "colour",
        float(data.get("pose_noise", 0.0)),
    )


def shared(contenders: Sequence[Contender], attribute: str) -> int:
    """The ``resolution``, or the ``size``, that all models have.

    Raises:
        OptionError: they differ.
    """
    found: dict[str, int] = {contender.name: getattr(contender, attribute) for contender in contenders}
    if len(set(found.values())) != 1:
        words = {"resolution": "resolution of voxels", "size": "size of pictures"}[attribute]
        raise OptionError(f"evaluate: models must have one {words}; got {found}")
    return next(iter(found.values()))
