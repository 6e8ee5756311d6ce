"""A calibration compared with its chessboard images: reprojection errors, and the likely cause of large ones."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lsmgeo.diagnosis.camera_errors import FLIP, OPENGL
from lsmgeo.diagnosis.chessboards import (
    Detections,
    Pose,
    board_errors,
    board_points,
    calibrate,
    calibrate_stereo,
    detect_boards,
    distortion_at_corners,
    find_pairs,
    project,
    rms,
    transfer_errors,
)
from lsmgeo.diagnosis.findings import Cause, Check, Findings, Gap, counted
from lsmgeo.diagnosis.two_view_geometry import scaling

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from lsmgeo.data.formats.format_opencv import CalibratedLens, Calibration

__all__ = ["examine_calibration"]

# The board of OpenCV's samples, used if none is stated.
USUAL_BOARD = (9, 6)
MOST_IMAGES = 60
# A calibration from sharp images reaches 0.1 to 0.5 px; that of other images is off by several.
LIMIT = 1.0
# A lens is accepted up to this error, px, or this multiple of the error of a calibration from scratch.
ACCEPTED, ACCEPTED_RATIO = 0.25, 4.0
# Common ratios of resolutions.
SCALES = tuple(sorted({a / b for a in (1, 2, 3, 4, 8) for b in (1, 2, 3, 4, 8)} - {1.0}))
SHUFFLED, EXCHANGED = "frames shuffled", "left and right exchanged"
EXCHANGE = "The first lens is that of the second camera's images: exchange lenses or images."

# Least k1 whose sign is significant.
LEAST_DISTORTION = 0.02

Pairs = list[tuple[np.ndarray, np.ndarray]]


class _Scene(NamedTuple):
    """The detected boards, and the cameras calibrated from them from scratch."""

    points: np.ndarray  # (N, 3), in squares
    cameras: tuple[str, ...]  # their names
    paths: tuple[tuple[Path, ...], ...]
    detections: tuple[Detections, ...]
    lenses: tuple[CalibratedLens, ...]  # calibrated from scratch, one per camera; empty if that fails
    errors: tuple[float, ...]  # their rms in pixels

    def error_under(self, lens: CalibratedLens, side: int) -> float:
        """The rms in pixels of one camera's boards with a lens."""
        return rms(board_errors(lens, self.points, self.detections[side].found))

    def best_side(self, lens: CalibratedLens) -> int:
        """The camera whose images a lens fits best; the last one if it fits none."""
        errors = [self.error_under(lens, side) for side in range(len(self.detections))]
        return min(int(np.nanargmin([*errors, np.inf])), len(errors) - 1)

    def is_accurate(self, error: float, side: int) -> bool:
        """Whether a lens fits nearly as well as possible: the board's pose hides much of an error in K."""
        anew = self.errors[side] if self.errors else LIMIT
        return error <= LIMIT and error <= max(ACCEPTED, ACCEPTED_RATIO * anew)


class _Report(NamedTuple):
    """Findings under construction."""

    facts: list[tuple[str, str]]
    checks: list[Check]
    causes: list[Cause]
    remarks: list[str]

    def measure(self, name: str, error: float, count: int, of: str = "corners") -> None:
        """Add a check of an error in pixels."""
        self.checks.append(Check(name, error, "px", LIMIT, count, of))

    def add_cause(self, name: str, what: str, before: float, after: float, remedy: str, details: str = "") -> None:
        """Add an error whose correction makes a residual in pixels smaller."""
        evidence = f"{what} falls from {before:.3g} px to {after:.3g} px{details}"
        self.causes.append(Cause(name, evidence, remedy))


def examine_calibration(calibration: Calibration, path: Path) -> Findings:
    """Compare a calibration with the chessboards in its images.

    Measured, as far as images and files allow: the error of a calibration from scratch, of one camera or of a pair
    (OpenCV's ``calibrateCamera``, then ``stereoCalibrate`` with fixed lenses); the reprojection error of the corners
    with each stated lens, the board at its best pose; the error with stated poses of the board; and the error of
    corners that a stated rig transfers from the first image to the second. All are root mean squares in pixels.

    Corners have no unit, so the length of a rig's T is compared only if the size of a square is stated. Half a pixel
    in a principal point cannot be detected: the board's pose compensates for it.

    Args:
        calibration: the calibration.
        path: its file or folder, for messages.

    Returns:
        The findings. A cause is reported if its correction at least halves an error of more than 1 px, or of more than
        four times that of a calibration from scratch, and brings it below.

    Raises:
        DataError: an image is damaged.
    """
    report = _Report([], [], [], [])
    _state(calibration, report)
    if not any(calibration.images):
        remedy = "List the images of the board in the file, or put all in one folder and give that."
        return _concluded(report, Gap(f"{path} names no image of a board", remedy))
    scene = _detect(calibration, report)
    if not all(side.found for side in scene.detections):
        both = zip(scene.cameras, scene.detections, strict=True)
        missing = [f"{counted(len(side.corners), 'images')} of the {name}" for name, side in both if not side.found]
        remedy = "Check that the images show the whole board in focus, and that its number of inner corners is right."
        return _concluded(report, Gap(f"no board was found in {' and '.join(missing)}", remedy))
    pairs = _examine_images(scene, report)
    good = _examine_lenses(calibration, scene, report)
    if calibration.rig is not None and pairs:
        _examine_rig(calibration, scene, good, pairs, report)
    _examine_views(calibration, scene, report)
    return _concluded(report)


def _concluded(report: _Report, gap: Gap | None = None) -> Findings:
    # The first cause: images come before lenses, and lenses before rigs, which are measured with them.
    cause = report.causes[0] if report.causes else None
    further = [other for other in report.causes if cause is not None and other.name != cause.name]
    others = [f"Also {other.name}: {other.evidence}. {other.remedy}" for other in further]
    return Findings(tuple(report.facts), tuple(report.checks), cause, (*report.remarks, *others), "calibration", gap)


def _state(calibration: Calibration, report: _Report) -> None:
    for name, lens in calibration.lenses.items():
        fx, fy, cx, cy = lens.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
        text = f"focal lengths {fx:.1f} and {fy:.1f} px, principal point ({cx:.1f}, {cy:.1f}), {lens.kind}"
        if lens.size is not None:
            text += f", {lens.size[1]} x {lens.size[0]} pixels"
        report.facts.append((f"lens {name}", text))
    board = calibration.board
    if board is not None:
        square = "" if board.square is None else f", squares of {board.square:.6g}"
        report.facts.append(("board", f"{board.corners[0]} x {board.corners[1]} corners{square}"))
    if calibration.rig is not None:
        length = float(np.linalg.norm(calibration.rig.translation))
        angle = np.degrees(np.arccos(np.clip((np.trace(calibration.rig.rotation) - 1) / 2, -1, 1)))
        text = f"baseline {length:.6g}, rotation {angle:.2f} degrees"
        if board is not None and board.square is not None:
            text += f"; that is {length / board.square:.3f} squares"
        report.facts.append(("rig", text))


def _detect(calibration: Calibration, report: _Report) -> _Scene:
    board = calibration.board
    corners = USUAL_BOARD if board is None else board.corners
    if board is None:
        report.facts.append(("board", f"{corners[0]} x {corners[1]} corners, as in OpenCV's samples; none is stated"))
    count = len(calibration.images[0])
    chosen = np.unique(np.linspace(0, count - 1, min(count, MOST_IMAGES)).round().astype(int))
    if len(chosen) < count:
        report.remarks.append(f"{len(chosen)} of {count} images per camera are measured.")
    paths = tuple(tuple(side[index] for index in chosen) for side in calibration.images)
    detections = tuple(detect_boards(side, corners) for side in paths)
    points = board_points(corners)
    cameras = ("first camera", "second camera") if len(detections) > 1 else ("camera",)
    for side, what in zip(detections, cameras, strict=True):
        images = counted(len(side.corners), "images")
        text = f"board found in {len(side.found)} of {images} of {side.size[1]} x {side.size[0]}"
        report.facts.append((what, text))
    results = [calibrate(points, side, files[0]) for side, files in zip(detections, paths, strict=True)]
    fitted = [result for result in results if result is not None]
    if len(fitted) < len(results):
        report.remarks.append("There are too few images of the board for a calibration from scratch.")
        fitted = []
    errors, lenses = tuple(error for error, _ in fitted), tuple(lens for _, lens in fitted)
    return _Scene(points, cameras, paths, detections, lenses, errors)


def _examine_images(scene: _Scene, report: _Report) -> Pairs:
    """Calibrate from scratch, and return the pairs of corners: those of the list unless it is shuffled."""
    single = len(scene.detections) == 1
    for name, error, side, lens in zip(scene.cameras, scene.errors, scene.detections, scene.lenses, strict=False):
        if single:
            report.measure("rms of a calibration from scratch", error, len(side.found) * len(scene.points))
        what = "calibrated anew" if single else f"{name} anew"
        report.facts.append((what, f"{_lens_text(lens, side.size)}; rms {error:.3f} px"))
    both = [] if single else zip(scene.detections[0].corners, scene.detections[1].corners, strict=True)
    pairs = [(first, second) for first, second in both if first is not None and second is not None]
    if len(scene.lenses) < 2:
        return pairs
    lenses = scene.lenses[0], scene.lenses[1]
    stereo = calibrate_stereo(scene.points, lenses, pairs, scene.detections[0].size)
    if stereo is None:
        return pairs
    error, rig = stereo
    report.measure("rms of a stereo calibration from scratch", error, 2 * len(pairs) * len(scene.points))
    if error <= LIMIT:
        report.facts.append(("measured baseline", f"{np.linalg.norm(rig.t):.3f} squares"))
        return pairs
    return [] if max(scene.errors) > LIMIT else _pair_images(scene, error, report)


def _pair_images(scene: _Scene, stated: float, report: _Report) -> Pairs:
    numbers = [[i for i, corners in enumerate(side.corners) if corners is not None] for side in scene.detections]
    lenses = scene.lenses[0], scene.lenses[1]
    found = find_pairs(scene.points, lenses, scene.detections[0].found, scene.detections[1].found)
    pairs = [(scene.detections[0].found[a], scene.detections[1].found[b]) for a, b in found]
    stereo = calibrate_stereo(scene.points, lenses, pairs, scene.detections[0].size)
    what = "the rms of a stereo calibration"
    # A few images always agree on some rig; half of them agree only on the right one.
    if stereo is None or stereo[0] > LIMIT or 2 * len(pairs) < min(map(len, numbers)):
        return []
    names = [(scene.paths[0][numbers[0][a]].name, scene.paths[1][numbers[1][b]].name) for a, b in found]
    some = ", ".join(f"{first} with {second}" for first, second in names[:4])
    remedy = f"List images that were taken at the same time as pairs: {some}{', ...' if len(names) > 4 else ''}."
    report.add_cause(SHUFFLED, f"with other pairs, {what}", stated, stereo[0], remedy)
    return pairs


def _lens_text(lens: CalibratedLens, size: tuple[int, int]) -> str:
    focal = lens.intrinsics[[0, 1], [0, 1]]
    view = np.degrees(2 * np.arctan(np.array(size[::-1]) / (2 * focal)))
    distortion = distortion_at_corners(lens, size)
    return (
        f"focal lengths {focal[0]:.1f} and {focal[1]:.1f} px, view {view[0]:.1f} x {view[1]:.1f} degrees, "
        f"distortion in the corners {distortion:.1f} px"
    )


def _examine_lenses(calibration: Calibration, scene: _Scene, report: _Report) -> dict[int, CalibratedLens]:
    """Compare each stated lens with its images, and return the accurate ones by camera."""
    good: dict[int, CalibratedLens] = {}
    off: dict[str, tuple[float, int]] = {}
    several = len(scene.detections) > 1
    for name, lens in calibration.lenses.items():
        # A lens from a file of its own may belong to either camera; the lenses of a pair are in order.
        side = {"first": 0, "second": len(scene.detections) - 1}.get(name, scene.best_side(lens))
        error = scene.error_under(lens, side)
        count = len(scene.detections[side].found) * len(scene.points)
        report.measure(
            f"rms under the lens {name}", error, count, f"{scene.cameras[side]}'s corners" if several else "corners"
        )
        report.facts.append((f"lens {name} on its images", _lens_text(lens, scene.detections[side].size)))
        if scene.is_accurate(error, side):
            good.setdefault(side, lens)
        else:
            off[name] = error, side
    if {"first", "second"} <= set(off) and several:
        swapped = [scene.error_under(calibration.lenses[name], side) for side, name in enumerate(("second", "first"))]
        if all(scene.is_accurate(error, side) for side, error in enumerate(swapped)):
            stated = max(off["first"][0], off["second"][0])
            report.add_cause(EXCHANGED, "exchanged, the rms under the lenses", stated, max(swapped), EXCHANGE)
            return good
    for name, (stated, side) in off.items():
        _explain_lens(name, calibration.lenses[name], stated, scene, side, report)
    return good


def _explain_lens(name: str, lens: CalibratedLens, stated: float, scene: _Scene, side: int, report: _Report) -> None:
    scales = list(SCALES)
    if scene.lenses:
        scales.append(float(scene.lenses[side].intrinsics[0, 0] / lens.intrinsics[0, 0]))
    resized = [
        (scene.error_under(replace(lens, intrinsics=scaling(scale, scale) @ lens.intrinsics), side), scale)
        for scale in scales
    ]
    error, scale = min(resized, key=lambda pair: np.nan_to_num(pair[0], nan=np.inf))
    if scene.is_accurate(error, side) and error < 0.5 * stated and not 0.95 < scale < 1.05:
        remedy = (
            f"The images are {scale:.4g} times as large as those of the calibration: "
            "scale K (c becomes (c + 0.5) s - 0.5), or use images of the calibrated size."
        )
        how = f"with K times {scale:.4g}, the rms under the lens {name}"
        report.add_cause("K of another resolution", how, stated, error, remedy)
    elif stated > LIMIT and scene.errors and scene.errors[side] < min(LIMIT, 0.5 * stated):
        size = scene.detections[side].size
        stated_px, fitted_px = distortion_at_corners(lens, size), distortion_at_corners(scene.lenses[side], size)
        details = f"; distortion in the corners is stated as {stated_px:.3g} px and measured as {fitted_px:.3g} px"
        k1, other = lens.coefficients[0], scene.lenses[side].coefficients[0]
        if lens.kind == scene.lenses[side].kind and k1 * other < 0 and min(abs(k1), abs(other)) > LEAST_DISTORTION:
            details += f"; the distortion has the opposite sign: k1 is stated as {k1:+.3g} and measured as {other:+.3g}"
        remedy = f"{lens.file.name} is not the calibration of these images: calibrate again, or find the right file."
        how = f"calibrated from these images, the rms under the lens {name}"
        report.add_cause("lens of other images", how, stated, scene.errors[side], remedy, details)


def _other_poses(pose: Pose) -> list[tuple[str, str, str, Pose]]:
    """Common errors of a pose, the most common first: name, correction, remedy, corrected pose."""

    def in_axes(axes: np.ndarray) -> Pose:
        return Pose(axes @ pose.R @ axes, axes @ pose.t)

    return [
        ("poses inverted", "inverted", "R and T are in the opposite direction: use R^T and -R^T T.", pose.inverse()),
        ("OpenGL axes", "with y and z negated", "The axes are OpenGL's: negate both y and z.", in_axes(OPENGL)),
        (
            "OpenGL axes",
            "with the camera's y and z negated",
            "The camera's axes are OpenGL's: negate only the camera's y and z.",
            Pose(OPENGL @ pose.R, OPENGL @ pose.t),
        ),
        ("y flipped", "with y negated", "y points up: negate it on both sides of R and in T.", in_axes(FLIP)),
        ("rotation transposed", "with R transposed", "Transpose R.", Pose(pose.R.T, pose.t)),
        ("translation negated", "with T negated", "T has the wrong sign: negate it.", Pose(pose.R, -pose.t)),
    ]


def _examine_rig(
    calibration: Calibration, scene: _Scene, good: dict[int, CalibratedLens], pairs: Pairs, report: _Report
) -> None:
    rig = calibration.rig
    # A wrong lens must not count against the rig.
    lenses = [good.get(side) or (scene.lenses[side] if scene.lenses else None) for side in (0, 1)]
    first, second = lenses
    if rig is None or first is None or second is None:
        return
    length = float(np.linalg.norm(rig.translation))
    stated = Pose(rig.rotation, rig.translation)

    def measured_with(used: tuple[CalibratedLens, CalibratedLens]) -> float:
        stereo = calibrate_stereo(scene.points, used, pairs, scene.detections[0].size)
        return float("nan") if stereo is None else float(np.linalg.norm(stereo[1].t))

    def error_of(pose: Pose, used: tuple[CalibratedLens, CalibratedLens], measured: float) -> float:
        # Images do not determine lengths, so T gets the measured one.
        return rms(transfer_errors(Pose(pose.R, pose.t * (measured / length)), scene.points, used, pairs))

    measured = measured_with((first, second))
    if not measured > 0 or length == 0:
        return
    square = None if calibration.board is None else calibration.board.square
    if square is not None and not 0.95 < length / square / measured < 1.05:
        report.remarks.append(
            f"T has length {length:.6g}, that is {length / square:.4g} squares, but {measured:.4g} are measured: "
            "T or the size of a square is in other units."
        )
    error = error_of(stated, (first, second), measured)
    what = "corners transferred by the rig"
    report.measure(f"rms of {what}", error, len(pairs) * len(scene.points))
    if error > LIMIT and {"first", "second"} <= set(calibration.lenses):
        swapped = calibration.lenses["second"], calibration.lenses["first"]
        exchanged = error_of(stated, swapped, measured_with(swapped))
        if exchanged < min(LIMIT, 0.5 * error):
            report.add_cause(EXCHANGED, f"with the lenses exchanged, the rms of {what}", error, exchanged, EXCHANGE)
            return
    if error > LIMIT:
        errors = [error_of(row[3], (first, second), measured) for row in _other_poses(stated)]
        _explain_pose(errors, error, f"of {what}", report)


def _explain_pose(errors: Sequence[float], error: float, what: str, report: _Report) -> None:
    """Add the error of poses whose correction leaves the smallest of the errors, in the order of `_other_poses`."""
    best = int(np.nan_to_num(errors, nan=np.inf).argmin())
    name, how, remedy, _ = _other_poses(Pose(np.eye(3), np.zeros(3)))[best]
    if errors[best] <= LIMIT and errors[best] < 0.5 * error:
        report.add_cause(name, f"{how}, the rms {what}", error, errors[best], remedy)


def _examine_views(calibration: Calibration, scene: _Scene, report: _Report) -> None:
    """Compare stated poses of the board with the images, if there are as many of both."""
    import cv2

    board = calibration.board
    for name, lens in calibration.lenses.items():
        if lens.views is None or board is None or board.square is None:
            continue
        found = scene.detections[scene.best_side(lens)].found
        if len(found) != len(lens.views):
            count = f"{len(lens.views)} poses of the board, which was found in {len(found)} images"
            report.remarks.append(f"The lens {name} states {count}.")
            continue
        poses = [Pose(np.asarray(cv2.Rodrigues(view[:3])[0]), view[3:]) for view in lens.views]
        _compare_views(lens, name, poses, scene.points * board.square, found, report)


def _compare_views(
    lens: CalibratedLens, name: str, poses: list[Pose], points: np.ndarray, rows: list[np.ndarray], report: _Report
) -> None:

    def table(change: int | None) -> np.ndarray:
        """(poses, images) rms in pixels; the corners of a board may be numbered from either end."""
        changed = poses if change is None else [_other_poses(pose)[change][3] for pose in poses]
        ends = [project(lens, pose.transform(points)) for pose in changed]
        return np.array(
            [[min(rms(np.linalg.norm(p - c, axis=1)) for p in (end, end[::-1])) for c in rows] for end in ends]
        )

    as_is = table(None)
    error = rms(as_is.diagonal())
    report.measure(f"rms under the poses of {name}", error, len(rows) * len(points))
    if error <= LIMIT:
        return
    shuffled = rms(as_is.min(1))
    if shuffled <= LIMIT and len(set(as_is.argmin(1))) == len(rows):
        remedy = "Poses and images are in different orders: list the images in the order of the calibration."
        report.add_cause(SHUFFLED, f"in another order, the rms under the poses of {name}", error, shuffled, remedy)
        return
    corrected = [rms(table(change).diagonal()) for change in range(len(_other_poses(poses[0])))]
    _explain_pose(corrected, error, f"under the poses of {name}", report)
