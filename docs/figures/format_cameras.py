"""The cameras of one file format beside this library's; the format's name is the argument."""

import sys

from format_drawing import OURS, draw_conventions

OPENGL = ("right", "up", "back")
FORMATS = {
    "colmap": ("COLMAP", OURS, "QW QX QY QZ, TX TY TZ", True, 0.5),
    "middlebury": ("Middlebury multi-view", OURS, "R, t", True, 0.0),
    "strecha": ("Strecha .camera", OURS, "R, centre", False, 0.0),
    "transforms": ("transforms.json", OPENGL, "transform_matrix", False, 0.5),
    "llff": ("poses_bounds.npy", ("down", "right", "back"), "first four columns", False, 0.5),
    "rgbd": ("RGB-D folder", OURS, "poses.txt, *.pose.txt", False, 0.0),
    "opencv": ("OpenCV calibration", OURS, "R, T", True, 0.0),
    "cameras_json": ("cameras.json", OURS, "R, t", True, 0.0),
    "lsm": ("LSM release", OURS, "extrinsic", True, 0.5),
}

source, directions, matrix, to_camera, center = FORMATS[sys.argv[1]]
draw_conventions(source, directions, matrix=matrix, to_camera=to_camera, center=center)
