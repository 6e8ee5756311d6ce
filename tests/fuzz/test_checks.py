"""Each check by name: what it says of the mistake that it is for."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch

from lsmgeo import (
    FrustumGrid,
    PlaneSweepProject,
    Unproject,
    VoxelGrid,
    cameras,
    depth_planes,
    functional,
    fusion,
    rays,
)
from lsmgeo.errors import CameraError, DeviceError, DTypeError, GridError, LsmGeoError, OptionError, ShapeError
from tests.fuzz.calls import sweep, unproject, with_scale, with_value
from tests.fuzz.positions import DEPTHS, FEATURES, GRID, VIEWS, VOLUME, B, V, right_cameras

MISTAKES = {
    "other number of cameras": (
        lambda: unproject(torch.rand(2, 3, 32, 56, 56), right_cameras(2, 4)),
        ShapeError,
        "Unproject: features must be (B, V, C, h, w) with B*V = 8 cameras; got (2, 3, 32, 56, 56), that is 6",
    ),
    "features without views": (
        lambda: unproject(torch.rand(6, 4, 5, 7)),
        ShapeError,
        "Unproject: features must be (B, V, C, h, w) with B*V = 6 cameras; got (6, 4, 5, 7)",
    ),
    "integer image": (
        lambda: unproject(torch.ones(B, V, 3, 5, 7, dtype=torch.uint8)),
        DTypeError,
        "Unproject: features must be of float16, bfloat16, float32, float64; got torch.uint8",
    ),
    "views and scenes swapped": (
        lambda: unproject(torch.rand(3, 2, 4, 5, 7)),
        ShapeError,
        "Unproject: cameras must have leading shape (B, V) = (3, 2), or (B*V,) with the view fastest; got (2, 3)",
    ),
    "no view": (
        lambda: unproject(torch.rand(2, 0, 4, 5, 7), right_cameras(2, 0)),
        ShapeError,
        "got (2, 0, 4, 5, 7)",
    ),
    "no camera to sweep": (lambda: sweep(views=right_cameras(2, 0)), ShapeError, "at least one view"),
    "3x4 extrinsics": (
        lambda: unproject(views=VIEWS._replace(cam_from_world=VIEWS.cam_from_world[..., :3, :])),
        ShapeError,
        "Unproject: cameras.cam_from_world must be (..., 4, 4), the whole world-to-camera matrix; got (2, 3, 3, 4)",
    ),
    "half-precision cameras": (
        lambda: unproject(views=VIEWS._replace(intrinsics=VIEWS.intrinsics.half())),
        DTypeError,
        "cameras.intrinsics must be of float32, float64; got torch.float16",
    ),
    "mixed camera dtypes": (
        lambda: unproject(views=VIEWS._replace(intrinsics=VIEWS.intrinsics.double())),
        DTypeError,
        "of one dtype; got torch.float64 and torch.float32",
    ),
    "devices": (
        lambda: unproject(FEATURES.to("meta")),
        DeviceError,
        "Unproject: all tensors must be on one device; got features on meta, cameras on cpu",
    ),
    "not finite": (
        lambda: unproject(views=with_value("intrinsics", (1, 0, 0, 2), float("nan"))),
        CameraError,
        "Unproject: cameras[1, 0]: intrinsics must be finite",
    ),
    "infinite translation": (
        lambda: unproject(views=with_value("cam_from_world", (0, 2, 1, 3), float("inf"))),
        CameraError,
        "Unproject: cameras[0, 2]: cam_from_world must be finite",
    ),
    "negative focal length": (
        lambda: unproject(views=with_value("intrinsics", (0, 1, 1, 1), -20.0)),
        CameraError,
        "cameras[0, 1]: focal lengths must be positive pixels, 1e-6 of the image size at least; got -20",
    ),
    "singular intrinsics": (
        lambda: unproject(views=with_value("intrinsics", (0, 1, 0, 0), 0.0)),
        CameraError,
        "cameras[0, 1]: focal lengths must be positive pixels, 1e-6 of the image size at least; got 0",
    ),
    "last row of K": (
        lambda: unproject(views=with_value("intrinsics", (1, 1, 2, 2), 2.0)),
        CameraError,
        "cameras[1, 1]: intrinsics must have the last row (0, 0, 1); its largest deviation is 1",
    ),
    "transposed K": (
        lambda: unproject(views=VIEWS._replace(intrinsics=VIEWS.intrinsics.mT)),
        CameraError,
        "intrinsics must have the last row (0, 0, 1)",
    ),
    "vertical skew": (
        lambda: unproject(views=with_value("intrinsics", (1, 1, 1, 0), 0.5)),
        CameraError,
        "cameras[1, 1]: intrinsics[1, 0] must be 0; got 0.5",
    ),
    "last row of the extrinsics": (
        lambda: unproject(views=VIEWS._replace(cam_from_world=VIEWS.cam_from_world.mT)),
        CameraError,
        "cam_from_world must have the last row (0, 0, 0, 1)",
    ),
    "scaled rotation": (
        lambda: unproject(views=with_scale(rotation=1.1)),
        CameraError,
        "cameras[1, 2]: the rotation must be orthonormal (a scale in it?); max |R^T R - I| is 0.21",
    ),
    "mirror": (
        lambda: unproject(views=with_scale(first_row=-1.0)),
        CameraError,
        "cameras[1, 2]: the rotation must not mirror (is an axis flipped?); its determinant is -1",
    ),
    "image without pixels": (
        lambda: unproject(views=VIEWS._replace(height=0)),
        CameraError,
        "Unproject: cameras.height must be at least 1 pixel",
    ),
    "one image without pixels": (
        lambda: unproject(views=VIEWS._replace(width=torch.tensor([[14, 14, 0], [14, 14, 14]]))),
        CameraError,
        "Unproject: cameras[0, 2]: height and width must be at least 1 pixel",
    ),
    "mask of another shape": (
        lambda: unproject(view_mask=torch.ones(V, B, dtype=torch.bool)),
        ShapeError,
        "Unproject: view_mask must be (B, V) = (2, 3); got (3, 2)",
    ),
    "mask of floats": (
        lambda: unproject(view_mask=torch.ones(B, V)),
        DTypeError,
        "Unproject: view_mask must be a bool tensor (B, V); got a tensor (2, 3) of torch.float32",
    ),
    "unknown mode": (
        lambda: unproject(mode="trilinear"),
        OptionError,
        "Unproject: mode must be one of 'bilinear', 'nearest'; got str 'trilinear'",
    ),
    "unknown padding": (
        lambda: Unproject(padding_mode="reflection"),
        OptionError,
        "Unproject: padding_mode must be one of 'zeros', 'border'; got str 'reflection'",
    ),
    "unknown channel": (
        lambda: Unproject(augment=("depth", "color")),
        OptionError,
        "Unproject: augment must be one of 'depth', 'direction'; got str 'color'",
    ),
    "channel twice": (
        lambda: Unproject(augment=("depth", "depth")),
        OptionError,
        "Unproject: augment must not repeat a name; got ('depth', 'depth')",
    ),
    "unknown statistic": (
        lambda: Unproject(reduce="median"),
        OptionError,
        "Unproject: reduce must be one of 'mean', 'variance', 'max'; got str 'median'",
    ),
    "negative near": (
        lambda: Unproject(near=-1.0),
        OptionError,
        "Unproject: near must be a finite number, at least 0; got float -1.0",
    ),
    "unknown backend": (
        lambda: Unproject(backend="cuda"),
        OptionError,
        "Unproject: backend must be one of 'auto', 'cpu', 'triton', 'reference'; got str 'cuda'",
    ),
    "no grid": (
        lambda: Unproject()(FEATURES, VIEWS),
        GridError,
        "Unproject: grid must be given to the layer or to the call; got None",
    ),
    "no depths": (
        lambda: PlaneSweepProject(GRID)(VOLUME, VIEWS),
        GridError,
        "PlaneSweepProject: depths must be given to the layer or to the call; got None",
    ),
    "grid of tensors": (
        lambda: Unproject(torch.rand(4, 4)),
        DTypeError,
        "Unproject: grid must be a VoxelGrid or a FrustumGrid; got a tensor (4, 4) of torch.float32",
    ),
    "grids of another number of scenes": (
        lambda: functional.unproject(FEATURES, VIEWS, VoxelGrid(2, world_from_grid=torch.eye(4).expand(3, 4, 4))),
        ShapeError,
        "Unproject: grid must have one pose and one row of depths, or as many as scenes, B = 2; got 3",
    ),
    "volume of another grid": (
        lambda: sweep(grid=VoxelGrid((6, 4, 3))),
        ShapeError,
        "volume must be (B, C, D, H, W) with the grid's (D, H, W) = (6, 4, 3); got (2, 4, 3, 4, 6)",
    ),
    "depths that descend": (
        lambda: sweep(depths=DEPTHS.flip(0)),
        GridError,
        "depths must be positive, finite and strictly ascending; got [3.0, 2.5, 2.0, 1.5, 1.0]",
    ),
    "equal depths": (
        lambda: sweep(depths=torch.tensor([[1.0, 2.0], [1.0, 1.0]])),
        GridError,
        "depths must be positive, finite and strictly ascending; got [1.0, 1.0]",
    ),
    "depth zero": (
        lambda: FrustumGrid(right_cameras(B), torch.tensor([0.0, 1.0])),
        GridError,
        "FrustumGrid: depths must be positive, finite and strictly ascending; got [0.0, 1.0]",
    ),
    "depths of other views": (
        lambda: sweep(depths=DEPTHS.expand(3, 5)),
        ShapeError,
        "depths must be (P,), (B, P) or (B, V, P) with (B, V) = (2, 3); got (3, 5)",
    ),
    "frustums of two axes": (
        lambda: FrustumGrid(VIEWS, DEPTHS),
        ShapeError,
        "FrustumGrid: camera must have leading shape () or (B,), one a scene (see cameras.select); got (2, 3)",
    ),
    "size of one number": (
        lambda: sweep(size=(8,)),
        ShapeError,
        "PlaneSweepProject: size must be (h, w); got tuple (8,)",
    ),
    "no voxels": (
        lambda: VoxelGrid((4, 0, 4)),
        GridError,
        "VoxelGrid: shape must be an int or (D, H, W), each at least 1; got (4, 0, 4)",
    ),
    "too many voxels": (
        lambda: VoxelGrid((2**11, 2**10, 2**10)),
        GridError,
        "got (2048, 1024, 1024)",
    ),
    "crossed bounds": (
        lambda: VoxelGrid(4, (0, 0, 0), (1, -1, 1)),
        GridError,
        "VoxelGrid: lower must be below upper on every axis; got 0.0 and -1.0 in y",
    ),
    "bounds of tensors": (
        lambda: VoxelGrid(4, lower=torch.zeros(3)),
        DTypeError,
        "VoxelGrid: lower must be numbers (gradients go to world_from_grid); got a tensor (3,) of torch.float32",
    ),
    "singular pose": (
        lambda: VoxelGrid(4, world_from_grid=torch.diag(torch.tensor([1.0, 1.0, 0.0, 1.0]))),
        GridError,
        "VoxelGrid: world_from_grid must be invertible",
    ),
    "projective pose": (
        lambda: VoxelGrid(4, world_from_grid=torch.ones(4, 4)),
        GridError,
        "VoxelGrid: world_from_grid must be affine, its last row (0, 0, 0, 1)",
    ),
    "near beyond far": (
        lambda: depth_planes(3.0, 1.0, 4),
        GridError,
        "depth_planes: near and far must be positive, finite and ascending; got 3.0 and 1.0",
    ),
    "no planes": (
        lambda: depth_planes(1.0, 3.0, 0),
        GridError,
        "depth_planes: num must be an integer",
    ),
    "points of another number of scenes": (
        lambda: functional.unproject_points(FEATURES, VIEWS, torch.zeros(3, 5, 3)),
        ShapeError,
        "unproject_points: points must be (B, N, 3) with B = 2; got (3, 5, 3)",
    ),
    "points that are not finite": (
        lambda: functional.unproject_points(FEATURES, VIEWS, torch.full((B, 5, 3), torch.nan)),
        GridError,
        "unproject_points: points must be finite",
    ),
    "zero quaternion": (
        lambda: cameras.from_colmap(torch.eye(3), torch.zeros(4), torch.zeros(3), 4, 4),
        CameraError,
        "from_colmap: quaternion must not be zero",
    ),
    "skew for PyTorch3D": (
        lambda: cameras.to_pytorch3d(with_value("intrinsics", (0, 0, 0, 1), 0.5)),
        CameraError,
        "to_pytorch3d: cameras must have no skew",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_the_message(mistake):
    call, kind, text = MISTAKES[mistake]
    with pytest.raises(kind, match=re.escape(text)):
        call()


WHOLE = {
    "VoxelGrid": lambda n: VoxelGrid(n),
    "VoxelGrid, three": lambda n: VoxelGrid((n, n, n)),
    "FrustumGrid": lambda n: FrustumGrid(cameras.select(right_cameras(B, V), 1, 0), DEPTHS, (n, n)),
    "depth_planes": lambda n: depth_planes(1.0, 2.0, n),
    "PlaneSweepProject": lambda n: PlaneSweepProject(GRID, DEPTHS, (n, n)),
    "ProjectReduce": lambda n: rays.ProjectReduce(n, n, GRID, DEPTHS, (n, n)),
    "unproject_slabs": lambda n: list(functional.unproject_slabs(FEATURES, VIEWS, GRID, n)),
    "ConvGRU3d": lambda n: fusion.ConvGRU3d(n, n, kernel_size=n),
    "ConvLSTM3d": lambda n: fusion.ConvLSTM3d(n, n, kernel_size=n),
    "orbit": lambda n: cameras.orbit(0.0, 0.0, 2.0, focal_length=9.0, height=n, width=n),
    "resize": lambda n: cameras.resize(VIEWS, n, n),
    "crop": lambda n: cameras.crop(VIEWS, 0, 0, n, n),
    "rays": lambda n: cameras.rays(VIEWS, (n, n)),
    "select": lambda n: cameras.select(VIEWS, n, n),
    "stack": lambda n: cameras.stack([VIEWS, VIEWS], n),
    "from_opencv": lambda n: cameras.from_opencv(torch.eye(3), torch.eye(3), torch.zeros(3), n, n),
    "from_pytorch3d": lambda n: cameras.from_pytorch3d(
        torch.eye(3), torch.zeros(3), torch.ones(2), torch.zeros(2), n, n
    ),
    "CameraTensors": lambda n: cameras.as_tensors(cameras.CameraTensors(torch.eye(3), torch.eye(4), n, n)),
}


@pytest.mark.parametrize("name", WHOLE)
def test_whole_numbers_are_pythons_and_numpys(name):
    for kind in (int, np.int32, np.int64, np.uint8):
        WHOLE[name](kind(1))
    for value in (1.0, np.float32(1.0), True, np.True_, "1", None):
        if value is not None or name not in ("PlaneSweepProject",):
            with pytest.raises(LsmGeoError):
                WHOLE[name](value)


def test_sizes_are_kept_as_pythons_numbers():
    assert [type(n) for n in VoxelGrid((np.int64(1), 2, np.uint8(3))).shape] == [int, int, int]


def test_a_rotation_off_by_less_than_the_tolerance_is_taken():
    volume, _ = unproject(views=with_scale(rotation=1.0004))
    assert volume.isfinite().all()
    with pytest.raises(CameraError, match="orthonormal"):
        unproject(views=with_scale(rotation=1.0006))


def test_errors_are_caught_as_what_python_calls_them():
    with pytest.raises(ValueError, match="features"):
        unproject(torch.rand(6, 4, 5, 7))
    with pytest.raises(TypeError, match="features"):
        unproject(None)
    with pytest.raises(LsmGeoError, match="features"):
        unproject(None)


def test_a_whole_number_of_any_length_is_no_finite_number():
    with pytest.raises(OptionError, match="near must be a finite number"):
        Unproject(near=10**400)
