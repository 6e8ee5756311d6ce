"""The C++ kernels. All else about the package is in setup.cfg.

They are optional: without a C++ compiler the package installs and runs on PyTorch's operations.
"""

from setuptools import Extension, setup

NATIVE = "lsmgeo/kernels/native"
HEADERS = ("call", "resample", "simd", "sampling", "sources", "copies", "forward", "backward")

setup(
    ext_modules=[
        Extension(
            "lsmgeo.kernels.native._native",
            [f"{NATIVE}/kernels.cpp"],
            depends=[f"{NATIVE}/{name}.h" for name in HEADERS],
            language="c++",
            # NaN and infinity keep their meaning. What is given up is to tell PyTorch of arithmetic exceptions.
            extra_compile_args=[
                "-std=c++17",
                "-O3",
                "-g0",
                "-fno-math-errno",
                "-fno-trapping-math",
                "-ffp-contract=fast",
                "-fvisibility=hidden",
                "-Wno-psabi",
            ],
            py_limited_api=True,  # it knows nothing of Python: one build serves every version
            optional=True,
        )
    ]
)
