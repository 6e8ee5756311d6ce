"""From posed images to depth maps, points, a mesh and an interactive page: the methods, and the result files."""
