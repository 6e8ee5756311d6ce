"""The dispatch of backends, and what the kernels hold in memory."""
