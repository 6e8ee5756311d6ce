"""The public names, their signatures and their documentation."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest
import torch

import lsmgeo
from lsmgeo import cameras, errors, functional, fusion, grids, kernels, layers, metrics, rays

INVENTORY = {
    lsmgeo: {
        "CameraTensors", "FrustumGrid", "PlaneSweepProject", "Splat", "Unproject", "VoxelGrid", "__version__",
        "cameras", "debug", "depth_planes", "errors", "functional", "fusion", "kernels", "rays",
    },
    functional: {
        "Projected", "Sampled", "Unprojected", "plane_sweep_project", "sample_views", "sample_volume", "splat",
        "unproject", "unproject_points", "unproject_slabs", "view_statistics",
    },
    cameras: {
        "CameraTensors", "as_tensors", "centers", "crop", "from_colmap", "from_opencv", "from_opengl", "from_pytorch3d",
        "look_at", "orbit", "perturb", "project", "rays", "resize", "select", "stack", "to", "to_colmap", "to_opencv",
        "to_opengl", "to_pytorch3d", "unproject_depth",
    },
    grids: {"FrustumGrid", "Lattice", "VoxelGrid", "depth_planes"},
    layers: {"PlaneSweepProject", "Splat", "Unproject"},
    fusion: {"ConvGRU3d", "ConvLSTM3d", "Max", "Mean", "Variance"},
    rays: {"Composited", "ProjectReduce", "composite", "expected_depth", "max_along_rays", "project_reduce"},
    metrics: {
        "BadPixels", "CategoryMeans", "CloudScores", "DensityCurve", "DepthError", "DepthErrors", "MedianDepthError",
        "Running", "RunningDensityCurve", "VoxelIoU", "bad_pixel_rate", "category_means", "density_curve",
        "depth_errors", "median_depth_error", "point_cloud_scores", "voxel_iou",
    },
    errors: {
        "BackendError", "CameraError", "CheckpointError", "DTypeError", "DataError", "DeviceError", "GridError",
        "LsmGeoError", "OptionError", "ShapeError", "TrainingError",
    },
}  # fmt: skip

SAMPLING = "augment=(), direction_frame='world'"
SIGNATURES = {
    lsmgeo.VoxelGrid: "(shape, lower=-0.5, upper=0.5, world_from_grid=None)",
    lsmgeo.FrustumGrid: "(camera, depths, size=None)",
    lsmgeo.depth_planes: "(near, far, num, spacing='depth')",
    lsmgeo.CameraTensors: "(intrinsics, cam_from_world, height, width)",
    cameras.project: "(cameras, points, *, near=1e-06)",
    cameras.unproject_depth: "(cameras, depth)",
    cameras.centers: "(cameras)",
    lsmgeo.Unproject: (
        f"(grid=None, *, mode='bilinear', padding_mode='zeros', {SAMPLING}, reduce=None, near=1e-06, groups=1, "
        "memory_format=None, backend='auto')"
    ),
    lsmgeo.PlaneSweepProject: (
        f"(grid=None, depths=None, size=None, *, mode='trilinear', padding_mode='zeros', {SAMPLING}, flatten=True, "
        "near=1e-06, memory_format=None, backend='auto')"
    ),
    lsmgeo.Unproject.forward: "(self, features, cameras, view_mask=None, *, grid=None, reference=None)",
    lsmgeo.PlaneSweepProject.forward: "(self, volume, cameras, view_mask=None, *, grid=None, depths=None, size=None)",
    lsmgeo.Splat: "(grid=None, depths=None, *, mode='trilinear', padding_mode='zeros', near=1e-06, backend='auto')",
    lsmgeo.Splat.forward: ("(self, features, cameras, view_mask=None, *, weights=None, grid=None, depths=None)"),
    functional.sample_volume: "(volume, grid, points, *, mode='trilinear', padding_mode='zeros', near=1e-06)",
    functional.splat: (
        "(features, cameras, grid, depths, *, weights=None, view_mask=None, mode='trilinear', padding_mode='zeros', "
        "near=1e-06, backend='auto')"
    ),
    functional.unproject: (
        f"(features, cameras, grid, *, view_mask=None, mode='bilinear', padding_mode='zeros', {SAMPLING}, reduce=None, "
        "near=1e-06, reference=None, groups=1, memory_format=None, backend='auto')"
    ),
    functional.unproject_points: (
        f"(features, cameras, points, *, view_mask=None, mode='bilinear', padding_mode='zeros', {SAMPLING}, "
        "reduce=None, near=1e-06, backend='auto')"
    ),
    functional.plane_sweep_project: (
        "(volume, cameras, grid, depths, size=None, *, view_mask=None, mode='trilinear', padding_mode='zeros', "
        f"{SAMPLING}, flatten=True, near=1e-06, memory_format=None, backend='auto')"
    ),
}


def bare_signature(function) -> str:
    """The signature without annotations."""
    signature = inspect.signature(function)
    parameters = [item.replace(annotation=inspect.Parameter.empty) for item in signature.parameters.values()]
    return str(signature.replace(parameters=parameters, return_annotation=inspect.Signature.empty))


@pytest.mark.parametrize("module", INVENTORY, ids=lambda module: module.__name__)
def test_the_inventory(module):
    assert set(module.__all__) == INVENTORY[module]
    assert len(module.__all__) == len(set(module.__all__))


@pytest.mark.parametrize("function", SIGNATURES, ids=lambda function: function.__qualname__)
def test_the_signatures(function):
    assert bare_signature(function) == SIGNATURES[function]


def public_functions():
    for module in (functional, cameras, grids, layers, fusion, rays, metrics):
        for name in module.__all__:
            value = getattr(module, name)
            own = inspect.isfunction(value) or (inspect.isclass(value) and not hasattr(value, "_fields"))
            if own and name != "as_tensors":
                yield pytest.param(value, id=f"{module.__name__}.{name}")
    yield pytest.param(kernels.explain, id="lsmgeo.kernels.explain")
    yield pytest.param(lsmgeo.debug, id="lsmgeo.debug")
    yield pytest.param(lsmgeo.CameraTensors, id="lsmgeo.CameraTensors")


@pytest.mark.parametrize("value", list(public_functions()))
def test_documentation(value):
    text = inspect.getdoc(value)
    assert ">>> " in text, "no doctest"
    # Something is printed or shown: a line after the last prompt that is no prompt.
    examples = text.partition("Example")[2].splitlines()
    assert any(line.strip() and not line.strip().startswith((">>>", "...", ":")) for line in examples), (
        "no literal result"
    )
    first = text.splitlines()[0]
    assert first.endswith((".", ":"))
    if inspect.isfunction(value):
        parameters = [name for name in inspect.signature(value).parameters if name not in ("args", "kwargs")]
        if parameters and value.__name__ != "to":  # its arguments are those of torch.Tensor.to
            arguments = re.search(r"\nArgs:\n(.*?)(\n\n|\Z)", text, re.DOTALL)
            assert arguments, "no Args"
            for name in parameters:
                assert re.search(rf"^ +\**{name}: ", arguments[1], re.MULTILINE), f"{name} is not documented"
            assert re.search(r"\n(Returns|Yields):\n", text), "no Returns"
        annotated = inspect.signature(value)
        assert all(item.annotation is not inspect.Parameter.empty for item in annotated.parameters.values())
        assert annotated.return_annotation is not inspect.Signature.empty


def test_errors_are_also_built_in_errors():
    kinds = {
        "ShapeError": ValueError, "DTypeError": TypeError, "DeviceError": ValueError, "CameraError": ValueError,
        "GridError": ValueError, "OptionError": ValueError, "BackendError": ValueError, "DataError": OSError,
        "CheckpointError": RuntimeError, "TrainingError": RuntimeError,
    }  # fmt: skip
    for name, kind in kinds.items():
        assert issubclass(getattr(errors, name), kind)
        assert issubclass(getattr(errors, name), errors.LsmGeoError)
    error = errors.DataError("some/file", "too short")
    assert (error.path, error.reason, str(error)) == ("some/file", "too short", "some/file: too short")


def test_types_are_shipped():
    root = Path(lsmgeo.__file__).parent
    assert (root / "py.typed").is_file()
    assert "py.typed" in (root.parent / "setup.cfg").read_text(encoding="utf-8")


def test_files_can_be_read_in_one_sitting():
    root = Path(lsmgeo.__file__).parent
    long = {
        path.name: count for path in root.rglob("*.py") if (count := len(path.read_text("utf-8").splitlines())) > 450
    }
    assert long == {}


def test_what_the_first_page_shows_runs():
    from lsmgeo import PlaneSweepProject, Unproject, VoxelGrid, depth_planes

    features = torch.rand(2, 3, 5, 24, 32)
    azimuth = torch.tensor([[0.0, 120.0, 240.0], [10.0, 130.0, 250.0]])
    views = cameras.orbit(azimuth, 20.0, 2.0, focal_length=250.0, height=192, width=256)
    grid = VoxelGrid(32)
    unproject = Unproject(grid, augment=("depth", "direction"))
    volume, visible = unproject(features, views)
    assert volume.shape == (2, 3, 5 + 4, 32, 32, 32)
    assert visible.shape == (2, 3, 32, 32, 32)
    assert visible.dtype == torch.bool
    # The grid's middle is two units before every camera.
    middle = volume[:, :, 5, 15:17, 15:17, 15:17].mean((-3, -2, -1))
    torch.testing.assert_close(middle, torch.full((2, 3), 2.0))

    fused = volume.mean(1)
    project = PlaneSweepProject(grid, depth_planes(1.0, 3.0, 64), size=(56, 56), mode="nearest")
    maps, visible = project(fused, views)
    assert maps.shape == (2, 3, 9 * 64, 56, 56)
    assert visible.shape == (2, 3, 64, 56, 56)
    assert visible.any()
    assert not visible.all()
