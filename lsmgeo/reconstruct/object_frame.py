"""Where an object lies in a scene, and photographs of it as the models were trained on: a similarity and a crop."""

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
    "Framed",
    "Placement",
    "frame_view",
    "in_model_frame",
    "place_box",
    "place_object",
    "seen_from",
    "spread_views",
]

# As in training: cameras are 2 units from the middle of a unit cube, and see 16/15 of a unit there (f = 1.875 W).
DISTANCE, FIELD = 2.0, 16 / 15
# A photograph whose window differs by less than that fraction of its size is taken whole: its pixels stay as they are.
WHOLE = 0.1
# Below that spread of the cameras' horizontal axes they do not tell what is up; the photographs' own up does.
LEAST_SPREAD = 0.02
LEAST_POINTS, QUANTILES, SHARED = 20, (2, 98), 0.8
# Pixels along an outline's longer side, and voxels along a side of the hull, from which the object's box is told.
OUTLINE, COARSE = 256, 48
# An object is turned about the vertical where that makes its box this much smaller.
LEAST_GAIN = 0.9
# To stand as in training, cameras must be that evenly far from what they look at, about which the object must be; its
# box as outlines tell it may be larger than it, by far where all look from one height.
EVEN, ALIKE, BESIDE = 0.01, (0.9, 1.6), 0.2
ORIGIN = torch.zeros(1, 1, 3, dtype=torch.float64)


class Placement(NamedTuple):
    """The cube of a scene that becomes the models' unit cube at the origin, y up."""

    center: np.ndarray  # (3,) world
    side: float  # world units
    turn: np.ndarray  # (3, 3) rotation, model from scene
    told_by: str

    def scene_from_model(self) -> Tensor:
        """(4, 4) float64: X_scene = side turn^T X_model + center."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.side * self.turn.T, self.center
        return torch.from_numpy(matrix)


class Framed(NamedTuple):
    """A photograph as a model takes it."""

    image: Tensor  # (3, size, size), white where nothing was photographed, and off the object where masks are known
    mask: Tensor | None  # (size, size) bool
    inside: Tensor  # (size, size) bool: photographed at all
    camera: CameraTensors  # of the scene, for these pixels


def place_object(scene: PosedImages, masks: Sequence[Tensor] | None, views: Sequence[int]) -> Placement:
    """Tell where the object is, how large, and how it stands.

    From silhouettes: the box around their hull, turned about the vertical so that it is smallest, as the objects
    trained on stand along the axes; its diagonal becomes 1, as theirs. Else likewise from the sparse points that most
    photographs show. Else the cameras look at it, and it fills their pictures. Where the cameras stand about the box as
    they do in training, all at one distance of about 2, their word is taken for the place and the size, which is
    better than what outlines can tell.

    Args:
        scene: posed photographs.
        masks: (H, W) bool of the views, or None.
        views: those that masks are of.

    Raises:
        OptionError: nothing tells it.
    """
    turn = _upright(scene.cameras)
    turned = in_model_frame(scene.cameras, Placement(np.zeros(3), 1.0, turn, ""))
    points, told_by, trimmed = None, "silhouettes", (0, 100)
    if masks is not None:
        try:
            points = _hull_points(masks, turned.at(list(views)))
        except OptionError:
            pass  # from one direction, or they do not belong together: what is left tells more
    if points is None and scene.points is not None:
        points, told_by, trimmed = scene.points.positions @ turn.T, "sparse points", QUANTILES
        points = points[project(turned, torch.from_numpy(points)[None]).visible[0].double().mean(0) >= SHARED]
    if points is not None and len(points) >= LEAST_POINTS:
        placement = _around(points, trimmed, turn, told_by)
        return _as_trained(scene, placement) or placement
    return _looked_at(scene, turned, turn)


def place_box(scene: PosedImages, box: Sequence[float]) -> Placement:
    """The cube about x, y, z with a given side, turned so that y is up."""
    return Placement(np.array(box[:3], float), float(box[3]), _upright(scene.cameras), "the box that was given")


def in_model_frame(cameras: CameraTensors, placement: Placement) -> CameraTensors:
    """The same photographs' cameras where the object is the unit cube: turned, moved, and all lengths divided.

    Equation: with X_scene = c + l Q^T X, X_cam = R X_scene + t becomes X_cam / l = R Q^T X + (R c + t) / l.

    Args:
        cameras: of a scene, any leading shape.
        placement: of the object in it.

    Returns:
        Rigid cameras, float64; pixels are what they were.
    """
    E = cameras.cam_from_world.double()
    turn, center = torch.from_numpy(placement.turn), torch.from_numpy(np.asarray(placement.center, float))
    moved = E.clone()
    moved[..., :3, :3] = E[..., :3, :3] @ turn.T
    moved[..., :3, 3] = (E[..., :3, :3] @ center + E[..., :3, 3]) / placement.side
    return cameras._replace(intrinsics=cameras.intrinsics.double(), cam_from_world=moved)


def seen_from(scene: PosedImages, placement: Placement) -> tuple[np.ndarray, np.ndarray]:
    """How far in front of each camera the object is, in its own sizes, and whether its middle is in the picture."""
    _, z, visible = project(in_model_frame(scene.cameras, placement), ORIGIN)
    return z[0, :, 0].numpy(), visible[0, :, 0].numpy()


def spread_views(scene: PosedImages, placement: Placement, usable: Sequence[int], count: int) -> list[int]:
    """Views from all around: the first, and then always the one whose direction is farthest from those taken.

    Args:
        scene: posed photographs.
        placement: of the object.
        usable: views to choose from, the first of which is taken first.
        count: how many at most.
    """
    directions = centers(scene.cameras).numpy() - placement.center
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    chosen, left = [usable[0]], list(usable[1:])
    while left and len(chosen) < count:
        nearest = (directions[left] @ directions[chosen].T).max(1)
        chosen.append(left.pop(int(nearest.argmin())))
    return chosen


def frame_view(scene: PosedImages, view: int, placement: Placement, size: int, mask: Tensor | None = None) -> Framed:
    """One photograph cut, padded with white and resized to a square in which the object is as large as in training.

    The window has whole pixels, and the camera is cropped and resized with it: geometry stays exact.

    Args:
        scene: posed photographs.
        view: which.
        placement: of the object.
        size: side of the square.
        mask: (H, W) bool, the object's silhouette; the rest becomes white.

    Raises:
        DataError: the photograph cannot be read.
    """
    image = scene.load(view)
    if mask is not None and not scene.cut_out:  # a cut-out photograph is before white already, with soft edges
        image = torch.where(mask, image, 1.0)
    camera = scene.camera(view)
    pixels, z, _ = project(in_model_frame(camera.at(None), placement), ORIGIN)
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
    return Framed(image, masks[0][0] > 0.5 if masks else None, inside[0] > 0.5, camera)


def _cut(picture: Tensor, window: tuple[int, int, int, int], filling: float) -> Tensor:
    """A window (left, right, top, bottom) of (C, H, W), which may reach beyond it."""
    left, right, top, bottom = window
    rows, columns = picture.shape[-2:]
    return pad(picture, (-left, right - columns, -top, bottom - rows), value=filling)  # a negative padding crops


def _hull_points(masks: Sequence[Tensor], cameras: CameraTensors) -> np.ndarray:
    """The corners (N, 3) of the voxels of a coarse hull."""
    sizes = [fitted(mask.shape, OUTLINE) for mask in masks]
    small = [resized(mask[None].float(), size)[0] > 0.5 for mask, size in zip(masks, sizes, strict=True)]
    views = stack([resize(cameras.at(view), *size) for view, size in enumerate(sizes)])
    low, high = (np.array(corner) for corner in hull_box(small, views, margin=0.0))
    grid = VoxelGrid(COARSE, low.tolist(), high.tolist())
    # An object that is cut off by a picture's border goes on beyond it.
    carved = visual_hull(
        [signed_distance(mask) for mask in small], views, grid, rule="all", threshold=0.0, outside="unknown"
    ).occupancy
    centers = grid.centers()[carved].double().numpy()
    half = (high - low) / COARSE / 2
    return np.concatenate([centers - half, centers + half])


def _around(points: np.ndarray, trimmed: tuple[int, int], turn: np.ndarray, told_by: str) -> Placement:
    """The box of points (N, 3) of the turned scene, turned on about the vertical where that makes it smaller."""
    from scipy.spatial.transform import Rotation

    boxes = {}
    for angle in range(-45, 45):
        low, high = np.percentile(Rotation.from_euler("y", angle, degrees=True).apply(points), trimmed, axis=0)
        boxes[angle] = float((high - low)[[0, 2]].prod()), low, high
    best = min(boxes, key=lambda angle: boxes[angle][0])
    if boxes[best][0] > LEAST_GAIN * boxes[0][0]:
        best = 0
    turn = Rotation.from_euler("y", best, degrees=True).as_matrix() @ turn
    _, low, high = boxes[best]
    return Placement(turn.T @ ((low + high) / 2), max(float(np.linalg.norm(high - low)), 1e-12), turn, told_by)


def _as_trained(scene: PosedImages, placement: Placement) -> Placement | None:
    """The placement by which cameras stand exactly as in training, where they nearly do."""
    if len(scene) < 2:
        return None
    focus = common_point(scene.cameras)
    away = np.linalg.norm(centers(scene.cameras).numpy() - focus, axis=1)
    side = float(np.median(away)) / DISTANCE
    is_even = np.abs(away / side - DISTANCE).max() < EVEN * DISTANCE
    is_alike = ALIKE[0] < placement.side / side < ALIKE[1]
    if is_even and is_alike and np.linalg.norm(focus - placement.center) < BESIDE * side:
        return placement._replace(center=focus, side=side, told_by=f"{placement.told_by} and cameras")
    return None


def _looked_at(scene: PosedImages, turned: CameraTensors, turn: np.ndarray) -> Placement:
    """What the cameras look at, and what fills their pictures there."""
    origins, focus = centers(turned).numpy(), common_point(turned)
    K, size = turned.intrinsics.numpy(), np.stack([torch.as_tensor(part).numpy() for part in turned[2:]], -1)
    away = project(turned, torch.from_numpy(focus)[None, None]).depth[0, :, 0].numpy()
    extents = away * np.minimum(size[:, 0] / K[:, 1, 1], size[:, 1] / K[:, 0, 0])
    side = float(np.median(extents)) / FIELD
    spread = float(np.linalg.norm(origins - origins[0], axis=1).max())
    if len(scene) < 2 or not side > 0 or not spread > 1e-3 * np.median(away):
        raise OptionError("where the object is cannot be told: the cameras look at no common point; give box")
    return Placement(turn.T @ focus, side, turn, "the point that the cameras look at")


def _upright(cameras: CameraTensors) -> np.ndarray:
    """The least rotation (3, 3) that brings a scene's up to y.

    Up is what all cameras' horizontal axes are square to, where they differ enough to tell; else the photographs' up.
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
