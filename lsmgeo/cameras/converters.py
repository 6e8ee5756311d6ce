"""Cameras from and to other tools, with the half-pixel shift of their principal points.

Tools differ in the direction of the extrinsics, the camera's axes, and the centre of the first pixel. Here: world-to-
camera, x right, y down, z forward, and (0, 0) ("integer"). Tools that put the first pixel's centre at (0.5, 0.5)
("half") report principal points half a pixel larger.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from kornia.geometry.conversions import (
    axis_angle_to_rotation_matrix,
    quaternion_to_rotation_matrix,
    rotation_matrix_to_quaternion,
)
from torch import Tensor

from lsmgeo._checks import (
    check_broadcast,
    check_choice,
    check_devices,
    check_flag,
    check_geometry,
    check_last_axes,
    check_size,
)
from lsmgeo._linalg import homogeneous_row, transform
from lsmgeo.cameras.camera_checks import check_cameras, rotation_error
from lsmgeo.cameras.matrices import is_unskewed, pinhole_matrix
from lsmgeo.cameras.tensors import Cameras, CameraTensors, as_tensors, image_sizes
from lsmgeo.debugging import can_inspect
from lsmgeo.errors import CameraError, ShapeError

__all__ = [
    "ColmapCameras",
    "OpenCVCameras",
    "OpenGLCameras",
    "PyTorch3DCameras",
    "from_colmap",
    "from_opencv",
    "from_opengl",
    "from_pytorch3d",
    "to_colmap",
    "to_opencv",
    "to_opengl",
    "to_pytorch3d",
]

PIXEL_CENTERS = ("integer", "half")
Size = Tensor | int


class OpenCVCameras(NamedTuple):
    """What ``cv2.projectPoints`` takes: intrinsics (..., 3, 3), rotation matrices (..., 3, 3), translation (..., 3)."""

    intrinsics: Tensor
    rotation: Tensor
    translation: Tensor


class OpenGLCameras(NamedTuple):
    """NeRF's cameras: intrinsics (..., 3, 3), camera-to-world (..., 4, 4) with x right, y up, z backwards."""

    intrinsics: Tensor
    world_from_cam: Tensor


class ColmapCameras(NamedTuple):
    """COLMAP's cameras: intrinsics (..., 3, 3), world-to-camera quaternion wxyz (..., 4), translation (..., 3)."""

    intrinsics: Tensor
    quaternion: Tensor
    translation: Tensor


class PyTorch3DCameras(NamedTuple):
    """PyTorch3D's ``PerspectiveCameras``: R (..., 3, 3), T (..., 3), focal length and principal point (..., 2)."""

    R: Tensor
    T: Tensor
    focal_length: Tensor
    principal_point: Tensor


def _shifted(intrinsics: Tensor, pixels: float) -> Tensor:
    shift = intrinsics.new_tensor([[0.0, 0.0, pixels], [0.0, 0.0, pixels], [0.0, 0.0, 0.0]])
    return intrinsics + shift


def _join(who: str, K: Tensor, R: Tensor, t: Tensor, height: Size, width: Size, pixel_center: str) -> CameraTensors:
    check_choice(who, "pixel_center", pixel_center, PIXEL_CENTERS)
    check_last_axes(who, "intrinsics", K, 3, 3)
    K = _shifted(K, -0.5) if pixel_center == "half" else K
    check_devices(who, intrinsics=K, rotation=R, translation=t)
    leading = check_broadcast(who, intrinsics=K.shape[:-2], rotation=R.shape[:-2], translation=t.shape[:-1])
    rows = torch.cat((R.expand(*leading, 3, 3), t[..., None].expand(*leading, 3, 1)), -1)
    cameras = as_tensors(CameraTensors(K.expand(*leading, 3, 3), homogeneous_row(rows), height, width), who)
    check_cameras(who, cameras)
    return cameras


def _split(who: str, cameras: Cameras, pixel_center: str) -> tuple[Tensor, Tensor, Tensor]:
    check_choice(who, "pixel_center", pixel_center, PIXEL_CENTERS)
    tensors = as_tensors(cameras, who)
    check_cameras(who, tensors)
    K = _shifted(tensors.intrinsics, 0.5) if pixel_center == "half" else tensors.intrinsics
    return K, tensors.cam_from_world[..., :3, :3], tensors.cam_from_world[..., :3, 3]


def from_opencv(
    intrinsics: Tensor,
    rotation: Tensor,
    translation: Tensor,
    height: Size,
    width: Size,
    *,
    pixel_center: str = "integer",
) -> CameraTensors:
    """Cameras of OpenCV's calibration functions: ``x ~ K (R X + t)``, with the same axes and pixel centres.

    Args:
        intrinsics: (..., 3, 3) in pixels.
        rotation: (..., 3, 3) matrices, or (..., 3) axis-angle vectors (``rvec``, radians). A shape that ends in (3, 3)
            means vectors if the translation has the same shape (three pairs of rvec and tvec), else matrices.
        translation: (..., 3), world units.
        height: image height in pixels, an int or (...).
        width: image width in pixels, an int or (...).
        pixel_center: "integer" or "half": where the intrinsics put the centre of the first pixel.

    Returns:
        `CameraTensors`, leading shapes broadcast; differentiable.

    Raises:
        ShapeError, DTypeError, CameraError: see `lsmgeo.errors`.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import from_opencv
        >>> K = torch.tensor([[50.0, 0.0, 31.5], [0.0, 50.0, 23.5], [0.0, 0.0, 1.0]])
        >>> camera = from_opencv(K, torch.tensor([0.0, 0.0, torch.pi]), torch.tensor([0.0, 0.0, 2.0]), 48, 64)
        >>> camera.cam_from_world.diagonal().round()
        tensor([-1., -1.,  1.,  1.])
    """
    who = "from_opencv"
    check_geometry(who, "rotation", rotation, "(..., 3) or (..., 3, 3)")
    t = check_last_axes(who, "translation", translation, 3)
    looks_like_matrices = tuple(rotation.shape[-2:]) == (3, 3)
    if looks_like_matrices and rotation.shape == t.shape and can_inspect(rotation):
        if bool((rotation_error(rotation) <= 1e-3).all()):
            raise CameraError(
                f"{who}: rotation must not be three vectors and a matrix at once; expand matrices to the translation's "
                f"leading shape; got {tuple(rotation.shape)} and {tuple(t.shape)}"
            )
    if looks_like_matrices and rotation.shape != t.shape:
        R = rotation
    else:
        vectors = check_last_axes(who, "rotation", rotation, 3)
        R = axis_angle_to_rotation_matrix(vectors.reshape(-1, 3)).reshape(*vectors.shape[:-1], 3, 3)
    return _join(who, intrinsics, R, t, height, width, pixel_center)


def to_opencv(cameras: Cameras, *, pixel_center: str = "integer") -> OpenCVCameras:
    """Inverse of `from_opencv`: intrinsics, rotation matrices (``cv2.Rodrigues`` gives rvec) and translations.

    Args:
        cameras: leading shape (...).
        pixel_center: "integer" or "half", of the returned intrinsics.

    Returns:
        `OpenCVCameras`.

    Example:
        >>> from lsmgeo.cameras import orbit, to_opencv
        >>> to_opencv(orbit(0.0, 0.0, 2.0, focal_length=50.0, height=48, width=64)).translation
        tensor([0., 0., 2.])
    """
    return OpenCVCameras(*_split("to_opencv", cameras, pixel_center))


def from_opengl(
    intrinsics: Tensor, world_from_cam: Tensor, height: Size, width: Size, *, pixel_center: str = "half"
) -> CameraTensors:
    """Cameras of NeRF and Blender files: camera-to-world, OpenGL axes (x right, y up, z backwards).

    Equation: R = F R_gl^T, t = -R C with F = diag(1, -1, -1) and C the last column. A ``transforms.json`` with
    ``camera_angle_x`` has fx = fy = 0.5 width / tan(0.5 camera_angle_x) and its principal point at (width/2, height/2).

    Args:
        intrinsics: (..., 3, 3) in pixels, as if y pointed down (positive focal lengths).
        world_from_cam: (..., 4, 4), rigid.
        height: image height in pixels, an int or (...).
        width: image width in pixels, an int or (...).
        pixel_center: "half" (usual here) or "integer": where the intrinsics put the centre of the first pixel.

    Returns:
        `CameraTensors`, leading shapes broadcast; differentiable.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import from_opengl
        >>> K = torch.tensor([[50.0, 0.0, 32.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]])
        >>> pose = torch.eye(4)
        >>> pose[2, 3] = 2.0  # the camera two units along +z, looking back at the origin
        >>> camera = from_opengl(K, pose, 48, 64)
        >>> camera.cam_from_world[:3, 3], camera.intrinsics[:2, 2]
        (tensor([0., 0., 2.]), tensor([31.5000, 23.5000]))
    """
    who = "from_opengl"
    pose = check_last_axes(who, "world_from_cam", world_from_cam, 4, 4)
    flip = pose.new_tensor([1.0, -1.0, -1.0])
    R = flip[:, None] * pose[..., :3, :3].transpose(-1, -2) + 0.0
    return _join(who, intrinsics, R, 0.0 - transform(R, pose[..., :3, 3]), height, width, pixel_center)


def to_opengl(cameras: Cameras, *, pixel_center: str = "half") -> OpenGLCameras:
    """Inverse of `from_opengl`.

    Args:
        cameras: leading shape (...).
        pixel_center: "half" or "integer", of the returned intrinsics.

    Returns:
        `OpenGLCameras`.

    Example:
        >>> from lsmgeo.cameras import orbit, to_opengl
        >>> to_opengl(orbit(0.0, 0.0, 2.0, focal_length=50.0, height=48, width=64)).world_from_cam[:3, 3]
        tensor([2., 0., 0.])
    """
    K, R, t = _split("to_opengl", cameras, pixel_center)
    inverse = R.transpose(-1, -2)
    center = 0.0 - transform(inverse, t)
    flip = R.new_tensor([1.0, -1.0, -1.0])
    return OpenGLCameras(K, homogeneous_row(torch.cat((inverse * flip + 0.0, center[..., None]), -1)))


def from_colmap(
    intrinsics: Tensor,
    quaternion: Tensor,
    translation: Tensor,
    height: Size,
    width: Size,
    *,
    pixel_center: str = "half",
) -> CameraTensors:
    """Cameras of a COLMAP model: world-to-camera quaternions, axes as here, half-integer pixel centres.

    Args:
        intrinsics: (..., 3, 3) in pixels, from PINHOLE (fx, fy, cx, cy) or SIMPLE_PINHOLE (f, cx, cy) parameters.
        quaternion: (..., 4) as w, x, y, z, of any length above 0.
        translation: (..., 3), world units.
        height: image height in pixels, an int or (...).
        width: image width in pixels, an int or (...).
        pixel_center: "half" (COLMAP's) or "integer": where the intrinsics put the centre of the first pixel.

    Returns:
        `CameraTensors`, leading shapes broadcast; differentiable.

    Raises:
        CameraError: a zero quaternion, or as `lsmgeo.errors` says.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import from_colmap
        >>> K = torch.tensor([[50.0, 0.0, 32.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]])
        >>> camera = from_colmap(K, torch.tensor([1.0, 0.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 2.0]), 48, 64)
        >>> camera.intrinsics[:2, 2]
        tensor([31.5000, 23.5000])
    """
    who = "from_colmap"
    q = check_last_axes(who, "quaternion", quaternion, 4)
    if can_inspect(q) and not bool((q.abs().amax(-1) > 0).all()):
        raise CameraError(f"{who}: quaternion must not be zero")
    R = quaternion_to_rotation_matrix(q.reshape(-1, 4)).reshape(*q.shape[:-1], 3, 3)
    return _join(who, intrinsics, R, check_last_axes(who, "translation", translation, 3), height, width, pixel_center)


def to_colmap(cameras: Cameras, *, pixel_center: str = "half") -> ColmapCameras:
    """Inverse of `from_colmap`; the quaternion's sign is free.

    Args:
        cameras: leading shape (...).
        pixel_center: "half" or "integer", of the returned intrinsics.

    Returns:
        `ColmapCameras`.

    Example:
        >>> from lsmgeo.cameras import orbit, to_colmap
        >>> to_colmap(orbit(90.0, 0.0, 2.0, focal_length=50.0, height=48, width=64)).intrinsics[:2, 2]
        tensor([32., 24.])
    """
    K, R, t = _split("to_colmap", cameras, pixel_center)
    quaternion = rotation_matrix_to_quaternion(R.reshape(-1, 3, 3).contiguous()).reshape(*R.shape[:-2], 4)
    return ColmapCameras(K, quaternion, t)


def from_pytorch3d(
    R: Tensor,
    T: Tensor,
    focal_length: Tensor,
    principal_point: Tensor,
    height: int,
    width: int,
    *,
    in_ndc: bool = True,
) -> CameraTensors:
    """Cameras of PyTorch3D's ``PerspectiveCameras``: row vectors ``X_cam = X R + T``, x left, y up, z forward.

    Equation: with s = min(height, width) / 2, fx = s f_x, cx = width/2 - s p_x in normalised device coordinates
    (``in_ndc=True``); in screen coordinates focal length and principal point are in pixels. Both have half-integer
    pixel centres, so half a pixel is subtracted.

    Args:
        R: (..., 3, 3).
        T: (..., 3).
        focal_length: (..., 2), or (..., 1) for both axes.
        principal_point: (..., 2).
        height: image height in pixels.
        width: image width in pixels.
        in_ndc: whether focal length and principal point are in normalised device coordinates.

    Returns:
        `CameraTensors`, leading shapes broadcast; differentiable.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import from_pytorch3d
        >>> camera = from_pytorch3d(
        ...     torch.eye(3), torch.tensor([0.0, 0.0, 2.0]), torch.tensor([2.0, 2.0]), torch.zeros(2), 48, 64
        ... )
        >>> camera.intrinsics
        tensor([[48.0000,  0.0000, 31.5000],
                [ 0.0000, 48.0000, 23.5000],
                [ 0.0000,  0.0000,  1.0000]])
    """
    who = "from_pytorch3d"
    R, T = check_last_axes(who, "R", R, 3, 3), check_last_axes(who, "T", T, 3)
    check_geometry(who, "focal_length", focal_length, "(..., 2) or (..., 1)")
    principal_point = check_last_axes(who, "principal_point", principal_point, 2)
    if focal_length.dim() < 1 or focal_length.shape[-1] not in (1, 2):
        raise ShapeError(f"{who}: focal_length must be (..., 2) or (..., 1); got {tuple(focal_length.shape)}")
    height, width = check_size(who, "(height, width)", (height, width), 2, "two integers")
    check_flag(who, "in_ndc", in_ndc)
    check_devices(who, R=R, T=T, focal_length=focal_length, principal_point=principal_point)
    check_broadcast(
        who,
        R=R.shape[:-2],
        T=T.shape[:-1],
        focal_length=focal_length.shape[:-1],
        principal_point=principal_point.shape[:-1],
    )
    focal_length, principal_point = torch.broadcast_tensors(focal_length, principal_point)
    if in_ndc:
        scale = 0.5 * min(height, width)
        focal_length = scale * focal_length
        principal_point = principal_point.new_tensor([0.5 * width, 0.5 * height]) - scale * principal_point
    K = pinhole_matrix(*focal_length.unbind(-1), *principal_point.unbind(-1))
    flip = R.new_tensor([-1.0, -1.0, 1.0])
    return _join(who, K, flip[:, None] * R.transpose(-1, -2) + 0.0, flip * T, height, width, "half")


def to_pytorch3d(cameras: Cameras, *, in_ndc: bool = True) -> PyTorch3DCameras:
    """Inverse of `from_pytorch3d`.

    Args:
        cameras: leading shape (...).
        in_ndc: whether to return normalised device coordinates or screen pixels.

    Returns:
        `PyTorch3DCameras`; pass the image size (height, width) to PyTorch3D too.

    Raises:
        CameraError: a camera with skew or a rolled image, which PyTorch3D does not support.

    Example:
        >>> from lsmgeo.cameras import orbit, to_pytorch3d
        >>> to_pytorch3d(orbit(0.0, 0.0, 2.0, focal_length=48.0, height=48, width=64)).focal_length
        tensor([2., 2.])
    """
    who = "to_pytorch3d"
    check_flag(who, "in_ndc", in_ndc)
    tensors = as_tensors(cameras, who)
    K, R, t = _split(who, tensors, "half")
    if can_inspect(K) and not bool((good := is_unskewed(K)).all()):
        index = tuple((~good).nonzero()[0].tolist())
        skew, roll = (float(f"{K[index][place].item():.6g}") for place in ((0, 1), (1, 0)))
        raise CameraError(
            f"{who}: cameras{list(index) if index else ''}: must have no skew and no rolled image, which PyTorch3D "
            f"cannot hold (see cameras.warp); K[0, 1] and K[1, 0] are {skew} and {roll}"
        )
    focal_length = K.diagonal(dim1=-2, dim2=-1)[..., :2]
    principal_point = K[..., :2, 2]
    if in_ndc:
        height, width = image_sizes(tensors)
        size = torch.stack((width, height), -1).to(K.dtype)
        scale = 0.5 * size.amin(-1, keepdim=True)
        focal_length = focal_length / scale
        principal_point = (0.5 * size - principal_point) / scale
    flip = R.new_tensor([-1.0, -1.0, 1.0])
    return PyTorch3DCameras((flip[:, None] * R).transpose(-1, -2) + 0.0, flip * t, focal_length, principal_point)
