"""Every Triton kernel compiles for Hopper, as `gpu` launches it, on a machine without a GPU."""

from __future__ import annotations

import contextlib
import importlib.util
from typing import NamedTuple

import pytest
import torch

from lsmgeo.kernels import Options, Sites
from lsmgeo.kernels.splat import splat, splat_backward
from lsmgeo.kernels.triton import launcher, operators
from tests.kernels.triton_support import Points, by_kernels, deterministic

pytestmark = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not installed")

B, V, C, P = 2, 3, 16, 8
SIZE = (16, 16)
AUGMENTED = {"depth": True, "direction": "world"}
EVERY = ("mean", "variance", "max")

FEATURES = torch.zeros(B, V, C, 24, 32)
VOLUME = torch.zeros(B, C, 8, 16, 16)
POINTS = Points(torch.zeros(B, V, 100, 2), torch.ones(B, V, 100, dtype=torch.bool), torch.zeros(B, V, 4, 100))


class Hopper:
    """Stands for the driver: where to compile for. Nothing is launched."""

    def get_current_target(self):
        from triton.backends.compiler import GPUTarget

        return GPUTarget("cuda", 90, 32)

    def get_current_device(self):
        return 0

    def get_current_stream(self, device):
        return 0


@pytest.fixture
def compiled(monkeypatch, tmp_path, variant):
    """What the kernels were compiled to instead of being launched."""
    import triton
    from triton.backends.nvidia.compiler import get_ptxas
    from triton.runtime.jit import JITFunction

    try:
        get_ptxas(90)
    except RuntimeError as error:
        pytest.skip(f"no ptxas: {error}")
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    found, run = [], JITFunction.run

    def compile_only(self, *args, grid, warmup, **kwargs):
        found.append(run(self, *args, grid=grid, warmup=True, **kwargs))

    if variant in VARIANTS:
        monkeypatch.setattr(launcher, "TILE", 512)  # a quarter of the code
    before = triton.runtime.driver._active
    monkeypatch.setattr(JITFunction, "run", compile_only)
    triton.runtime.driver.set_active(Hopper())
    yield found
    triton.runtime.driver._active = before


def sites(channel: str = "", projective: bool = False) -> Sites:
    matrix = torch.eye(3, 4, dtype=torch.float64).expand(B, V, 3, 4)
    x = torch.arange(SIZE[1], dtype=torch.float64)
    return Sites(matrix, matrix if channel else None, x, x, 1.0 / (1.0 + x[:P]), projective, None)


class Variant(NamedTuple):
    source: torch.Tensor
    place: Sites | Points
    options: Options
    volume: bool = False


def images(options: Options, dtype: torch.dtype = torch.float32, projective: bool = False) -> Variant:
    return Variant(FEATURES.to(dtype), sites(options.direction, projective), options)


def volume(options: Options, dtype: torch.dtype = torch.float32) -> Variant:
    return Variant(VOLUME.to(dtype), sites(options.direction, True), options, volume=True)


ONE = torch.ones(1, dtype=torch.float64)
BILINEAR = Options("bilinear")
VARIANTS = {
    # Sizes of 1, which Triton takes for constants.
    "sizes of 1": Variant(
        torch.zeros(1, 1, 1, 1, 1),
        Sites(torch.ones(1, 1, 3, 4, dtype=torch.float64), None, ONE, ONE, ONE, False, None),
        Options("bilinear", reduce=("max",)),
    ),
    "images": images(Options("bilinear", **AUGMENTED)),
    "frustums, nearest": images(Options("nearest", depth=True), torch.float16, projective=True),
    "variance": images(Options("bilinear", "border", reduce=("variance",)), torch.bfloat16),
    "volume": volume(Options("trilinear", "border")),
    "pixels": Variant(FEATURES, POINTS, BILINEAR),
}
MORE = {
    "images, full tile": VARIANTS["images"],
    "volume, full tile": VARIANTS["volume"],
    "mean": images(Options("bilinear", reduce=("mean",))),
    "maximum": images(Options("nearest", reduce=("max",))),
    "everything": images(Options("bilinear", reduce=EVERY, **AUGMENTED)),
    "everything, half": images(Options("bilinear", "border", reduce=EVERY, **AUGMENTED), torch.float16),
    "stacked": volume(Options("trilinear", flatten=True)),
    "volume with channels": volume(Options("trilinear", **AUGMENTED), torch.float16),
    "nearest cell": volume(Options("nearest", "border", depth=True), torch.bfloat16),
    "pixels reduced": Variant(FEATURES.half(), POINTS, Options("bilinear", "border", reduce=EVERY)),
    "fixed point": images(BILINEAR),
}


@pytest.mark.parametrize("variant", [*VARIANTS, *(pytest.param(name, marks=pytest.mark.long) for name in MORE)])
def test_compiles_for_hopper(compiled, variant):
    source, place, options, is_volume = (VARIANTS | MORE)[variant]
    with deterministic() if variant == "fixed point" else contextlib.nullcontext():
        by_kernels(source, place, options, volume=is_volume)
    assert [kernel.src.fn.__name__ for kernel in compiled] == ["resample", "resample_backward"]
    for kernel in compiled:
        assert len(kernel.asm["cubin"]) > 1000
        assert ".target sm_90" in kernel.asm["ptx"]
        assert ".f64" not in kernel.asm["ptx"]


@pytest.mark.parametrize("variant", ["splat"])
def test_splat_compiles_for_hopper(compiled, variant):
    maps, weights = torch.zeros(B, V, C, *SIZE), torch.zeros(B, V, P, *SIZE)
    arguments = maps, sites(projective=True), weights
    splat(operators, *arguments, VOLUME.shape[2:], Options("trilinear"))
    splat_backward(operators, VOLUME, *arguments, Options("trilinear"), (True,) * 4)
    assert [kernel.src.fn.__name__ for kernel in compiled] == ["resample_backward", "resample", "resample_backward"]
    for kernel in compiled:
        assert len(kernel.asm["cubin"]) > 1000
        assert ".f64" not in kernel.asm["ptx"]
