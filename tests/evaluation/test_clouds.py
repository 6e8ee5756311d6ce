"""Points of depth maps, against a lifting of their own in numpy: K^-1, R^T and integer pixel centres."""

import numpy as np
import torch

from lsmgeo.cameras import orbit, select
from lsmgeo.evaluation.report_clouds import joint_cloud

HEIGHT, WIDTH = 9, 12
CENTRE, RADIUS = np.array([0.1, -0.05, 0.2]), 0.35


def see_sphere(intrinsics, cam_from_world):
    """Depth (h, w) of a sphere, 0 beside it, and its points (N, 3) in the order of the pixels."""
    R, t = cam_from_world[:3, :3], cam_from_world[:3, 3]
    origin, depth, points = -R.T @ t, np.zeros((HEIGHT, WIDTH)), []
    for row in range(HEIGHT):
        for column in range(WIDTH):
            ray = R.T @ np.linalg.inv(intrinsics) @ [column, row, 1.0]  # of camera z 1
            a, b, c = ray @ ray, ray @ (origin - CENTRE), (origin - CENTRE) @ (origin - CENTRE) - RADIUS**2
            if b * b > a * c:
                depth[row, column] = (-b - np.sqrt(b * b - a * c)) / a
                points.append(origin + depth[row, column] * ray)
    return depth, np.array(points)


def test_a_joint_cloud_lies_on_what_was_seen():
    azimuths = torch.tensor([20.0, 140.0, 250.0], dtype=torch.float64)
    cameras = orbit(azimuths, 25.0, 2.0, focal_length=22.0, height=HEIGHT, width=WIDTH)
    # Neither the axes' focal lengths nor the middle of the picture may be taken for granted.
    cameras = cameras._replace(intrinsics=cameras.intrinsics.clone())
    cameras.intrinsics[:, 1, 1], cameras.intrinsics[:, 0, 2], cameras.intrinsics[:, 0, 1] = 20.0, 4.5, 0.5
    images = 1.2 * torch.rand(3, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0)) - 0.1
    views = [see_sphere(*(value.numpy() for value in select(cameras, 0, view)[:2])) for view in range(2)]
    depth = torch.from_numpy(np.stack([seen for seen, _ in views]))
    assert all(20 < len(points) < HEIGHT * WIDTH - 20 for _, points in views)

    points, colours = joint_cloud(depth, images, cameras)  # the third image has no map

    np.testing.assert_allclose(points, np.concatenate([lifted for _, lifted in views]), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(points - CENTRE, axis=1), RADIUS, atol=1e-6)
    seen = [image[:, one > 0].T for image, one in zip(images.numpy(), depth.numpy(), strict=False)]
    expected = np.rint(255 * np.clip(np.concatenate(seen), 0, 1))
    assert colours.dtype == np.uint8
    np.testing.assert_allclose(colours.astype(int), expected, atol=0)
