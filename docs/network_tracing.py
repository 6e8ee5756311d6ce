"""The stages of a model, traced on two views, for the drawings and tables of the model pages.

Forward hooks tell the order of the stages, their shapes and parameters; `torch.cat` is watched to tell which stages
read which others, so that skip connections are found and not written down.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from lsmgeo.cameras import orbit
from lsmgeo.layers import PlaneSweepProject, Unproject
from lsmgeo.models import create
from lsmgeo.models.blocks import Block, Convolution, InstanceNorm
from lsmgeo.models.voxel_lsm import GridUNet, ImageEncoder
from lsmgeo.rays import ProjectReduce

VIEWS = 2
# Modules that only hold stages.
HOLDERS = (nn.ModuleList, nn.Sequential, ImageEncoder, GridUNet)


@dataclass
class Stage:
    """One part of a model.

    Attributes:
        name: dotted, of its module; "images" for the input.
        what: its operation, in words.
        shape: of one scene's, or one view's, output: (C, D, H, W), (C, H, W) or (C,).
        parameters: their number.
        sources: the stages that it reads, the preceding one first.
    """

    name: str
    what: str
    shape: tuple[int, ...]
    parameters: int
    sources: list[str] = field(default_factory=list)

    @property
    def part(self) -> str:
        """The model's attribute to which it belongs."""
        return self.name.partition(".")[0]


class _Joins(TorchFunctionMode):
    """Which tensors were joined into which."""

    def __init__(self) -> None:
        super().__init__()
        self.parts: dict[int, list[Tensor]] = {}

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        made = function(*args, **(kwargs or {}))
        if function is torch.cat:
            self.parts[_place(made)] = list(args[0] if args else kwargs["tensors"])
        elif getattr(function, "__name__", "") == "leaky_relu":
            self.parts[_place(made)] = [args[0]]
        return made


def _place(tensor: Tensor) -> int:
    """The address of its values: the same for views of a tensor."""
    return tensor.untyped_storage().data_ptr()


def stages_of(model: nn.Module) -> list[tuple[str, nn.Module]]:
    """Every stage of a model by its dotted name; containers are replaced by their stages."""

    def walk(module: nn.Module, prefix: str) -> Any:
        for name, child in module.named_children():
            if isinstance(child, HOLDERS):
                yield from walk(child, f"{prefix}{name}.")
            elif not isinstance(child, nn.LeakyReLU):
                yield f"{prefix}{name}", child

    return list(walk(model, ""))


def trace(model: nn.Module) -> list[Stage]:
    """Run a model on two random images and return its stages in the order in which they ran.

    Args:
        model: from `lsmgeo.models.create`.
    """
    size = model.image_size
    cameras = orbit(torch.tensor([[0.0, 60.0]]), 20.0, 2.0, focal_length=1.875 * size, height=size, width=size)
    images = torch.rand(1, VIEWS, 3, size, size, generator=torch.Generator().manual_seed(0))
    found = [Stage("images", f"{size} x {size} pixels", (3, size, size), 0)]
    made = {_place(images): "images"}
    kept: list[Tensor] = [images]  # nothing may be freed: another tensor would get its address
    joins = _Joins()

    def sources_of(tensor: Tensor) -> list[str]:
        place = _place(tensor)
        if place in made:
            return [made[place]]
        return [name for part in joins.parts.get(place, ()) for name in sources_of(part)]

    def ran(name: str, module: nn.Module, given: Tensor, output: Any) -> None:
        values = output[0] if isinstance(output, tuple) else output
        if not sources_of(given):
            if name == "rotation.0":
                found.append(Stage("cameras", "the rotation as a quaternion", _shape(module, given), 0))
            made[_place(given)] = found[-1].name  # a copy of the preceding stage's output
        sources = list(dict.fromkeys(sources_of(given)))
        parameters = sum(weight.numel() for weight in module.parameters())
        found.append(Stage(name, describe(module), _shape(module, values), parameters, sources))
        made[_place(values)] = name
        kept.extend((given, values))

    def hook(name: str, module: nn.Module) -> Callable[..., None]:
        return lambda _, given, output: ran(name, module, given[0], output)

    handles = []
    for name, module in stages_of(model):
        if hasattr(module, "states"):  # called in place of `forward`
            module.states = _watched(module, functools.partial(ran, name, module))
        else:
            handles.append(module.register_forward_hook(hook(name, module)))
    try:
        with torch.no_grad(), joins:
            predicted = model.eval()(images, cameras, steps="last")[0]
    finally:
        for handle in handles:
            handle.remove()
        for _, module in stages_of(model):
            vars(module).pop("states", None)
    if predicted.shape[-1] != found[-1].shape[-1]:
        shape = (1, *predicted.shape[2:])
        found.append(Stage("occupancy", "channels side by side as voxels", shape, 0, [found[-1].name]))
    return found


def _watched(module: nn.Module, ran: Callable[[Tensor, Tensor], None]) -> Callable[..., Tensor]:
    states = module.states

    def watched(volume: Tensor, *rest: Any) -> Tensor:
        found = states(volume, *rest)
        ran(volume, found)
        return found

    return watched


def _shape(module: nn.Module, values: Tensor) -> tuple[int, ...]:
    """The shape for one scene and view, without the axes before the channels."""
    if isinstance(module, Unproject) or hasattr(module, "hidden_channels") or type(module).__name__ == "_Recurrence":
        return tuple(values.shape[2:])
    if isinstance(module, PlaneSweepProject):
        return tuple(values.flatten(2, 3).shape[2:]) if values.dim() == 6 else tuple(values.shape[2:])
    if isinstance(module, ProjectReduce):
        return tuple(values.shape[2:])
    if isinstance(module, nn.Linear):
        return tuple(values.shape[-1:])
    shape = tuple(values.shape[1:])
    return (1, *shape) if len(shape) == 3 and type(module).__name__ == "_LastBlock" else shape


def describe(module: nn.Module) -> str:
    """The operation of a stage, in a few words."""
    if isinstance(module, Block):
        words = [_kernel(module.convolution)]
        words += [] if isinstance(module.norm, nn.Identity) else ["norm"]
        return ("ReLU, " if module.activate else "") + ", ".join(words)
    if isinstance(module, Convolution):
        return _kernel(module)
    if isinstance(module, InstanceNorm):
        return "norm"
    if isinstance(module, nn.Linear):
        return "fully connected"
    words = {
        "Unproject": "features into the grid, with depth and ray direction",
        "PlaneSweepProject": "the grid onto planes of depth, stacked as channels",
        "ProjectReduce": "the grid onto planes of depth, with depth and ray direction, and 1x1 convolution in one",
        "ConvGRU3d": f"GRU of {_sides(module)} convolutions, view after view",
        "ConvLSTM3d": f"LSTM of {_sides(module)} convolutions, view after view",
        "_Recurrence": "GRU of 3x3x3 convolutions, view after view",
        "_Separable": "ReLU, 3x3 convolution of each channel, 1x1 convolution, norm",
        "_Upsample": "ReLU, 4x4 transposed convolution, stride 2, norm",
        "_ImageBlock": "two convolutions, shortcut, maximum over 2x2",
        "_GridBlock": "doubled, two 3x3x3 convolutions, shortcut",
        "_LastBlock": "four 3x3x3 convolutions, shortcut; two classes, as one logit",
    }[type(module).__name__]
    if type(module).__name__ == "_ImageBlock":
        has_shortcut = module.is_residual or module.shortcut is not None
        words = words if has_shortcut else words.replace(" shortcut,", "")
    if type(module).__name__ == "Unproject" and "direction" not in str(module.augment):
        words = "features into the grid, with depth" if module.augment else "features into a finer grid"
    if getattr(module, "is_release", False):
        words = "twice the size by nearest neighbours, ReLU, 3x3 convolution, norm"
    return words


def _sides(module: nn.Module) -> str:
    """The kernels of a recurrence."""
    sizes = {getattr(module, name, 3) for name in ("kernel_size", "state_kernel_size")}
    return " and ".join(f"{size}x{size}x{size}" for size in sorted(sizes))


def _kernel(convolution: Convolution) -> str:
    kernel = "x".join(map(str, convolution.weight.shape[2:]))
    words = f"{kernel} {'transposed ' if convolution.transposed else ''}convolution"
    return words + (f", stride {convolution.stride}" if convolution.stride > 1 else "")


@functools.cache
def traced(name: str, preset: str = "paper", variant: str = "paper") -> tuple[Stage, ...]:
    """The stages of a model by its name, see `lsmgeo.models.create`."""
    torch.manual_seed(0)
    return tuple(trace(create(name, preset=preset, variant=variant)))
