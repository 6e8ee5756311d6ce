"""Every Triton kernel compiles for Hopper, as `gpu` launches it, on a machine without a GPU."""

from __future__ import annotations

import importlib.util

import pytest
import torch

from lsmgeo.kernels import Options, Sites, gpu, gpu_launch

pytestmark = pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="Triton is not installed")

B, V, C, P = 2, 3, 16, 8
SIZE = (16, 16)
AUGMENTED = {"depth": True, "direction": "world"}
EVERY = ("mean", "variance", "max")

FEATURES = torch.zeros(B, V, C, 24, 32)
VOLUME = torch.zeros(B, C, 8, 16, 16)
POINTS = torch.zeros(B, V, 100, 2), torch.ones(B, V, 100, dtype=torch.bool), torch.zeros(B, V, 4, 100)


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
        monkeypatch.setattr(gpu_launch, "TILE", 512)  # a quarter of the code
    before = triton.runtime.driver._active
    monkeypatch.setattr(JITFunction, "run", compile_only)
    triton.runtime.driver.set_active(Hopper())
    yield found
    triton.runtime.driver._active = before


def sites(channel: str = "", projective: bool = False) -> Sites:
    matrix = torch.eye(3, 4, dtype=torch.float64).expand(B, V, 3, 4)
    x = torch.arange(SIZE[1], dtype=torch.float64)
    return Sites(matrix, matrix if channel else None, x, x, 1.0 / (1.0 + x[:P]), projective, None)


def images(dtype, options, projective=False):
    source = FEATURES.to(dtype)
    values, _ = gpu.images(source, sites(options.direction, projective), options)
    gpu.images_backward(values, source, sites(options.direction, projective), options, (True,) * 4)


def volume(dtype, options):
    source = VOLUME.to(dtype)
    values, _ = gpu.volume(source, sites(options.direction, True), options)
    gpu.volume_backward(values, source, sites(options.direction, True), options, (True,) * 4)


def pixels(dtype, options):
    values, _ = gpu.pixels(FEATURES.to(dtype), *POINTS, options)
    gpu.pixels_backward(values, FEATURES.to(dtype), *POINTS, options, (True,) * 3)


def fixed_point(dtype, options):
    torch.use_deterministic_algorithms(True)
    try:
        images(dtype, options)
    finally:
        torch.use_deterministic_algorithms(False)


def one_of_everything(dtype, options):
    """Sizes of 1, which Triton takes for constants."""
    one = torch.ones(1, dtype=torch.float64)
    single = Sites(torch.ones(1, 1, 3, 4, dtype=torch.float64), None, one, one, one, False, None)
    source = torch.zeros(1, 1, 1, 1, 1, dtype=dtype)
    values, _ = gpu.images(source, single, options)
    gpu.images_backward(values, source, single, options, (True,) * 4)


VARIANTS = {
    "sizes of 1": (one_of_everything, torch.float32, Options("bilinear", reduce=("max",))),
    "images": (images, torch.float32, Options("bilinear", **AUGMENTED)),
    "frustums, nearest": (lambda *args: images(*args, True), torch.float16, Options("nearest", depth=True)),
    "variance": (images, torch.bfloat16, Options("bilinear", "border", reduce=("variance",))),
    "volume": (volume, torch.float32, Options("trilinear", "border")),
    "pixels": (pixels, torch.float32, Options("bilinear")),
}
MORE = {
    "images, full tile": VARIANTS["images"],
    "volume, full tile": VARIANTS["volume"],
    "mean": (images, torch.float32, Options("bilinear", reduce=("mean",))),
    "maximum": (images, torch.float32, Options("nearest", reduce=("max",))),
    "everything": (images, torch.float32, Options("bilinear", reduce=EVERY, **AUGMENTED)),
    "everything, half": (images, torch.float16, Options("bilinear", "border", reduce=EVERY, **AUGMENTED)),
    "stacked": (volume, torch.float32, Options("trilinear", stacked=True)),
    "volume with channels": (volume, torch.float16, Options("trilinear", **AUGMENTED)),
    "nearest cell": (volume, torch.bfloat16, Options("nearest", "border", depth=True)),
    "pixels reduced": (pixels, torch.float16, Options("bilinear", "border", reduce=EVERY)),
    "fixed point": (fixed_point, torch.float32, Options("bilinear")),
}


@pytest.mark.parametrize("variant", [*VARIANTS, *(pytest.param(name, marks=pytest.mark.long) for name in MORE)])
def test_compiles_for_hopper(compiled, variant):
    call, dtype, options = (VARIANTS | MORE)[variant]
    call(dtype, options)
    assert [kernel.src.fn.__name__ for kernel in compiled] == ["resample", "resample_backward"]
    for kernel in compiled:
        assert len(kernel.asm["cubin"]) > 1000
        assert ".target sm_90" in kernel.asm["ptx"]
        assert ".f64" not in kernel.asm["ptx"]
