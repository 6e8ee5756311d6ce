"""Fused C++ kernels for the CPU, and the Python that calls them."""
