"""Errors planted in images of exactly known geometry are reported, and correct cameras are not."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from lsmgeo.diagnosis import evidence, examine
from lsmgeo.diagnosis.check_images import examine_images
from lsmgeo.diagnosis.feature_matching import match_features
from lsmgeo.diagnosis.permutations import permutation_candidates
from lsmgeo.diagnosis.two_view_geometry import stated_hypothesis
from lsmgeo.errors import DataError
from tests.diagnosis.textured import (
    in_order,
    matrices,
    on_an_arc,
    planted,
    trace,
    with_cameras,
    with_depth,
    with_points,
    with_voxels,
    write,
)

LONG = pytest.mark.long
COMMON = ["poses inverted", "OpenGL axes", "y flipped", "K of another resolution", "frames shuffled"]
RARE = [
    "poses inverted and OpenGL axes",
    "rotation transposed",
    "centre taken as translation",
    "translation negated",
    "other camera axes",
    "focal length off",
]


@pytest.fixture(scope="session")
def room():
    return trace(*on_an_arc(7))


@pytest.fixture(scope="session")
def images(room, tmp_path_factory):
    """Only textured images."""
    return write(room, tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="session")
def blank(room, tmp_path_factory):
    """The same cameras, and images without features."""
    return write(replace(room, images=np.full_like(room.images, 128)), tmp_path_factory.mktemp("blank"))


@pytest.fixture(scope="session")
def cut_out(tmp_path_factory):
    """Images from all around without texture, cut out."""
    angles = [0.0, 0.9, 2.1, 3.3, 4.1, 5.2]
    heights = [0.3, -0.9, 1.1, -0.2, 0.8, -1.3]
    eyes = [(2.6 * np.sin(a), h, -2.6 * np.cos(a)) for a, h in zip(angles, heights, strict=True)]
    traced = trace(eyes, [0.0, 0.4, -0.3, 0.8, 0.1, -0.6], texture=False, focal=300.0)
    return write(traced, tmp_path_factory.mktemp("cut_out"), cut_out=True)


def check(findings, name):
    return next(check for check in findings.checks if name in check.name)


def test_correct_cameras_are_good(images):
    findings = examine(images, images.paths[0].parent)
    assert findings.verdict == "good"
    assert findings.cause is None
    assert check(findings, "epipolar").value < 0.2
    assert check(findings, "epipolar").measured > 300
    assert check(findings, "in front").value == 100
    assert check(findings, "agree with the others").value == 100


@pytest.mark.parametrize("error", [*COMMON, RARE[0], *(pytest.param(rare, marks=LONG) for rare in RARE[1:])])
def test_an_error_is_inferred_from_features_only(images, error):
    findings = examine_images(planted(images, error)).findings
    assert findings.verdict == "bad"
    assert findings.cause.name == error


@pytest.mark.parametrize("shift", [0.5, -0.5])
def test_half_a_pixel_is_found_though_all_checks_pass(images, shift):
    K, _ = matrices(images)
    K[:, :2, 2] += shift
    findings = examine_images(with_cameras(images, K=K)).findings
    assert all(check.passed for check in findings.checks)
    assert findings.cause.name == "half a pixel"
    assert ("subtract 0.5" if shift > 0 else "add 0.5") in findings.cause.remedy


def test_a_smaller_shift_is_no_half_pixel(images):
    K, _ = matrices(images)
    K[:, :2, 2] += 0.12
    assert examine_images(with_cameras(images, K=K)).findings.verdict == "good"


@pytest.mark.parametrize(
    ("order", "words"),
    [
        ([6, 5, 4, 3, 2, 1, 0], "the order reversed"),
        ([1, 2, 3, 4, 5, 6, 0], "1 place later"),
        ([0, 1, 4, 3, 2, 5, 6], "frame_2.png to the camera of frame_4.png"),
    ],
)
def test_permutations_are_reported(images, order, words):
    cause = examine_images(in_order(images, order)).findings.cause
    assert cause.name == "frames shuffled"
    assert words in cause.remedy


@pytest.mark.parametrize(("axis", "degrees"), [(1, 4.0), (2, 2.0), (0, 1.0)])
def test_a_single_wrong_view_is_reported(images, axis, degrees):
    _, E = matrices(images)
    # Some pixels: more than the error of any correct view, less than what fails a pair.
    turn, _ = cv2.Rodrigues(np.radians(degrees) * np.eye(3)[axis])
    E[3, :3] = turn @ E[3, :3]
    findings = examine_images(with_cameras(images, E=E)).findings
    assert findings.verdict == "bad"
    assert findings.cause.name == "some views are off"
    assert "frame_3.png" in findings.cause.evidence
    assert "frame_2.png" not in findings.cause.evidence


def test_poses_may_be_shuffled_while_every_image_keeps_its_intrinsics(images):
    K, _ = matrices(images)
    own = K * np.linspace(1.0, 1.1, len(K))[:, None, None] ** np.array([[1, 1, 0], [1, 1, 0], [0, 0, 0]])
    stated = stated_hypothesis(with_cameras(images, K=own))
    found = [
        candidate.hypothesis.cameras for candidate in permutation_candidates(stated, images.names, [], np.arange(7))
    ]
    backwards = [cameras for cameras in found if np.array_equal(cameras.t, stated.cameras.t[::-1])]
    assert any(np.array_equal(cameras.K, own) for cameras in backwards)
    assert any(np.array_equal(cameras.K, own[::-1]) for cameras in backwards)


def test_errors_without_a_known_cause_are_remarked(images):
    _, E = matrices(images)
    rng = np.random.default_rng(1)
    for pose in E:
        turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        pose[:3, :3] = turn * np.sign(np.linalg.det(turn))
    findings = examine_images(with_cameras(images, E=E)).findings
    assert findings.verdict == "bad"
    assert findings.cause is None
    assert "no single error explains this" in " ".join(findings.remarks)
    assert all(name in " ".join(findings.remarks) for name in COMMON)


def test_moving_and_scaling_the_world_changes_nothing(room, images):
    scene = with_points(images, room)
    _, E = matrices(scene)
    turn, _ = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    shift, scale = np.array([3.0, -1.0, 0.5]), 7.5
    # X' = scale turn X + shift, and cameras that see X' as the old ones saw X.
    R = E[:, :3, :3] @ turn.T
    t = scale * E[:, :3, 3] - R @ shift
    moved_E = E.copy()
    moved_E[:, :3, :3], moved_E[:, :3, 3] = R, t
    moved = with_cameras(scene, E=moved_E)
    points = scene.points._replace(positions=scale * scene.points.positions @ turn.T + shift)
    before = examine_images(scene).findings
    after = examine_images(replace(moved, points=points)).findings
    assert after.verdict == before.verdict == "good"
    np.testing.assert_allclose([c.value for c in after.checks], [c.value for c in before.checks], rtol=1e-6)


@pytest.mark.parametrize(
    "error",
    [
        *COMMON,
        "half a pixel",
        *(pytest.param(name, marks=LONG) for name in ("rotation transposed", "centre taken as translation")),
    ],
)
def test_an_error_is_inferred_from_points_only(room, blank, error):
    scene = with_points(blank, room)
    assert examine_images(scene).findings.verdict == "good"
    wrong = planted(scene, error)
    if error == "frames shuffled":
        order = np.random.default_rng(3).permutation(len(scene))
        K, E = matrices(scene)
        wrong = with_cameras(scene, K=K[order], E=E[order])
    cause = examine_images(wrong).findings.cause
    assert cause.name == error


def test_reprojection_error_is_that_of_the_noise(room, blank):
    findings = examine_images(with_points(blank, room, noise_px=0.3)).findings
    # The median length of a vector of two normal errors.
    np.testing.assert_allclose(check(findings, "reprojection").value, 0.3 * np.sqrt(2 * np.log(2)), rtol=0.1)


@pytest.mark.parametrize("error", [COMMON[0], *(pytest.param(name, marks=LONG) for name in COMMON[1:4])])
def test_an_error_is_inferred_from_depth_only(room, blank, error):
    scene = with_depth(blank, room)
    good = examine_images(scene).findings
    assert good.verdict == "good"
    assert check(good, "depth of one view").value < 0.5
    cause = examine_images(planted(scene, error)).findings.cause
    assert cause.name == error


def test_depth_in_millimetres_and_along_the_ray_are_reported(room, blank):
    findings = examine_images(with_depth(blank, room, 1000 * room.depth)).findings
    assert findings.cause.name == "depth in other units"
    assert "0.001" in findings.cause.remedy
    v, u = np.mgrid[:240, :320]
    rays = np.stack([u, v, np.ones_like(u)], -1)[None] @ np.linalg.inv(room.K)[:, None].transpose(0, 1, 3, 2)
    findings = examine_images(with_depth(blank, room, room.depth * np.linalg.norm(rays, axis=-1))).findings
    assert findings.cause.name == "depth along the ray"


@pytest.mark.parametrize("error", COMMON)
@pytest.mark.parametrize("voxels", [False, pytest.param(True, marks=LONG)])
def test_an_error_is_inferred_from_silhouettes_only(cut_out, voxels, error):
    scene = with_voxels(cut_out) if voxels else cut_out
    good = examine_images(scene).findings
    assert good.verdict == "good"
    if voxels:
        assert check(good, "inside the silhouettes").value > 99
        assert check(good, "overlap").value > 80
    cause = examine_images(planted(scene, error)).findings.cause
    assert cause.name == error


@pytest.mark.parametrize("shift", [0.0, 0.5])
def test_half_a_pixel_is_inferred_from_silhouettes(cut_out, shift):
    K, _ = matrices(cut_out)
    K[:, :2, 2] += shift
    cause = examine_images(with_cameras(cut_out, K=K)).findings.cause
    assert (cause and cause.name) == ("half a pixel" if shift else None)


def test_cameras_in_one_place_are_compared_by_their_rotations(tmp_path):
    rolls = [0.0, 0.25, 0.5, 0.8]
    traced = trace([(0.3, 0.2, -2.2)] * 4, rolls)
    scene = write(traced, tmp_path)
    findings = examine_images(scene).findings
    assert findings.verdict == "good"
    assert check(findings, "epipolar").value < 0.2
    assert "all cameras are in one place" in " ".join(findings.remarks)
    assert examine_images(planted(scene, "rotation transposed")).findings.verdict == "bad"


def test_views_of_different_sizes(room, images, tmp_path):
    from PIL import Image

    large = tmp_path / "large.png"
    with Image.open(images.paths[2]) as image:
        image.resize((960, 720), Image.Resampling.BICUBIC).save(large)
    K, _ = matrices(images)
    K[2, :2, 2] = 3 * (K[2, :2, 2] + 0.5) - 0.5
    K[2, [0, 1], [0, 1]] *= 3
    scene = replace(with_cameras(images, K=K), paths=(*images.paths[:2], large, *images.paths[3:]))
    height, width = (value.clone() for value in scene.cameras[2:])
    height[2], width[2] = 720, 960
    scene = replace(scene, cameras=scene.cameras._replace(height=height, width=width))
    findings = examine_images(scene).findings
    assert findings.verdict == "good"
    assert "2 sizes from 320 x 240 to 960 x 720" in dict(findings.facts)["images"]


def test_nothing_to_measure_is_no_verdict(blank):
    assert examine_images(blank).findings.verdict == "unknown"
    alone = replace(
        blank,
        names=blank.names[:1],
        paths=blank.paths[:1],
        cameras=type(blank.cameras)(*(torch.as_tensor(value)[:1] for value in blank.cameras)),
    )
    findings = examine_images(alone).findings
    assert findings.verdict == "unknown"
    assert findings.checks == ()


def test_a_damaged_image_is_a_data_error(images, tmp_path):
    bad = tmp_path / "bad.png"
    bad.write_bytes(images.paths[0].read_bytes()[:2000])
    scene = replace(images, paths=(bad, *images.paths[1:]))
    with pytest.raises(DataError, match=r"bad\.png"):
        examine_images(scene)


def test_some_of_many_images_are_measured(images, monkeypatch):
    count = 90
    rows = np.arange(count) % 7
    scene = replace(
        images,
        names=tuple(f"{index}.png" for index in range(count)),
        paths=tuple(images.paths[row] for row in rows),
        cameras=type(images.cameras)(*(torch.as_tensor(value)[rows] for value in images.cameras)),
    )
    measured = []

    def no_matches(scene, views):
        measured.extend(views)
        return match_features(scene, views[:0])

    monkeypatch.setattr(evidence, "match_features", no_matches)
    findings = examine_images(scene).findings
    assert len(measured) == 40
    assert measured[:4] == [0, 1, 2, 3]
    assert measured[-4:] == [86, 87, 88, 89]
    assert dict(findings.facts)["measured"].startswith("40 of them")
