"""The frame of an object in a scene, and crops of images as in training: a similarity and a window."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from lsmgeo.cameras import CameraTensors, centers, crop, project, resize, stack
from lsmgeo.classical.gathering import fitted, resized
from lsmgeo.classical.silhouettes import signed_distance
from lsmgeo.classical.views import common_point
from lsmgeo.classical.visual_hull import hull_box, visual_hull
from lsmgeo.errors import OptionError
from lsmgeo.grids import VoxelGrid

if TYPE_CHECKING:
    from lsmgeo.data import PosedImages

__all__ = [
    "DISTANCE",
    "Crop",
    "ObjectFrame",
    "crop_view",
    "estimate_object_box",
    "frame_of_box",
    "in_model_frame",
    "object_distances",
    "spread_views",
]

# As in training: cameras are 2 units from the centre of a unit cube, and see 16/15 of a unit there (f = 1.875 W).
DISTANCE, FIELD = 2.0, 16 / 15
# An image whose window differs by less than this fraction of its size is used whole: its pixels stay as they are.
WHOLE = 0.1
# Below this spread of the horizontal axes of the cameras, up is that of the images.
LEAST_SPREAD = 0.02
LEAST_POINTS, QUANTILES, SHARED = 20, (2, 98), 0.8
# Pixels along the longer side of a silhouette, and voxels along a side of the hull, to estimate the box of the object.
LONGEST_SIDE, COARSE = 256, 48
# An object is rotated about the vertical where that makes its box smaller by this factor.
LEAST_GAIN = 0.9
# Cameras are placed as in training if their distances to their common point differ by less than EVEN, the box of the
# object has about the size that these imply (that from silhouettes may be larger), and its centre is near the point.
EVEN, ALIKE, BESIDE = 0.01, (0.9, 1.6), 0.2
ORIGIN = torch.zeros(1, 1, 3, dtype=torch.float64)


class ObjectFrame(NamedTuple):
    """The cube of a scene that becomes the unit cube of the models, at the origin and with y up."""

    center: np.ndarray  # (3,) world
    side: float  # world units
    rotation: np.ndarray  # (3, 3) rotation, model from scene
    inferred_from: str

    def scene_from_model(self) -> Tensor:
        """(4, 4) float64: X_scene = side rotation^T X_model + center."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.side * self.rotation.T, self.center
        return torch.from_numpy(matrix)


class Crop(NamedTuple):
    """An image as the input of a model."""

    image: Tensor  # (3, size, size), white outside the original image, and off the object where a mask is known
    mask: Tensor | None  # (size, size) bool
    inside: Tensor  # (size, size) bool: within the original image
    camera: CameraTensors  # in the scene, for these pixels


def estimate_object_box(scene: PosedImages, masks: Sequence[Tensor] | None, views: Sequence[int]) -> ObjectFrame:
    """Estimate position, size and rotation of the object.

    From silhouettes: the box around their hull, rotated about the vertical so that it is smallest, as objects are along
    the axes in training; its diagonal becomes 1. Without silhouettes, the same from the sparse points that most images
    show. Without either, the object is where the cameras look, and fills their images. If the cameras are placed about
    the box as in training, all at one distance of about 2, position and size are those that the cameras imply, which
    are more accurate than those from silhouettes. The masks are (H, W) bool, of the ``views``.

    Raises:
        OptionError: the cameras look at no common point.
    """
    rotation = _up_rotation(scene.cameras)
    upright = in_model_frame(scene.cameras, ObjectFrame(np.zeros(3), 1.0, rotation, ""))
    points, inferred_from, trimmed = None, "silhouettes", (0, 100)
    if masks is not None:
        try:
            points = _hull_points(masks, upright.at(list(views)))
        except OptionError:
            pass  # from one direction, or inconsistent: points or cameras are better
    if points is None and scene.points is not None:
        points, inferred_from, trimmed = scene.points.positions @ rotation.T, "sparse points", QUANTILES
        points = points[project(upright, torch.from_numpy(points)[None]).visible[0].double().mean(0) >= SHARED]
    if points is not None and len(points) >= LEAST_POINTS:
        frame = _frame_of_points(points, trimmed, rotation, inferred_from)
        return _as_trained(scene, frame) or frame
    return _frame_of_cameras(scene, upright, rotation)


def frame_of_box(scene: PosedImages, box: Sequence[float]) -> ObjectFrame:
    """The frame of a cube at x, y, z with a given side, rotated so that y is up."""
    return ObjectFrame(np.array(box[:3], float), float(box[3]), _up_rotation(scene.cameras), "the given box")


def in_model_frame(cameras: CameraTensors, frame: ObjectFrame) -> CameraTensors:
    """The cameras in the frame in which the object is the unit cube.

    Equation: with X_scene = c + l Q^T X, X_cam = R X_scene + t becomes X_cam / l = R Q^T X + (R c + t) / l.

    Cameras have any leading shape; the result is rigid, float64, and pixels do not change.
    """
    E = cameras.cam_from_world.double()
    rotation, center = torch.from_numpy(frame.rotation), torch.from_numpy(np.asarray(frame.center, float))
    moved = E.clone()
    moved[..., :3, :3] = E[..., :3, :3] @ rotation.T
    moved[..., :3, 3] = (E[..., :3, :3] @ center + E[..., :3, 3]) / frame.side
    return cameras._replace(intrinsics=cameras.intrinsics.double(), cam_from_world=moved)


def object_distances(scene: PosedImages, frame: ObjectFrame) -> tuple[np.ndarray, np.ndarray]:
    """Distance of the object from each camera, in sizes of the object, and whether its centre is in the image."""
    _, z, visible = project(in_model_frame(scene.cameras, frame), ORIGIN)
    return z[0, :, 0].numpy(), visible[0, :, 0].numpy()


def spread_views(scene: PosedImages, frame: ObjectFrame, usable: Sequence[int], count: int) -> list[int]:
    """Views from all around: the first, and then always the one whose direction is farthest from the chosen ones.

    At most ``count`` of the ``usable`` views are chosen.
    """
    directions = centers(scene.cameras).numpy() - frame.center
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    chosen, left = [usable[0]], list(usable[1:])
    while left and len(chosen) < count:
        nearest = (directions[left] @ directions[chosen].T).max(1)
        chosen.append(left.pop(int(nearest.argmin())))
    return chosen


def crop_view(scene: PosedImages, view: int, frame: ObjectFrame, size: int, mask: Tensor | None = None) -> Crop:
    """Crop an image, pad it with white and resize it to a square in which the object is as large as in training.

    The window has whole pixels, and the camera is cropped and resized with it: the geometry is exact. Off the ``mask``
    (H, W) bool, the silhouette of the object, the image becomes white. Raises `DataError` if it cannot be read.
    """
    image = scene.load(view)
    if mask is not None and not scene.cut_out:  # a cut-out image is on white already, with soft edges
        image = torch.where(mask, image, 1.0)
    camera = scene.camera(view)
    pixels, z, _ = project(in_model_frame(camera.at(None), frame), ORIGIN)
    (x, y), depth = pixels[0, 0, 0].tolist(), float(z)
    rows, columns = image.shape[-2:]
    sides = [max(1, round(FIELD * float(camera.intrinsics[axis, axis]) / depth)) for axis in (1, 0)]
    top, left = (round(middle - (side - 1) / 2) for middle, side in zip((y, x), sides, strict=True))
    height, width = sides
    ends = ((top, 0, rows), (left, 0, columns), (top + height, rows, rows), (left + width, columns, columns))
    if rows == columns and all(abs(one - other) <= WHOLE * side for one, other, side in ends):
        top, left, height, width = 0, 0, rows, columns
    inside = torch.ones(1, rows, columns)
    window = (left, left + width, top, top + height)
    parts = [_cut(image, window, 1.0), _cut(inside, window, 0.0)]
    if mask is not None:
        parts.append(_cut(mask[None].float(), window, 0.0))
    image, inside, *masks = (resized(part, (size, size)) for part in parts)
    camera = resize(crop(camera, top, left, height, width), size, size)
    return Crop(image, masks[0][0] > 0.5 if masks else None, inside[0] > 0.5, camera)


def _cut(image: Tensor, window: tuple[int, int, int, int], filling: float) -> Tensor:
    """A window (left, right, top, bottom) of an image (C, H, W); it may reach beyond the image."""
    left, right, top, bottom = window
    rows, columns = image.shape[-2:]
    return pad(image, (-left, right - columns, -top, bottom - rows), value=filling)  # a negative padding crops


def _hull_points(masks: Sequence[Tensor], cameras: CameraTensors) -> np.ndarray:
    """The corners (N, 3) of the voxels of a coarse hull."""
    sizes = [fitted(mask.shape, LONGEST_SIDE) for mask in masks]
    small = [resized(mask[None].float(), size)[0] > 0.5 for mask, size in zip(masks, sizes, strict=True)]
    views = stack([resize(cameras.at(view), *size) for view, size in enumerate(sizes)])
    low, high = (np.array(corner) for corner in hull_box(small, views, margin=0.0))
    grid = VoxelGrid(COARSE, low.tolist(), high.tolist())
    # An object that is cut off by the border of an image continues beyond it.
    carved = visual_hull(
        [signed_distance(mask) for mask in small], views, grid, rule="all", threshold=0.0, outside="unknown"
    ).occupancy
    centers = grid.centers()[carved].double().numpy()
    half = (high - low) / COARSE / 2
    return np.concatenate([centers - half, centers + half])


def _frame_of_points(
    points: np.ndarray, trimmed: tuple[int, int], rotation: np.ndarray, inferred_from: str
) -> ObjectFrame:
    """The frame of the box of points (N, 3) of the upright scene, rotated about the vertical if that is smaller."""
    from scipy.spatial.transform import Rotation

    boxes = {}
    for angle in range(-45, 45):
        low, high = np.percentile(Rotation.from_euler("y", angle, degrees=True).apply(points), trimmed, axis=0)
        boxes[angle] = float((high - low)[[0, 2]].prod()), low, high
    best = min(boxes, key=lambda angle: boxes[angle][0])
    if boxes[best][0] > LEAST_GAIN * boxes[0][0]:
        best = 0
    rotation = Rotation.from_euler("y", best, degrees=True).as_matrix() @ rotation
    _, low, high = boxes[best]
    return ObjectFrame(
        rotation.T @ ((low + high) / 2), max(float(np.linalg.norm(high - low)), 1e-12), rotation, inferred_from
    )


def _as_trained(scene: PosedImages, frame: ObjectFrame) -> ObjectFrame | None:
    """The frame in which cameras are placed exactly as in training; None unless they nearly are."""
    if len(scene) < 2:
        return None
    focus = common_point(scene.cameras)
    away = np.linalg.norm(centers(scene.cameras).numpy() - focus, axis=1)
    side = float(np.median(away)) / DISTANCE
    is_even = np.abs(away / side - DISTANCE).max() < EVEN * DISTANCE
    is_alike = ALIKE[0] < frame.side / side < ALIKE[1]
    if is_even and is_alike and np.linalg.norm(focus - frame.center) < BESIDE * side:
        return frame._replace(center=focus, side=side, inferred_from=f"{frame.inferred_from} and cameras")
    return None


def _frame_of_cameras(scene: PosedImages, upright: CameraTensors, rotation: np.ndarray) -> ObjectFrame:
    """The frame of a cube at the common point of the cameras that fills their images."""
    origins, focus = centers(upright).numpy(), common_point(upright)
    K, size = upright.intrinsics.numpy(), np.stack([torch.as_tensor(part).numpy() for part in upright[2:]], -1)
    away = project(upright, torch.from_numpy(focus)[None, None]).depth[0, :, 0].numpy()
    extents = away * np.minimum(size[:, 0] / K[:, 1, 1], size[:, 1] / K[:, 0, 0])
    side = float(np.median(extents)) / FIELD
    spread = float(np.linalg.norm(origins - origins[0], axis=1).max())
    if len(scene) < 2 or not side > 0 or not spread > 1e-3 * np.median(away):
        raise OptionError("the object cannot be located: the cameras look at no common point; give box")
    return ObjectFrame(rotation.T @ focus, side, rotation, "the point that the cameras look at")


def _up_rotation(cameras: CameraTensors) -> np.ndarray:
    """The smallest rotation (3, 3) that maps up in a scene to y.

    Up is perpendicular to the horizontal axes of all cameras; if these are too similar, it is the up of the images.
    """
    from scipy.spatial.transform import Rotation

    R = cameras.cam_from_world[:, :3, :3].double().numpy()
    across, mean = R[:, 0], -R[:, 1].mean(0)
    spreads, axes = np.linalg.eigh(across.T @ across / len(across))
    up = axes[:, 0] if spreads[1] > LEAST_SPREAD else mean
    up = up / np.linalg.norm(up) * (-1 if up @ mean < 0 else 1)
    if up[1] < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    return np.asarray(Rotation.align_vectors([[0.0, 1.0, 0.0]], [up])[0].as_matrix())
