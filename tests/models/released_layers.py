"""The released network's layers written out, with every padding as a number: shares no code with the library.

Weights come by their names in the library's state, biases of norms are shifts.
"""

from __future__ import annotations

from torch import Tensor, cat
from torch.nn.functional import conv2d, conv3d, conv_transpose2d, conv_transpose3d, interpolate, pad, relu

State = dict[str, Tensor]


def norm(x: Tensor, shift: Tensor) -> Tensor:
    axes = tuple(range(2, x.dim()))
    centred = x - x.mean(axes, keepdim=True)
    return centred / (centred.square().mean(axes, keepdim=True) + 1e-5).sqrt() + shift.reshape(-1, *(1,) * len(axes))


def encode(images: Tensor, state: State) -> tuple[Tensor, list[Tensor]]:
    def named(name: str) -> tuple[Tensor, Tensor]:
        prefix = f"image_encoder.{name}"
        return state[f"{prefix}.convolution.weight"], state[f"{prefix}.norm.bias"]

    def down(x: Tensor, name: str, after: int) -> Tensor:
        weight, shift = named(name)
        before = 1 if after == 2 else 0
        return norm(conv2d(pad(x, (before, after, before, after)), weight, stride=2), shift)

    def up(x: Tensor, name: str) -> Tensor:
        weight, shift = named(name)
        return norm(conv_transpose2d(relu(x), weight, stride=2)[..., :-1, :-1], shift)

    c1 = down(images, "down.0", 2)
    c2 = down(relu(c1), "down.1", 1)
    c3 = down(relu(c2), "down.2", 1)
    c4 = down(relu(c3), "down.3", 1)
    d1 = cat((up(c4, "up.0"), c3), 1)
    d2 = cat((up(d1, "up.1"), c2), 1)
    d3 = cat((up(d2, "up.2"), c1), 1)
    weight, bias = state["image_encoder.out.convolution.weight"], state["image_encoder.out.convolution.bias"]
    return conv_transpose2d(relu(d3), weight, bias, padding=2), [c1, c2, c3, c4]


def reason(grid: Tensor, state: State) -> Tensor:
    def layer(x: Tensor, name: str, transposed: bool) -> Tensor:
        weight = state[f"grid_network.{name}.convolution.weight"]
        convolve = conv_transpose3d if transposed else conv3d
        return norm(convolve(x, weight, stride=2, padding=1), state[f"grid_network.{name}.norm.bias"])

    c1 = layer(grid, "down.0", False)
    c2 = layer(relu(c1), "down.1", False)
    c3 = layer(relu(c2), "down.2", False)
    d1 = cat((layer(relu(c3), "up.0", True), c2), 1)
    d2 = cat((layer(relu(d1), "up.1", True), c1), 1)
    return layer(relu(d2), "up.2", True)


def occupy(grid: Tensor, state: State) -> Tensor:
    weight, bias = state["out.convolution.weight"], state["out.convolution.bias"]
    return conv_transpose3d(relu(grid), weight, bias, padding=1)[..., :-1, :-1, :-1]


def reduce_rays(maps: Tensor, early: list[Tensor], state: State) -> Tensor:
    """Depth from stacked planes (N, 32 * 64, h, w) at stride 4, beside the early maps of strides 2 and 4."""

    def separable(x: Tensor, name: str) -> Tensor:
        x = conv2d(x, state[f"{name}.depthwise.weight"], padding=1, groups=x.shape[1])
        return norm(conv2d(x, state[f"{name}.pointwise.weight"]), state[f"{name}.norm.bias"])

    def rise(x: Tensor, name: str) -> Tensor:
        x = interpolate(relu(x), scale_factor=2.0, mode="nearest")
        return norm(conv2d(x, state[f"{name}.block.convolution.weight"], padding=1), state[f"{name}.block.norm.bias"])

    x = separable(maps, "rays.0")
    x = separable(relu(x), "rays.1")
    x = rise(cat((early[1], x), 1), "rise.0")
    x = rise(cat((early[0], x), 1), "rise.1")
    return conv2d(relu(x), state["out.convolution.weight"], state["out.convolution.bias"], padding=1)[:, 0]
