"""The C code of the package: compiled once for a machine, when it is first used.

The C compiler is the one named in ``CC`` or found on the path; the library goes into the user's
cache folder (``XDG_CACHE_HOME``, else ``~/.cache``), under a name that holds its source, what that
includes from here, the compiler's command and the width of the processor's vectors.
``TORCHRL_DRBPN_NATIVE=0`` switches it off. Where it cannot be had, every function of the package
runs in PyTorch.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import re
import shlex
import shutil
import subprocess
import tempfile
from pathlib import Path

import torch

__all__ = ["NativeError", "load_library", "native_error"]

# moments.c is the running statistics, heads.c
# PPO's terms of two small networks, arrivals.c what goes missing.
_FOLDER = Path(__file__).parent
_REALS = {torch.float32: "float", torch.float64: "double"}
# Vectors of the width that PyTorch found: the compiled file then runs wherever its name is equal.
_MACHINE_FLAGS = {"AVX512": ["-march=x86-64-v4"], "AVX2": ["-march=x86-64-v3"]}
# Without errno and traps roots and choices become vector instructions; sums keep their order.
_FLAGS = ["-O3", "-std=gnu11", "-fno-math-errno", "-fno-trapping-math", "-fPIC", "-shared"]
# moments.c scales as PyTorch does, each of whose operations is rounded by itself.
_OWN_FLAGS = {"moments": ["-ffp-contract=off"]}


class NativeError(RuntimeError):
    """Say why the C form cannot be had on this machine."""


@functools.cache
def load_library(dtype: torch.dtype, source: str = "moments") -> ctypes.CDLL:
    """Load a C file of this folder, compiled for a dtype; compile it where that is still to do.

    Args:
        dtype: ``torch.float32`` or ``torch.float64``.
        source: ``"moments"`` or ``"arrivals"``.

    Returns:
        Its functions.

    Raises:
        NativeError: with the reason, where it cannot be had.

    Example:
        >>> import torch
        >>> native_error() is not None or hasattr(load_library(torch.float32), "moments_learn")
        True
    """
    if os.environ.get("TORCHRL_DRBPN_NATIVE", "1") == "0":
        raise NativeError("TORCHRL_DRBPN_NATIVE=0 switches it off")
    named = shlex.split(os.environ.get("CC", ""))
    compiler = named or [next(filter(shutil.which, ("cc", "gcc", "clang")), "")]
    if not compiler[0] or shutil.which(compiler[0]) is None:
        raise NativeError("there is no C compiler: install gcc or clang, or name one in CC")
    flags = [*_FLAGS, *_MACHINE_FLAGS.get(torch.backends.cpu.get_cpu_capability(), [])]
    command = [*compiler, *flags, *_OWN_FLAGS.get(source, []), f"-DREAL={_REALS[dtype]}"]
    file = _FOLDER / f"{source}.c"
    text = "\n".join([*command, platform.machine(), *_texts(file)])
    name = f"{source}-{_REALS[dtype]}-{hashlib.sha256(text.encode()).hexdigest()[:20]}.so"
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError as error:
        raise NativeError(f"name a folder for it in XDG_CACHE_HOME: {error}") from error
    path = Path(home) / "torchrl_drbpn" / name
    try:
        if not path.is_file():
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=path.parent) as folder:
                built = Path(folder) / name
                done = subprocess.run(
                    [*command, "-o", str(built), str(file), "-lm"],
                    capture_output=True,
                    text=True,
                    check=False,
                )
                if done.returncode:
                    reason = " ".join(done.stderr.split())[:300]
                    raise NativeError(f"`{compiler[0]}` refused {file.name}: {reason}")
                built.replace(path)  # whole or not at all, whoever else compiles it now
        return ctypes.CDLL(str(path))
    except OSError as error:
        raise NativeError(f"it could not be built or loaded: {error}") from error


def _texts(file: Path) -> list[str]:
    """Return the text of a C file and of those of this folder that it includes."""
    text = file.read_text(encoding="utf-8")
    pieces = re.findall(r'^#include "(.+)"', text, re.MULTILINE)
    return [text, *(own for piece in pieces for own in _texts(file.parent / piece))]


@functools.cache
def native_error(dtype: torch.dtype = torch.float32, source: str = "moments") -> str | None:
    """Say why the C form cannot be had on this machine; compiles it where that is still to do.

    Args:
        dtype: of the filter's tensors.
        source: ``"moments"`` for the running statistics, ``"arrivals"``
            for PPO's terms, ``"arrivals"`` for what goes missing.

    Returns:
        None where it can be had, else the reason.

    Example:
        >>> native_error(torch.float16)
        'there is no C form for torch.float16'
    """
    if dtype not in _REALS:
        return f"there is no C form for {dtype}"
    try:
        load_library(dtype, source)
    except NativeError as error:
        return str(error)
    return None
