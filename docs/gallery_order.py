"""The order in which the gallery is best read."""

ORDER = [
    "plot_one_view_unprojected.py",
    "plot_two_views_agreeing.py",
    "plot_half_pixel_mistake.py",
    "plot_wrong_poses.py",
    "plot_plane_sweep_sphere.py",
    "plot_plane_sweep_stereo.py",
    "plot_depth_range.py",
    "plot_birds_eye_view.py",
    "plot_visual_hull.py",
    "plot_pose_noise.py",
    "plot_analytic_scene.py",
    "plot_synthetic13.py",
    "plot_mesh_voxels.py",
]


class ReadingOrder:
    """Sort key of sphinx-gallery: the position in `ORDER`; a file that is not listed is an error."""

    def __init__(self, src_dir: str) -> None:
        self.src_dir = src_dir

    def __call__(self, filename: str) -> int:
        return ORDER.index(filename)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}>"
