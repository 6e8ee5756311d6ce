"""The figures of the real objects of the LSM release and of 3D-R2N2, reached through our readers.

The folder is named by ``LSMGEO_TEST_DATA``; the sets themselves cannot be distributed.
"""

import numpy as np
from PIL import Image
from scipy.ndimage import binary_dilation

from lsmgeo import data
from tests.data.real_sets import real_sets


def cell_pixels(scene, view, share):
    """(N, M, 2) whole pixels that M points of each of N occupied cells, shrunk to a share, fall on."""
    grid, side = scene.voxels.grid, len(scene.voxels.occupancy)
    step = (grid.upper[0] - grid.lower[0]) / side
    line = np.linspace(-0.5, 0.5, 5) * share * step
    inside = np.stack(np.meshgrid(line, line, line), -1).reshape(-1, 3)
    points = grid.centers().double().numpy()[scene.voxels.occupancy.numpy()][:, None] + inside
    K, E = scene.cameras.intrinsics[view].numpy(), scene.cameras.cam_from_world[view].numpy()
    pixels = (points @ E[:3, :3].T + E[:3, 3]) @ K.T
    return np.rint(pixels[..., :2] / pixels[..., 2:]).astype(int)


def test_depth_of_the_lsm_sample_lies_at_its_voxels():
    near = total = 0
    for folder in real_sets("lsm_sample/renders/*/*"):
        scene = data.open(folder)
        assert len(scene) == 20
        occupied = binary_dilation(scene.voxels.occupancy.numpy(), np.ones((3, 3, 3)))
        for view in range(len(scene)):
            depth = scene.load_depth(view).double().numpy()
            K, E = scene.cameras.intrinsics[view].numpy(), scene.cameras.cam_from_world[view].numpy()
            v, u = np.nonzero(depth)
            rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
            points = (rays * depth[v, u][:, None] - E[:3, 3]) @ E[:3, :3]
            index = np.floor((points + 0.5) * 32).astype(int)
            inside = ((index >= 0) & (index < 32)).all(1)
            x, y, z = index.clip(0, 31).T
            near += int((occupied[z, y, x] & inside).sum())
            total += len(points)
    assert total > 100_000
    assert near / total > 0.999


def test_every_voxel_of_the_lsm_sample_meets_every_silhouette():
    for folder in real_sets("lsm_sample/renders/*/*"):
        scene = data.open(folder)
        for view in range(len(scene)):
            alpha = np.array(Image.open(scene.paths[view]))[..., 3] > 0
            pixels = cell_pixels(scene, view, 1.0)
            assert alpha[pixels[..., 1], pixels[..., 0]].any(1).all()


def test_the_other_resolution_of_the_lsm_sample_is_the_same_solid():
    for folder in real_sets("lsm_sample/renders/*/*"):
        coarse, fine = (data.read_lsm(folder, voxels=side).voxels.occupancy.numpy() for side in (32, 64))
        halved = fine.reshape(32, 2, 32, 2, 32, 2).any((1, 3, 5))
        assert (halved & coarse).sum() / (halved | coarse).sum() > 0.8


def test_the_voxels_of_the_r2n2_chair_fill_its_silhouettes():
    (folder,) = real_sets("r2n2/chair")
    scene = data.open(folder)
    assert len(scene) == 24
    assert scene.size(0) == (137, 137)
    np.testing.assert_allclose(scene.cameras.intrinsics[0, 0].numpy(), [149.84, 0, 68.0], atol=0.01)
    overlaps, recalls, touching = [], [], []
    for view in range(len(scene)):
        mask = scene.load_mask(view).numpy()
        seen = np.zeros_like(mask)
        # The cells reach beyond the surface that they hold, by a third of a cell in the mean of all sides.
        x, y = cell_pixels(scene, view, 2 / 3).reshape(-1, 2).T
        seen[y, x] = True
        overlaps.append((seen & mask).sum() / (seen | mask).sum())
        recalls.append((seen & mask).sum() / mask.sum())
        x, y = np.moveaxis(cell_pixels(scene, view, 1.0), -1, 0)
        touching.append(mask[y, x].any(1).mean())
    assert np.mean(recalls) >= 0.995
    assert np.mean(overlaps) >= 0.855
    assert np.mean(touching) >= 0.995
