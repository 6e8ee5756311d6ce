"""Middlebury stereo pairs: what the files define is what cameras and depth say."""

import cv2
import numpy as np
import pytest
from PIL import Image

from lsmgeo import data
from lsmgeo.data.formats.depth_files import read_pfm

F, CX, CY, DOFFS, BASELINE = 50.5, 15.25, 11.5, 3.125, 193.001
HEIGHT, WIDTH = 24, 32


def write_pair(folder, images=None, disparities=None, numbers=(F, CX, CY, DOFFS, BASELINE)):
    """A published folder; disparities as (H, W) maps of the left and the right view, or None."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    if images is None:
        images = rng.integers(0, 256, (2, HEIGHT, WIDTH, 3), dtype=np.uint8)
    if disparities is None:
        disparities = rng.uniform(0.5, 20, (2, HEIGHT, WIDTH)).astype(np.float32)
        disparities[:, 3, 4] = np.inf
    f, cx, cy, offset, baseline = numbers
    height, width = images[0].shape[:2]
    lines = [
        f"cam0=[{f} 0 {cx}; 0 {f} {cy}; 0 0 1]", f"cam1=[{f} 0 {cx + offset}; 0 {f} {cy}; 0 0 1]", f"doffs={offset}",
        f"baseline={baseline}", f"width={width}", f"height={height}", "ndisp=280", "isint=0", "vmin=31", "vmax=257",
        "dyavg=0.918", "dymax=1.516",
    ]  # fmt: skip
    (folder / "calib.txt").write_text("\n".join(lines) + "\n")
    for side, image in enumerate(images):
        Image.fromarray(image).save(folder / f"im{side}.png")
        if disparities[side] is not None:
            cv2.imwrite(str(folder / f"disp{side}.pfm"), disparities[side])
    return folder, np.asarray(disparities) if disparities[1] is not None else disparities


def test_the_disparity_moves_each_pixel_to_the_other_image(tmp_path):
    folder, disparities = write_pair(tmp_path)
    read = data.open(folder)
    assert read.source == "middlebury-stereo"
    assert read.names == ("im0.png", "im1.png")
    K, E = read.cameras.intrinsics.numpy(), read.cameras.cam_from_world.numpy()
    for view, sign in ((0, -1), (1, 1)):
        depth = read.load_depth(view).numpy().astype(np.float64)
        assert depth[3, 4] == 0
        v, u = np.nonzero(depth)
        assert len(u) == HEIGHT * WIDTH - 1
        points = np.linalg.inv(K[view]) @ (np.stack([u, v, np.ones_like(u)]) * depth[v, u])
        world = E[view, :3, :3].T @ (points - E[view, :3, 3:])
        other = K[1 - view] @ (E[1 - view, :3, :3] @ world + E[1 - view, :3, 3:])
        np.testing.assert_allclose(other[0] / other[2], u + sign * disparities[view][v, u], atol=1e-4)
        np.testing.assert_allclose(other[1] / other[2], v, atol=1e-4)


def test_the_world_is_the_left_camera_in_units_of_the_baseline(tmp_path):
    read = data.open(write_pair(tmp_path)[0] / "calib.txt")
    np.testing.assert_array_equal(read.cameras.cam_from_world[0].numpy(), np.eye(4))
    np.testing.assert_allclose(read.cameras.cam_from_world[1, :3, 3].numpy(), [-BASELINE, 0, 0])
    left, right = read.cameras.intrinsics.numpy()
    np.testing.assert_allclose(left, [[F, 0, CX], [0, F, CY], [0, 0, 1]])
    np.testing.assert_allclose(right[0, 2], CX + DOFFS)


def test_a_pair_may_have_one_map_or_none(tmp_path):
    folder, disparities = write_pair(tmp_path)
    (folder / "disp1.pfm").unlink()
    (folder / "disp0.pfm").rename(folder / "disp0GT.pfm")
    read = data.open(folder)
    assert read.load_depth(1) is None
    expected = F * BASELINE / (disparities[0].astype(np.float64) + DOFFS)
    np.testing.assert_allclose(read.load_depth(0).numpy()[5:], expected[5:], rtol=1e-6)
    (folder / "disp0GT.pfm").unlink()
    assert data.open(folder).depths is None


def test_a_disparity_without_a_point_before_the_camera_is_no_depth(tmp_path):
    strange = np.full((HEIGHT, WIDTH), 1.0, np.float32)
    strange[0, :6] = [np.inf, -np.inf, np.nan, -DOFFS, -20, np.nextafter(np.float32(-DOFFS), np.float32(0))]
    folder, _ = write_pair(tmp_path, disparities=[strange, None])
    depth = data.open(folder).load_depth(0).numpy()
    assert (depth[0, :5] == 0).all()
    assert np.isfinite(depth).all()
    assert (depth[1:] > 0).all()


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("scale", ["1", "1.000000", "0.003922"])
def test_float_maps_are_read_from_the_bottom_in_either_order(tmp_path, order, scale):
    values = np.arange(6, dtype=np.float32).reshape(2, 3)
    sign = "-" if order == "<" else ""
    body = values[::-1].astype(f"{order}f4").tobytes()
    (tmp_path / "a.pfm").write_bytes(f"Pf\n3 2\n{sign}{scale}\n".encode() + body)
    np.testing.assert_array_equal(read_pfm(tmp_path / "a.pfm", (2, 3)), values)
    if order == "<" and scale == "1":
        np.testing.assert_array_equal(cv2.imread(str(tmp_path / "a.pfm"), cv2.IMREAD_UNCHANGED), values)
