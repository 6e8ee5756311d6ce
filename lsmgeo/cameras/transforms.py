"""Functions that create, move, resize and crop cameras."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor
from torch.nn.functional import pad

from lsmgeo._checks import (
    GEOMETRY,
    check_broadcast,
    check_devices,
    check_finite,
    check_geometry,
    check_last_axes,
    check_number,
    check_size,
    describe,
)
from lsmgeo._linalg import cross, homogeneous_row, multiply, transform
from lsmgeo.cameras.camera_checks import check_cameras
from lsmgeo.cameras.matrices import pinhole_matrix, resize_matrix
from lsmgeo.cameras.tensors import Cameras, CameraTensors, as_tensors, image_sizes, leading_shape
from lsmgeo.debugging import can_inspect
from lsmgeo.errors import CameraError, DeviceError, DTypeError, OptionError, ShapeError

__all__ = ["crop", "look_at", "orbit", "perturb", "resize"]

Vector = Tensor | Sequence[float]


def resize(cameras: Cameras, height: int, width: int) -> CameraTensors:
    """Cameras of the same images resized to (height, width).

    Equation: with sx = width'/width, fx' = fx sx, skew' = skew sx, cx' = (cx + 0.5) sx - 0.5; the same in y.

    Convention:
        Integer pixel centres; both images tile the same area. kornia's ``PinholeCamera.scale`` differs (kornia issue
        4263).

    Args:
        cameras: any number of cameras.
        height: new height in pixels.
        width: new width in pixels.

    Returns:
        `CameraTensors` of the new size; differentiable.

    Raises:
        ShapeError: a size below 1.

    Example:
        >>> from lsmgeo.cameras import orbit, resize
        >>> camera = orbit(0.0, 10.0, 2.0, focal_length=100.0, height=48, width=64)
        >>> resize(camera, 24, 32).intrinsics
        tensor([[50.0000,  0.0000, 15.5000],
                [ 0.0000, 50.0000, 11.5000],
                [ 0.0000,  0.0000,  1.0000]])
    """
    height, width = check_size("resize", "(height, width)", (height, width), 2, "two integers")
    tensors = as_tensors(cameras, "resize")
    scale = resize_matrix(*image_sizes(tensors), height, width, tensors.intrinsics.dtype)
    return _of_size(tensors, multiply(scale, tensors.intrinsics), height, width)


def crop(cameras: Cameras, top: int | Tensor, left: int | Tensor, height: int, width: int) -> CameraTensors:
    """Cameras of windows of the same images (or of padded images, if top or left is negative).

    Equation: cx' = cx - left, cy' = cy - top.

    Args:
        cameras: leading shape (...).
        top: first row of the window, a number or (...).
        left: first column of the window, a number or (...).
        height: rows of the window.
        width: columns of the window.

    Returns:
        `CameraTensors` of the windows.

    Raises:
        ShapeError: a size below 1.

    Example:
        >>> from lsmgeo.cameras import crop, orbit
        >>> camera = orbit(0.0, 10.0, 2.0, focal_length=100.0, height=48, width=64)
        >>> crop(camera, 8, 16, 32, 32).intrinsics[:2, 2]
        tensor([15.5000, 15.5000])
    """
    height, width = check_size("crop", "(height, width)", (height, width), 2, "two integers")
    tensors = as_tensors(cameras, "crop")
    K, leading = tensors.intrinsics, leading_shape(tensors)
    x, y = (_number("crop", name, side, K, leading).to(K.dtype) for name, side in (("left", left), ("top", top)))
    check_devices("crop", cameras=K, left=x, top=y)
    offset = torch.stack((x.expand(leading), y.expand(leading)), -1)[..., None]
    return _of_size(tensors, K - pad(offset, (2, 0, 0, 1)), height, width)


def _of_size(cameras: CameraTensors, intrinsics: Tensor, height: int, width: int) -> CameraTensors:
    sizes = (torch.full_like(old, new) for old, new in zip(image_sizes(cameras), (height, width), strict=True))
    return CameraTensors(intrinsics, cameras.cam_from_world, *sizes)


def _vector(who: str, name: str, value: Vector, like: Tensor | None = None) -> Tensor:
    if not isinstance(value, Tensor):
        dtype, device = (like.dtype, like.device) if like is not None else (None, None)
        try:
            value = torch.as_tensor(value, dtype=dtype or torch.get_default_dtype(), device=device)
        except (TypeError, ValueError) as error:
            raise OptionError(f"{who}: {name} must be x, y, z; got {value!r}") from error
    check_last_axes(who, name, value, 3)
    if can_inspect(value):
        check_finite(who, name, value)
    return value


def _number(who: str, name: str, value: float | Tensor, like: Tensor, leading: Sequence[int] | None = None) -> Tensor:
    """A number or a tensor of numbers as a finite tensor, which broadcasts to `leading` if given."""
    if isinstance(value, Tensor):
        check_geometry(who, name, value, "a number or a tensor", dtypes=(*GEOMETRY, torch.int32, torch.int64))
        value = value.to(like.dtype) if not value.is_floating_point() else value
    else:
        value = like.new_tensor(check_number(who, name, value, "a finite number"))
    if leading is not None and check_broadcast(who, cameras=leading, **{name: value.shape}) != tuple(leading):
        raise ShapeError(f"{who}: {name} must broadcast to the cameras' {tuple(leading)}; got {tuple(value.shape)}")
    if can_inspect(value):
        check_finite(who, name, value)
    return value


def look_at(eye: Vector, target: Vector = (0.0, 0.0, 0.0), up: Vector = (0.0, 1.0, 0.0)) -> Tensor:
    """World-to-camera matrices of cameras at `eye` that look at `target`, with `up` upwards in the image.

    Equation: z = normalize(target - eye), x = normalize(z x up), y = z x x are the rows of R; t = -R eye.

    Args:
        eye: (..., 3) camera centres, world units.
        target: (..., 3) points on the optical axes.
        up: (..., 3) world directions, not along the optical axis.

    Returns:
        ``cam_from_world``, (..., 4, 4); differentiable in all arguments.

    Raises:
        CameraError: eye equals target, or up is along the optical axis.

    Example:
        >>> from lsmgeo.cameras import look_at
        >>> look_at((0.0, 0.0, -2.0))
        tensor([[-1.,  0.,  0.,  0.],
                [ 0., -1.,  0.,  0.],
                [ 0.,  0.,  1.,  2.],
                [ 0.,  0.,  0.,  1.]])
    """
    who = "look_at"
    eye = _vector(who, "eye", eye)
    target, up = _vector(who, "target", target, eye), _vector(who, "up", up, eye)
    check_devices(who, eye=eye, target=target, up=up)
    check_broadcast(who, eye=eye.shape[:-1], target=target.shape[:-1], up=up.shape[:-1])
    return _facing(who, "eye, target and up", eye, target, up)


def _facing(who: str, names: str, eye: Tensor, target: Tensor, up: Tensor) -> Tensor:
    forward = target - eye
    right = cross(forward, up)
    if can_inspect(right):
        scale = torch.linalg.vector_norm(forward, dim=-1) * torch.linalg.vector_norm(up, dim=-1)
        if not bool((torch.linalg.vector_norm(right, dim=-1) > 1e-6 * scale).all()):
            cause = "up is parallel to the viewing direction, or one of them is 0"
            raise CameraError(f"{who}: {names} must span a plane ({cause})")
    z = forward / torch.linalg.vector_norm(forward, dim=-1, keepdim=True)
    x = right / torch.linalg.vector_norm(right, dim=-1, keepdim=True)
    R = torch.stack(torch.broadcast_tensors(x, cross(z, x), z), -2) + 0.0  # + 0.0: no negative zeros
    return homogeneous_row(torch.cat((R, (0.0 - transform(R, eye))[..., None]), -1))


def orbit(
    azimuth: float | Tensor,
    elevation: float | Tensor,
    distance: float | Tensor,
    *,
    focal_length: float | Tensor,
    height: int,
    width: int,
    target: Vector = (0.0, 0.0, 0.0),
) -> CameraTensors:
    """Cameras on a sphere around a target, y up, all looking at the target.

    Equation: C = target + distance (cos e cos a, sin e, cos e sin a), azimuth and elevation as in ShapeNet renderings.

    Args:
        azimuth: degrees, a number or (...).
        elevation: degrees in (-90, 90), a number or (...).
        distance: world units, a number or (...).
        focal_length: pixels, a number or (...); fx = fy.
        height: pixels.
        width: pixels; the principal point is the image centre ((width - 1) / 2, (height - 1) / 2).
        target: (3,) or (..., 3).

    Returns:
        `CameraTensors`, whose leading shape is the arguments' common shape (...).

    Raises:
        CameraError: an elevation of 90 degrees, a distance of 0.
        ShapeError: a size below 1.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import orbit
        >>> cameras = orbit(torch.tensor([0.0, 90.0]), 0.0, 2.0, focal_length=100.0, height=48, width=64)
        >>> cameras.cam_from_world[0]
        tensor([[ 0.,  0., -1.,  0.],
                [ 0., -1.,  0.,  0.],
                [-1.,  0.,  0.,  2.],
                [ 0.,  0.,  0.,  1.]])
    """
    who = "orbit"
    height, width = check_size(who, "(height, width)", (height, width), 2, "two integers")
    given = {"azimuth": azimuth, "elevation": elevation, "distance": distance, "focal_length": focal_length}
    like = next((x for x in given.values() if isinstance(x, Tensor) and x.dtype in GEOMETRY), torch.zeros(()))
    numbers = {name: _number(who, name, value, like) for name, value in given.items()}
    target = _vector(who, "target", target, like)
    check_devices(who, **numbers, target=target)
    check_broadcast(who, **{name: value.shape for name, value in numbers.items()}, target=target.shape[:-1])
    *angles, radius, focal = torch.broadcast_tensors(*numbers.values())
    a, e = map(torch.deg2rad, angles)
    direction = torch.stack((e.cos() * a.cos(), e.sin(), e.cos() * a.sin()), -1)
    eye = target + radius[..., None] * direction
    up = eye.new_tensor([0.0, 1.0, 0.0])
    cam_from_world = _facing(who, "azimuth, elevation, distance and target", eye, target.expand_as(eye), up)
    middle = (torch.full_like(focal, 0.5 * side - 0.5) for side in (width, height))
    intrinsics = pinhole_matrix(focal, focal, *middle).expand(*eye.shape[:-1], 3, 3)
    cameras = as_tensors(CameraTensors(intrinsics, cam_from_world, height, width), who)
    check_cameras(who, cameras)
    return cameras


def perturb(
    cameras: Cameras,
    degrees: float,
    *,
    target: Vector = (0.0, 0.0, 0.0),
    generator: torch.Generator | None = None,
) -> CameraTensors:
    """Rotate each camera about a target at random: pose noise under which it keeps looking at the object.

    Equation: X_cam = R dR (X - target) + R target + t with dR a rotation about a uniformly random axis by an angle
    uniform in [-degrees, degrees]; the target keeps its place in the image.

    Args:
        cameras: leading shape (...).
        degrees: largest angle.
        target: (3,) or (..., 3), world units: what the cameras look at.
        generator: random number generator on the cameras' device.

    Returns:
        `CameraTensors`, each with its own rotation.

    Raises:
        OptionError: a negative or infinite angle.

    Example:
        >>> import torch
        >>> from lsmgeo.cameras import orbit, perturb
        >>> cameras = orbit(torch.tensor([0.0, 90.0]), 20.0, 2.0, focal_length=100.0, height=48, width=64)
        >>> noisy = perturb(cameras, 5.0, generator=torch.Generator().manual_seed(0))
        >>> torch.allclose(noisy.cam_from_world[:, :3, 3], cameras.cam_from_world[:, :3, 3])
        True
    """
    who = "perturb"
    degrees = check_number(who, "degrees", degrees, "a number of degrees from 0 to 180", 0, 180)
    if generator is not None and not isinstance(generator, torch.Generator):
        raise DTypeError(f"{who}: generator must be a torch.Generator or None; got {describe(generator)}")
    tensors = as_tensors(cameras, who)
    E, leading = tensors.cam_from_world, leading_shape(tensors)
    if generator is not None and generator.device.type != E.device.type:
        raise DeviceError(f"{who}: generator must be on the cameras' {E.device}; got one on {generator.device}")
    target = _vector(who, "target", target, E)
    check_devices(who, cameras=E, target=target)
    if check_broadcast(who, cameras=leading, target=target.shape[:-1]) != leading:
        raise ShapeError(f"{who}: target must broadcast to the cameras' {leading}; got {tuple(target.shape)}")
    axis = torch.randn(*leading, 3, generator=generator, dtype=E.dtype, device=E.device)
    axis = axis / torch.linalg.vector_norm(axis, dim=-1, keepdim=True).clamp_min(torch.finfo(E.dtype).tiny)
    angle = torch.rand(*leading, 1, generator=generator, dtype=E.dtype, device=E.device) * 2.0 - 1.0
    dR = axis_angle_to_rotation_matrix((axis * angle * torch.pi * degrees / 180.0).reshape(-1, 3))
    dR = dR.reshape(*leading, 3, 3)
    R, t = E[..., :3, :3], E[..., :3, 3]
    offset = target.expand(*leading, 3) - transform(dR, target.expand(*leading, 3))
    rows = torch.cat((multiply(R, dR), (transform(R, offset) + t)[..., None]), -1)
    noisy = tensors._replace(cam_from_world=homogeneous_row(rows))
    check_cameras(who, noisy)
    return noisy
