"""Measures of tensors on a GPU are those of the same on the CPU."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lsmgeo import metrics

pytestmark = pytest.mark.gpu


def close(found, expected):
    for one, two in zip(found, expected, strict=True):
        torch.testing.assert_close(torch.as_tensor(one).cpu(), torch.as_tensor(two), rtol=1e-12, atol=0, equal_nan=True)


def test_measures_on_a_gpu():
    generator = np.random.default_rng(11)
    depth = torch.from_numpy(generator.uniform(1.2, 2.8, (2, 3, 40, 50))).float()
    depth[generator.uniform(size=depth.shape) < 0.3] = 0
    predicted = depth + torch.from_numpy(generator.normal(0, 0.2, depth.shape)).float()
    confidence = torch.from_numpy(generator.uniform(size=depth.shape)).float()
    there = [value.cuda() for value in (predicted, depth, depth > 0)]
    close(metrics.depth_errors(*there), metrics.depth_errors(predicted, depth, depth > 0))
    close(metrics.median_depth_error(*there), metrics.median_depth_error(predicted, depth, depth > 0))
    close(metrics.bad_pixel_rate(*there[:2], 0.1, there[2]), metrics.bad_pixel_rate(predicted, depth, 0.1, depth > 0))
    errors, densities = (predicted - depth).abs(), (0.1, 0.5, 1.0)
    expected = metrics.density_curve(errors, confidence, densities, depth > 0)
    close(metrics.density_curve(errors.cuda(), confidence.cuda(), densities, there[2]), expected)
    running = metrics.RunningDensityCurve(densities)
    running.update(errors.cuda(), confidence.cuda(), there[2])
    close(running.compute(), expected)
    probabilities, solid = confidence.reshape(2, 6, 20, 50), (depth > 2).reshape(2, 6, 20, 50)
    expected = metrics.voxel_iou(probabilities, solid)
    close([metrics.voxel_iou(probabilities.cuda(), solid.cuda())], [expected])
    points = torch.from_numpy(generator.uniform(size=(50, 3)))
    expected = metrics.point_cloud_scores(points[:30], points, 0.1)
    close(metrics.point_cloud_scores(points[:30].cuda(), points.cuda(), 0.1), expected)
