"""The cameras of file formats beside this library's, a function each."""

from format_drawing import OURS, draw_conventions

OPENGL = ("right", "up", "back")


def colmap() -> None:
    draw_conventions("COLMAP", OURS, matrix="QW QX QY QZ, TX TY TZ", to_camera=True, center=0.5)


def middlebury() -> None:
    draw_conventions("Middlebury multi-view", OURS, matrix="R, t", to_camera=True, center=0.0)


def strecha() -> None:
    draw_conventions("Strecha .camera", OURS, matrix="R, centre", to_camera=False, center=0.0)


def transforms() -> None:
    draw_conventions("transforms.json", OPENGL, matrix="transform_matrix", to_camera=False, center=0.5)


def llff() -> None:
    directions = ("down", "right", "back")
    draw_conventions("poses_bounds.npy", directions, matrix="the first four columns", to_camera=False, center=0.5)


def rgbd() -> None:
    draw_conventions("RGB-D folder", OURS, matrix="poses.txt, *.pose.txt", to_camera=False, center=0.0)


def opencv() -> None:
    draw_conventions("OpenCV calibration", OURS, matrix="R, T", to_camera=True, center=0.0)


def cameras_json() -> None:
    draw_conventions("cameras.json", OURS, matrix="cam_from_world", to_camera=True, center=0.0)


def lsm() -> None:
    draw_conventions("LSM release", OURS, matrix="extrinsic", to_camera=True, center=0.5)
