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

# What an error must say, and a call that raises it.
MISTAKES = {
    ShapeError: {
        "Unproject: features must be (B, V, C, h, w) with B*V = 8 cameras; got (2, 3, 32, 56, 56), that is 6": lambda: (
            unproject(torch.rand(2, 3, 32, 56, 56), right_cameras(2, 4))
        ),
        "Unproject: features must be (B, V, C, h, w) with B*V = 6 cameras; got (6, 4, 5, 7)": lambda: unproject(
            torch.rand(6, 4, 5, 7)
        ),
        "cameras must have leading shape (B, V) = (3, 2), or (B*V,) with the view fastest; got (2, 3)": lambda: (
            unproject(torch.rand(3, 2, 4, 5, 7))
        ),
        "got (2, 0, 4, 5, 7)": lambda: unproject(torch.rand(2, 0, 4, 5, 7), right_cameras(2, 0)),
        "at least one view": lambda: sweep(views=right_cameras(2, 0)),
        "cameras.cam_from_world must be (..., 4, 4), the whole world-to-camera matrix; got (2, 3, 3, 4)": lambda: (
            unproject(views=VIEWS._replace(cam_from_world=VIEWS.cam_from_world[..., :3, :]))
        ),
        "Unproject: view_mask must be (B, V) = (2, 3); got (3, 2)": lambda: unproject(
            view_mask=torch.ones(V, B, dtype=torch.bool)
        ),
        "Unproject: grid must have one pose and one row of depths, or as many as scenes, B = 2; got 3": lambda: (
            functional.unproject(FEATURES, VIEWS, VoxelGrid(2, world_from_grid=torch.eye(4).expand(3, 4, 4)))
        ),
        "volume must be (B, C, D, H, W) with the grid's (D, H, W) = (6, 4, 3); got (2, 4, 3, 4, 6)": lambda: sweep(
            grid=VoxelGrid((6, 4, 3))
        ),
        "depths must be (B, P) with (B, V) = (2, 3); got (3, 5)": lambda: sweep(depths=DEPTHS.expand(3, 5)),
        "camera must have leading shape () or (B,), one per scene, see cameras.select; got (2, 3)": lambda: FrustumGrid(
            VIEWS, DEPTHS
        ),
        "PlaneSweepProject: size must be (h, w); got tuple (8,)": lambda: sweep(size=(8,)),
        "unproject_points: points must be (B, N, 3) with B = 2; got (3, 5, 3)": lambda: functional.unproject_points(
            FEATURES, VIEWS, torch.zeros(3, 5, 3)
        ),
    },
    DTypeError: {
        "Unproject: features must be of float16, bfloat16, float32, float64; got torch.uint8": lambda: unproject(
            torch.ones(B, V, 3, 5, 7, dtype=torch.uint8)
        ),
        "cameras.intrinsics must be of float32, float64; got torch.float16": lambda: unproject(
            views=VIEWS._replace(intrinsics=VIEWS.intrinsics.half())
        ),
        "of one dtype; got torch.float64 and torch.float32": lambda: unproject(
            views=VIEWS._replace(intrinsics=VIEWS.intrinsics.double())
        ),
        "Unproject: view_mask must be a bool tensor (B, V); got a tensor (2, 3) of torch.float32": lambda: unproject(
            view_mask=torch.ones(B, V)
        ),
        "Unproject: grid must be a VoxelGrid or a FrustumGrid; got a tensor (4, 4) of torch.float32": lambda: Unproject(
            torch.rand(4, 4)
        ),
        "lower must be numbers (gradients go to world_from_grid); got a tensor (3,) of torch.float32": lambda: (
            VoxelGrid(4, lower=torch.zeros(3))
        ),
    },
    DeviceError: {
        "Unproject: all tensors must be on one device; got features on meta, cameras on cpu": lambda: unproject(
            FEATURES.to("meta")
        ),
    },
    CameraError: {
        "Unproject: cameras[1, 0]: intrinsics must be finite": lambda: unproject(
            views=with_value("intrinsics", (1, 0, 0, 2), float("nan"))
        ),
        "Unproject: cameras[0, 2]: cam_from_world must be finite": lambda: unproject(
            views=with_value("cam_from_world", (0, 2, 1, 3), float("inf"))
        ),
        "cameras[0, 1]: intrinsics must be invertible; the determinant of [:2, :2] is 0": lambda: unproject(
            views=with_value("intrinsics", (0, 1, 0, 0), 0.0)
        ),
        "cameras[1, 1]: intrinsics must have the last row (0, 0, 1); its largest deviation is 1": lambda: unproject(
            views=with_value("intrinsics", (1, 1, 2, 2), 2.0)
        ),
        "intrinsics must have the last row (0, 0, 1)": lambda: unproject(
            views=VIEWS._replace(intrinsics=VIEWS.intrinsics.mT)
        ),
        "cam_from_world must have the last row (0, 0, 0, 1)": lambda: unproject(
            views=VIEWS._replace(cam_from_world=VIEWS.cam_from_world.mT)
        ),
        "cameras[1, 2]: the rotation must be orthonormal (a scale in it?); max |R^T R - I| is 0.21": lambda: unproject(
            views=with_scale(rotation=1.1)
        ),
        "cameras[1, 2]: the rotation must not mirror (is an axis flipped?); its determinant is -1": lambda: unproject(
            views=with_scale(first_row=-1.0)
        ),
        "Unproject: cameras.height must be at least 1 pixel": lambda: unproject(views=VIEWS._replace(height=0)),
        "Unproject: cameras[0, 2]: height and width must be at least 1 pixel": lambda: unproject(
            views=VIEWS._replace(width=torch.tensor([[14, 14, 0], [14, 14, 14]]))
        ),
        "from_colmap: quaternion must not be zero": lambda: cameras.from_colmap(
            torch.eye(3), torch.zeros(4), torch.zeros(3), 4, 4
        ),
        "to_pytorch3d: cameras[0, 0]: must have no skew": lambda: cameras.to_pytorch3d(
            with_value("intrinsics", (0, 0, 0, 1), 0.5)
        ),
    },
    OptionError: {
        "Unproject: near must be a finite number, at least 0; got int": lambda: Unproject(near=10**400),
        "Unproject: mode must be one of 'bilinear', 'nearest'; got str 'trilinear'": lambda: unproject(
            mode="trilinear"
        ),
        "Unproject: padding_mode must be one of 'zeros', 'border'; got str 'reflection'": lambda: Unproject(
            padding_mode="reflection"
        ),
        "Unproject: augment must be one of 'depth', 'direction'; got str 'color'": lambda: Unproject(
            augment=("depth", "color")
        ),
        "Unproject: augment must not repeat a name; got ('depth', 'depth')": lambda: Unproject(
            augment=("depth", "depth")
        ),
        "Unproject: reduce must be one of 'mean', 'variance', 'max'; got str 'median'": lambda: Unproject(
            reduce="median"
        ),
        "Unproject: near must be a finite number, at least 0; got float -1.0": lambda: Unproject(near=-1.0),
        "Unproject: backend must be one of 'auto', 'cpu', 'triton', 'reference'; got str 'cuda'": lambda: Unproject(
            backend="cuda"
        ),
    },
    GridError: {
        "Unproject: grid must be given to the layer or to the call; got None": lambda: Unproject()(FEATURES, VIEWS),
        "PlaneSweepProject: depths must be given to the layer or to the call; got None": lambda: PlaneSweepProject(
            GRID
        )(VOLUME, VIEWS),
        "depths must be positive, finite and strictly ascending; got [3.0, 2.5, 2.0, 1.5, 1.0]": lambda: sweep(
            depths=DEPTHS.flip(0)
        ),
        "depths must be positive, finite and strictly ascending; got [1.0, 1.0]": lambda: sweep(
            depths=torch.tensor([[1.0, 2.0], [1.0, 1.0]])
        ),
        "FrustumGrid: depths must be positive, finite and strictly ascending; got [0.0, 1.0]": lambda: FrustumGrid(
            right_cameras(B), torch.tensor([0.0, 1.0])
        ),
        "VoxelGrid: shape must be an int or (D, H, W), each at least 1; got (4, 0, 4)": lambda: VoxelGrid((4, 0, 4)),
        "got (2048, 1024, 1024)": lambda: VoxelGrid((2**11, 2**10, 2**10)),
        "VoxelGrid: lower must be below upper on every axis; got 0.0 and -1.0 in y": lambda: VoxelGrid(
            4, (0, 0, 0), (1, -1, 1)
        ),
        "VoxelGrid: world_from_grid must be invertible": lambda: VoxelGrid(
            4, world_from_grid=torch.diag(torch.tensor([1.0, 1.0, 0.0, 1.0]))
        ),
        "VoxelGrid: world_from_grid must be affine, its last row (0, 0, 0, 1)": lambda: VoxelGrid(
            4, world_from_grid=torch.ones(4, 4)
        ),
        "depth_planes: near and far must be positive, finite and ascending; got 3.0 and 1.0": lambda: depth_planes(
            3.0, 1.0, 4
        ),
        "depth_planes: num must be an integer": lambda: depth_planes(1.0, 3.0, 0),
        "unproject_points: points must be finite": lambda: functional.unproject_points(
            FEATURES, VIEWS, torch.full((B, 5, 3), torch.nan)
        ),
    },
}


@pytest.mark.parametrize(("kind", "text"), [(kind, text) for kind, calls in MISTAKES.items() for text in calls])
def test_the_message(kind, text):
    with pytest.raises(kind, match=re.escape(text)):
        MISTAKES[kind][text]()


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
