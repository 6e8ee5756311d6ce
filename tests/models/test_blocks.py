"""Convolutions that keep sizes whole, against loops."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lsmgeo.models.blocks import Block, Convolution, InstanceNorm

# Kernel, stride, what TensorFlow's "SAME" puts before and after a side of 8.
SAME = [(5, 2, 1, 2), (3, 2, 0, 1), (4, 2, 1, 1), (6, 2, 2, 2), (3, 1, 1, 1), (5, 1, 2, 2), (4, 1, 1, 2), (1, 1, 0, 0)]


def convolve_line(x, kernel, stride, before):
    """One channel, one dimension: y[i] = sum_k w[k] x[stride i + k - before], x zero outside."""
    y = np.zeros(len(x) // stride)
    for i in range(len(y)):
        for k, weight in enumerate(kernel):
            if 0 <= stride * i + k - before < len(x):
                y[i] += weight * x[stride * i + k - before]
    return y


@pytest.mark.parametrize(("kernel_size", "stride", "before", "after"), SAME)
@pytest.mark.parametrize("dims", [2, 3])
def test_convolutions_pad_as_tensorflow_does(dims, kernel_size, stride, before, after):
    assert before + after == kernel_size - stride
    generator = np.random.default_rng(kernel_size)
    x, kernel = generator.normal(size=8), generator.normal(size=kernel_size)
    expected = convolve_line(x, kernel, stride, before)
    for axis in range(-dims, 0):
        module = Convolution(dims, 1, 1, kernel_size, stride=stride).double()
        # The kernel lies along one axis; along the others it takes the one tap that meets position stride * i.
        with torch.no_grad():
            module.weight.zero_()
            taps = [0, 0] + [before] * dims
            taps[axis] = slice(None)
            module.weight[tuple(taps)] = torch.from_numpy(kernel)
        lines = torch.from_numpy(x).reshape([8 if a == axis else 1 for a in range(-dims, 0)]).expand([8] * dims)
        found = module(lines[None, None]).detach()
        assert tuple(found.shape) == (1, 1, *[8 // stride] * dims)
        np.testing.assert_allclose(found.movedim(axis, -1).flatten(0, -2)[0].numpy(), expected, atol=1e-12)


@pytest.mark.parametrize(("kernel_size", "stride", "before", "after"), SAME)
def test_transposed_convolutions_are_the_adjoints(kernel_size, stride, before, after):
    """<conv x, y> = <x, conv^T y> for the loop's matrix."""
    kernel = np.random.default_rng(kernel_size).normal(size=kernel_size)
    matrix = np.stack([convolve_line(row, kernel, stride, before) for row in np.eye(8)])  # x to y, transposed
    for axis in (-2, -1):
        module = Convolution(2, 1, 1, kernel_size, stride=stride, transposed=True).double()
        with torch.no_grad():
            module.weight.zero_()
            taps = [0, 0, before, before]
            taps[axis] = slice(None)
            module.weight[tuple(taps)] = torch.from_numpy(kernel)
        y = torch.from_numpy(np.random.default_rng(1).normal(size=8 // stride))
        image = torch.zeros(8 // stride, 8 // stride, dtype=torch.float64)
        image.movedim(axis, -1)[0] = y
        found = module(image[None, None]).detach()[0, 0].movedim(axis, -1)[0]
        np.testing.assert_allclose(found.numpy(), matrix @ y.numpy(), atol=1e-12)


def test_an_odd_kernel_of_stride_2_reaches_further_after():
    module = Convolution(2, 1, 1, 3, stride=2)
    torch.nn.init.ones_(module.weight)
    found = module(torch.arange(16.0).reshape(1, 1, 4, 4))[0, 0]
    # Rows and columns 0 1 2, and 2 3 with the padding after them.
    torch.testing.assert_close(found, torch.tensor([[45.0, 39.0], [66.0, 50.0]]))


@pytest.mark.parametrize(("kernel_size", "is_aligned"), [(4, True), (6, True), (3, False), (5, False)])
def test_even_kernels_of_stride_2_keep_maps_in_place(kernel_size, is_aligned):
    """What mirrors the image mirrors the map."""
    module = Convolution(2, 1, 1, kernel_size, stride=2).double()
    torch.nn.init.ones_(module.weight)
    image = torch.randn(1, 1, 8, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(module(image.flip(-1)), module(image).flip(-1)) == is_aligned


@pytest.mark.parametrize("scale", [True, False])
def test_instance_norm_normalises_each_channel_of_each_sample(scale):
    module = InstanceNorm(3, scale=scale).double()
    torch.nn.init.normal_(module.bias, generator=torch.Generator().manual_seed(1))
    if scale:
        torch.nn.init.normal_(module.weight, generator=torch.Generator().manual_seed(2))
    assert ("weight" in module.state_dict()) == scale
    x = 0.01 * torch.randn(2, 3, 4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    expected = np.empty(x.shape)
    for n, c in np.ndindex(2, 3):
        pixels = x[n, c].numpy()
        gain = module.weight[c].item() if scale else 1.0
        expected[n, c] = gain * (pixels - pixels.mean()) / np.sqrt(pixels.var() + 1e-5) + module.bias[c].item()
    np.testing.assert_allclose(module(x).detach().numpy(), expected, rtol=1e-12, atol=1e-13)


def test_a_block_activates_first():
    block = Block(2, 1, 1, 1, norm="none")
    torch.nn.init.ones_(block.convolution.weight)
    x = torch.tensor([[-1.0, 2.0]])[None, None]
    assert torch.equal(block(x).detach(), x.relu())
    block.activate = False
    assert torch.equal(block(x).detach(), x)
