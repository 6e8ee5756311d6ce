"""The operators under compilers, exporters and transforms, and beside kornia, OpenCV and other conventions."""
