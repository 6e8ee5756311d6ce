"""Whether a calibration is that of its chessboard pictures, and which mistake explains it where it is not."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lsmgeo.diagnosis.chessboards import (
    Pose,
    Seen,
    board_errors,
    board_points,
    calibrate,
    calibrate_stereo,
    distortion_at_corners,
    find_pairs,
    look_at,
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

# OpenCV's samples look for this board where nothing else is stated.
USUAL_BOARD = (9, 6)
MOST_PICTURES = 60
# A calibration of sharp pictures reaches 0.1 to 0.5 px; one of other pictures misses by several.
LIMIT = 1.0
# Pixels, and multiples of what a calibration from scratch leaves, up to which a lens is not looked at further.
DOUBT, DOUBTS = 0.25, 4.0
# Resolutions that are made from each other.
SCALES = tuple(sorted({a / b for a in (1, 2, 3, 4, 8) for b in (1, 2, 3, 4, 8)} - {1.0}))
SHUFFLED, EXCHANGED = "frames shuffled", "left and right exchanged"
EXCHANGE = "The first lens is that of the second pictures: exchange lenses or pictures."
OPENGL, FLIP = np.diag([1.0, -1.0, -1.0]), np.diag([1.0, -1.0, 1.0])

# A first coefficient of distortion whose sign means something.
LEAST_BENT = 0.02

Pairs = list[tuple[np.ndarray, np.ndarray]]


class _Scene(NamedTuple):
    """What the pictures show, and what they say of the cameras by themselves."""

    points: np.ndarray  # (N, 3), in squares
    cameras: tuple[str, ...]  # what each is called
    paths: tuple[tuple[Path, ...], ...]
    seen: tuple[Seen, ...]
    lenses: tuple[CalibratedLens, ...]  # calibrated anew, one a camera; empty where that cannot be done
    errors: tuple[float, ...]  # their rms in pixels

    def error_under(self, lens: CalibratedLens, side: int) -> float:
        """The rms in pixels of what one camera saw under a lens."""
        return rms(board_errors(lens, self.points, self.seen[side].found))

    def best_side(self, lens: CalibratedLens) -> int:
        """The camera whose pictures a lens suits best; the last one where it suits none."""
        errors = [self.error_under(lens, side) for side in range(len(self.seen))]
        return min(int(np.nanargmin([*errors, np.inf])), len(errors) - 1)

    def is_right(self, error: float, side: int) -> bool:
        """Whether a lens is as good as its pictures let one be: a board's pose hides much of what is wrong with K."""
        anew = self.errors[side] if self.errors else LIMIT
        return error <= LIMIT and error <= max(DOUBT, DOUBTS * anew)


class _Report(NamedTuple):
    """Findings in the making."""

    facts: list[tuple[str, str]]
    checks: list[Check]
    causes: list[Cause]
    remarks: list[str]

    def measure(self, name: str, error: float, count: int, of: str = "corners") -> None:
        """Add a check of an error in pixels."""
        self.checks.append(Check(name, error, "px", LIMIT, count, of))

    def blame(self, name: str, how: str, before: float, after: float, remedy: str, besides: str = "") -> None:
        """Add a mistake whose correction brings an error in pixels down."""
        evidence = f"{how} falls from {before:.3g} px to {after:.3g} px{besides}"
        self.causes.append(Cause(name, evidence, remedy))


def examine_calibration(calibration: Calibration, path: Path) -> Findings:
    """Compare a calibration with the chessboards in its pictures.

    Measured are, as far as the pictures and the files allow: the error of a calibration from scratch, of one camera or
    of a pair (OpenCV's ``calibrateCamera``, then ``stereoCalibrate`` with both lenses held); the error of the corners
    under each lens that is stated, the board at its best pose; the error under stated poses of the board; and the error
    at which a stated rig carries corners from the first picture to the second. All are root mean squares in pixels.

    Corners have no unit, so that the length of a rig's T is compared only where the size of a square is stated. Half a
    pixel in a principal point is below what this can tell: the board's pose takes it up, and the error changes in the
    third digit.

    Args:
        calibration: what was read.
        path: from where, for what is said to the reader.

    Returns:
        The findings. A mistake is named where undoing it brings an error from above 1 px, or from four times what the
        pictures allow, to below, and to a half.

    Raises:
        DataError: a picture is damaged.
    """
    report = _Report([], [], [], [])
    _state(calibration, report)
    if not any(calibration.images):
        remedy = "List the pictures of the board in the file, or put them beside it in one folder, and name that."
        return _concluded(report, Gap(f"{path} names no picture of a board", remedy))
    scene = _look(calibration, report)
    if not all(seen.found for seen in scene.seen):
        both = zip(scene.cameras, scene.seen, strict=True)
        blind = [f"{counted(len(side.corners), 'pictures')} of the {name}" for name, side in both if not side.found]
        remedy = (
            "Look whether the pictures show all of the board, sharp, and whether its count of inner corners is right."
        )
        return _concluded(report, Gap(f"no board was found in {' and '.join(blind)}", remedy))
    pairs = _examine_pictures(scene, report)
    good = _examine_lenses(calibration, scene, report)
    if calibration.rig is not None and pairs:
        _examine_rig(calibration, scene, good, pairs, report)
    _examine_views(calibration, scene, report)
    return _concluded(report)


def _concluded(report: _Report, gap: Gap | None = None) -> Findings:
    # Of several mistakes the first: pictures come before lenses, and these before rigs, which are measured with them.
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
        turn = np.degrees(np.arccos(np.clip((np.trace(calibration.rig.rotation) - 1) / 2, -1, 1)))
        text = f"baseline {length:.6g}, turned by {turn:.2f} degrees"
        if board is not None and board.square is not None:
            text += f"; that is {length / board.square:.3f} squares"
        report.facts.append(("rig", text))


def _look(calibration: Calibration, report: _Report) -> _Scene:
    board = calibration.board
    corners = USUAL_BOARD if board is None else board.corners
    if board is None:
        report.facts.append(("board", f"{corners[0]} x {corners[1]} corners, as in OpenCV's samples; none is stated"))
    count = len(calibration.images[0])
    chosen = np.unique(np.linspace(0, count - 1, min(count, MOST_PICTURES)).round().astype(int))
    if len(chosen) < count:
        report.remarks.append(f"Of {count} pictures a camera {len(chosen)} were looked at.")
    paths = tuple(tuple(side[index] for index in chosen) for side in calibration.images)
    seen = tuple(look_at(side, corners) for side in paths)
    points = board_points(corners)
    cameras = ("first camera", "second camera") if len(seen) > 1 else ("camera",)
    for side, what in zip(seen, cameras, strict=True):
        pictures = counted(len(side.corners), "pictures")
        text = f"board found in {len(side.found)} of {pictures} of {side.size[1]} x {side.size[0]}"
        report.facts.append((what, text))
    anew = [calibrate(points, side, files[0]) for side, files in zip(seen, paths, strict=True)]
    fitted = [result for result in anew if result is not None]
    if len(fitted) < len(anew):
        report.remarks.append("Too few pictures of the board for a calibration from scratch.")
        fitted = []
    errors, lenses = tuple(error for error, _ in fitted), tuple(lens for _, lens in fitted)
    return _Scene(points, cameras, paths, seen, lenses, errors)


def _examine_pictures(scene: _Scene, report: _Report) -> Pairs:
    """Calibrate from scratch; the pairs of corners, which are those of the list unless it was shuffled."""
    alone = len(scene.seen) == 1
    for name, error, side, lens in zip(scene.cameras, scene.errors, scene.seen, scene.lenses, strict=False):
        if alone:
            report.measure("rms of a calibration from scratch", error, len(side.found) * len(scene.points))
        what = "calibrated anew" if alone else f"{name} anew"
        report.facts.append((what, f"{_lens_text(lens, side.size)}; rms {error:.3f} px"))
    both = [] if alone else zip(scene.seen[0].corners, scene.seen[1].corners, strict=True)
    pairs = [(first, second) for first, second in both if first is not None and second is not None]
    if len(scene.lenses) < 2:
        return pairs
    lenses = scene.lenses[0], scene.lenses[1]
    stereo = calibrate_stereo(scene.points, lenses, pairs, scene.seen[0].size)
    if stereo is None:
        return pairs
    error, rig = stereo
    report.measure("rms of a stereo calibration from scratch", error, 2 * len(pairs) * len(scene.points))
    if error <= LIMIT:
        report.facts.append(("measured baseline", f"{np.linalg.norm(rig.t):.3f} squares"))
        return pairs
    return [] if max(scene.errors) > LIMIT else _pair_anew(scene, error, report)


def _pair_anew(scene: _Scene, stated: float, report: _Report) -> Pairs:
    numbers = [[index for index, corners in enumerate(side.corners) if corners is not None] for side in scene.seen]
    lenses = scene.lenses[0], scene.lenses[1]
    found = find_pairs(scene.points, lenses, scene.seen[0].found, scene.seen[1].found)
    pairs = [(scene.seen[0].found[a], scene.seen[1].found[b]) for a, b in found]
    stereo = calibrate_stereo(scene.points, lenses, pairs, scene.seen[0].size)
    what = "the rms of a stereo calibration"
    # A few pictures always agree on some rig; half of all do not.
    if stereo is None or stereo[0] > LIMIT or 2 * len(pairs) < min(map(len, numbers)):
        return []
    told = [(scene.paths[0][numbers[0][a]].name, scene.paths[1][numbers[1][b]].name) for a, b in found]
    some = ", ".join(f"{first} with {second}" for first, second in told[:4])
    remedy = f"List beside each other the pictures that were taken at once: {some}{', ...' if len(told) > 4 else ''}."
    report.blame(SHUFFLED, f"paired otherwise, {what}", stated, stereo[0], remedy)
    return pairs


def _lens_text(lens: CalibratedLens, size: tuple[int, int]) -> str:
    focal = lens.intrinsics[[0, 1], [0, 1]]
    view = np.degrees(2 * np.arctan(np.array(size[::-1]) / (2 * focal)))
    bent = distortion_at_corners(lens, size)
    return (
        f"focal lengths {focal[0]:.1f} and {focal[1]:.1f} px, view {view[0]:.1f} x {view[1]:.1f} degrees, "
        f"distortion in the corners {bent:.1f} px"
    )


def _examine_lenses(calibration: Calibration, scene: _Scene, report: _Report) -> dict[int, CalibratedLens]:
    """Compare each stated lens with its pictures; the good ones of a pair, by camera."""
    good: dict[int, CalibratedLens] = {}
    off: dict[str, tuple[float, int]] = {}
    several = len(scene.seen) > 1
    for name, lens in calibration.lenses.items():
        # A lens of its own file may be of either camera; one of a pair says of which.
        side = {"first": 0, "second": len(scene.seen) - 1}.get(name, scene.best_side(lens))
        error = scene.error_under(lens, side)
        count = len(scene.seen[side].found) * len(scene.points)
        report.measure(
            f"rms under the lens {name}", error, count, f"{scene.cameras[side]}'s corners" if several else "corners"
        )
        report.facts.append((f"lens {name} on its pictures", _lens_text(lens, scene.seen[side].size)))
        if scene.is_right(error, side):
            good.setdefault(side, lens)
        else:
            off[name] = error, side
    if {"first", "second"} <= set(off) and several:
        swapped = [scene.error_under(calibration.lenses[name], side) for side, name in enumerate(("second", "first"))]
        if all(scene.is_right(error, side) for side, error in enumerate(swapped)):
            stated = max(off["first"][0], off["second"][0])
            report.blame(EXCHANGED, "exchanged, the rms under the lenses", stated, max(swapped), EXCHANGE)
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
    if scene.is_right(error, side) and error < 0.5 * stated and not 0.95 < scale < 1.05:
        remedy = (
            f"The pictures are {scale:.4g} times as large as those that were calibrated: "
            "scale K by that (c becomes (c + 0.5) s - 0.5), or use pictures of the calibrated size."
        )
        how = f"with K times {scale:.4g}, the rms under the lens {name}"
        report.blame("K of another resolution", how, stated, error, remedy)
    elif stated > LIMIT and scene.errors and scene.errors[side] < min(LIMIT, 0.5 * stated):
        size = scene.seen[side].size
        bent, fitted = distortion_at_corners(lens, size), distortion_at_corners(scene.lenses[side], size)
        besides = f"; distortion in the corners is stated as {bent:.3g} px and measured as {fitted:.3g} px"
        k1, other = lens.coefficients[0], scene.lenses[side].coefficients[0]
        if lens.kind == scene.lenses[side].kind and k1 * other < 0 and min(abs(k1), abs(other)) > LEAST_BENT:
            besides += f"; the lens bends the other way, k1 is stated as {k1:+.3g} and measured as {other:+.3g}"
        remedy = (
            f"{lens.file.name} is not the calibration of these pictures: calibrate anew, or look for the right file."
        )
        how = f"calibrated anew from the pictures, the rms under the lens {name}"
        report.blame("lens of other pictures", how, stated, scene.errors[side], remedy, besides)


def _other_poses(pose: Pose) -> list[tuple[str, str, str, Pose]]:
    """What a pose is where a mistake was made with it, common ones first: name, correction, remedy, pose."""

    def turned(axes: np.ndarray) -> Pose:
        return Pose(axes @ pose.R @ axes, axes @ pose.t)

    return [
        ("poses inverted", "inverted", "R and T lead the other way: use R^T and -R^T T.", pose.inverse()),
        ("OpenGL axes", "with y and z negated", "The axes are OpenGL's: negate y and z on both sides.", turned(OPENGL)),
        (
            "OpenGL axes",
            "with the camera's y and z negated",
            "The camera's axes are OpenGL's: negate y and z of the camera.",
            Pose(OPENGL @ pose.R, OPENGL @ pose.t),
        ),
        ("y flipped", "with y negated", "y points up: negate it on both sides of R and in T.", turned(FLIP)),
        ("rotation transposed", "with R transposed", "Transpose R.", Pose(pose.R.T, pose.t)),
        ("translation negated", "with T negated", "T has the wrong sign: negate it.", Pose(pose.R, -pose.t)),
    ]


def _examine_rig(
    calibration: Calibration, scene: _Scene, good: dict[int, CalibratedLens], pairs: Pairs, report: _Report
) -> None:
    rig = calibration.rig
    # A lens that is wrong by itself must not speak against the rig.
    lenses = [good.get(side) or (scene.lenses[side] if scene.lenses else None) for side in (0, 1)]
    first, second = lenses
    if rig is None or first is None or second is None:
        return
    length = float(np.linalg.norm(rig.translation))
    stated = Pose(rig.rotation, rig.translation)

    def measured_with(used: tuple[CalibratedLens, CalibratedLens]) -> float:
        stereo = calibrate_stereo(scene.points, used, pairs, scene.seen[0].size)
        return float("nan") if stereo is None else float(np.linalg.norm(stereo[1].t))

    def error_of(pose: Pose, used: tuple[CalibratedLens, CalibratedLens], measured: float) -> float:
        # The pictures do not tell lengths, so T gets the one that was measured.
        return rms(transfer_errors(Pose(pose.R, pose.t * (measured / length)), scene.points, used, pairs))

    measured = measured_with((first, second))
    if not measured > 0 or length == 0:
        return
    square = None if calibration.board is None else calibration.board.square
    if square is not None and not 0.95 < length / square / measured < 1.05:
        report.remarks.append(
            f"T is {length:.6g} long, which would be {length / square:.4g} squares; {measured:.4g} are measured: "
            "T or the square's size is in other units."
        )
    error = error_of(stated, (first, second), measured)
    what = "corners carried by the rig"
    report.measure(f"rms of {what}", error, len(pairs) * len(scene.points))
    if error > LIMIT and {"first", "second"} <= set(calibration.lenses):
        swapped = calibration.lenses["second"], calibration.lenses["first"]
        exchanged = error_of(stated, swapped, measured_with(swapped))
        if exchanged < min(LIMIT, 0.5 * error):
            report.blame(EXCHANGED, f"with the lenses exchanged, the rms of {what}", error, exchanged, EXCHANGE)
            return
    if error > LIMIT:
        errors = [error_of(row[3], (first, second), measured) for row in _other_poses(stated)]
        _explain_pose(errors, error, f"of {what}", report)


def _explain_pose(errors: Sequence[float], error: float, what: str, report: _Report) -> None:
    """Name the mistake with poses that leaves the least of the errors, in the order of `_other_poses`."""
    best = int(np.nan_to_num(errors, nan=np.inf).argmin())
    name, how, remedy, _ = _other_poses(Pose(np.eye(3), np.zeros(3)))[best]
    if errors[best] <= LIMIT and errors[best] < 0.5 * error:
        report.blame(name, f"{how}, the rms {what}", error, errors[best], remedy)


def _examine_views(calibration: Calibration, scene: _Scene, report: _Report) -> None:
    """Compare stated poses of the board with the pictures, where there are as many of both."""
    import cv2

    board = calibration.board
    for name, lens in calibration.lenses.items():
        if lens.views is None or board is None or board.square is None:
            continue
        found = scene.seen[scene.best_side(lens)].found
        if len(found) != len(lens.views):
            count = f"{len(lens.views)} poses of the board, which was found in {len(found)} pictures"
            report.remarks.append(f"The lens {name} states {count}.")
            continue
        poses = [Pose(np.asarray(cv2.Rodrigues(view[:3])[0]), view[3:]) for view in lens.views]
        _compare_views(lens, name, poses, scene.points * board.square, found, report)


def _compare_views(
    lens: CalibratedLens, name: str, poses: list[Pose], points: np.ndarray, rows: list[np.ndarray], report: _Report
) -> None:

    def table(change: int | None) -> np.ndarray:
        """(poses, pictures) rms in pixels; a board may be numbered from either end."""
        changed = poses if change is None else [_other_poses(pose)[change][3] for pose in poses]
        ends = [project(lens, pose.applied(points)) for pose in changed]
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
        remedy = "Poses and pictures stand in different orders: list the pictures in the order of the calibration."
        report.blame(SHUFFLED, f"in another order, the rms under the poses of {name}", error, shuffled, remedy)
        return
    corrected = [rms(table(change).diagonal()) for change in range(len(_other_poses(poses[0])))]
    _explain_pose(corrected, error, f"under the poses of {name}", report)
