"""Measures of reconstructions against the ground truth: pure functions, and classes that accumulate over a set."""

from lsmgeo.metrics.clouds import CloudScores, point_cloud_scores
from lsmgeo.metrics.curves import DensityCurve, RunningDensityCurve, density_curve
from lsmgeo.metrics.depth import (
    BadPixels,
    DepthErrors,
    MedianDepthError,
    bad_pixel_rate,
    depth_errors,
    median_depth_error,
)
from lsmgeo.metrics.running import CategoryMeans, DepthError, Running, VoxelIoU, category_means
from lsmgeo.metrics.voxels import voxel_iou

__all__ = [
    "BadPixels",
    "CategoryMeans",
    "CloudScores",
    "DensityCurve",
    "DepthError",
    "DepthErrors",
    "MedianDepthError",
    "Running",
    "RunningDensityCurve",
    "VoxelIoU",
    "bad_pixel_rate",
    "category_means",
    "density_curve",
    "depth_errors",
    "median_depth_error",
    "point_cloud_scores",
    "voxel_iou",
]
