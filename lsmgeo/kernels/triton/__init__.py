"""Fused CUDA kernels in Triton, and the Python that launches them."""
