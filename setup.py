"""Build the filter in C; everything else of the build stands in pyproject.toml.

One library for each width of a processor's vectors: functional/native.py loads the one that PyTorch
uses on the machine. All are optional: where one cannot be compiled (no compiler, or another
processor) the package installs without it. In a checkout: ``python setup.py build_ext --inplace``.
"""

from glob import glob

from setuptools import Extension, setup

# Without errno and traps roots and choices become vector instructions; sums keep their order.
FLAGS = ["-O3", "-std=gnu11", "-fno-math-errno", "-fno-trapping-math", "-g0"]
WIDTHS = {"baseline": [], "avx2": ["-march=x86-64-v3"], "avx512": ["-march=x86-64-v4"]}

setup(
    ext_modules=[
        Extension(
            f"torchrl_drbpn._native_{width}",
            sources=[f"torchrl_drbpn/csrc/filter_{kind}.c" for kind in ("float", "double")],
            depends=glob("torchrl_drbpn/csrc/*.h"),
            extra_compile_args=[*FLAGS, *flags],
            libraries=["m"],
            optional=True,
        )
        for width, flags in WIDTHS.items()
    ]
)
