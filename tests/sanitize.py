"""Run the native filter under the address and undefined-behaviour sanitizers: one command.

    python tests/sanitize.py

The C is compiled with both sanitizers into a copy of the package, where the operator's tests run
and then a fuzz of valid and of spoilt arguments: whatever the sizes, a call either raises or stays
inside its memory. Leaks are not looked for: Python keeps memory on purpose.
"""

import os
import random
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
FLAGS = "-O1 -g -march=native -fno-omit-frame-pointer "
FLAGS += "-fsanitize=address,undefined -fno-sanitize-recover=all"


def main():
    """Build into a copy, run the tests and the fuzz there; the exit status is the worst of both."""
    compiler = os.environ.get("CC", "cc")
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in ("torchrl_drbpn", "tests"):
            skip = shutil.ignore_patterns("__pycache__", "_native_*")
            shutil.copytree(ROOT / name, copy / name, ignore=skip)
        shutil.copy(ROOT / "setup.py", copy)
        (copy / "tests" / "conftest.py").unlink()  # it would build the ordinary library
        sources = [ROOT / f"torchrl_drbpn/csrc/filter_{kind}.c" for kind in ("float", "double")]
        built = copy / "torchrl_drbpn" / "_native_baseline.so"
        command = [compiler, *FLAGS.split(), "-std=gnu11", "-fPIC", "-shared", "-o", str(built)]
        subprocess.run([*command, *map(str, sources), "-lm"], check=True)
        runtimes = [
            subprocess.check_output([compiler, f"-print-file-name={name}"], text=True).strip()
            for name in ("libasan.so", "libubsan.so")
        ]
        environment = os.environ | {"LD_PRELOAD": ":".join(runtimes), "OMP_NUM_THREADS": "1"}
        environment |= {"ASAN_OPTIONS": "detect_leaks=0", "PYTHONPATH": f"{copy}:{copy / 'tests'}"}
        environment["ATEN_CPU_CAPABILITY"] = "default"  # the library that is there
        tests = ["-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", str(copy)]
        tests.append(str(copy / "tests" / "test_functional_native.py"))
        worst = 0
        for arguments in (tests, [str(copy / "tests" / "sanitize.py"), "fuzz"]):
            run = subprocess.run(
                [sys.executable, *arguments], cwd=copy, env=environment, check=False
            )
            worst = max(worst, abs(run.returncode))
    print("FAILED" if worst else "the sanitizers found nothing")  # noqa: T201
    return worst


def fuzz(count=400):
    """Call the operator and its gradient with random sizes, half of the calls with one spoilt.

    The gradient is called by itself too, with the tape, or another one, before the arguments.
    """
    import torch
    from filter_problems import Problem

    from torchrl_drbpn.functional import native

    assert native.native_status() is None, native.native_status()
    draw, refused, operator = random.Random(0), 0, torch.ops.torchrl_drbpn.filter_rows
    for i in range(count):
        problem = Problem(
            draw.randint(1, 20), draw.randint(1, 20), batch=draw.randint(1, 9),
            time=draw.randint(3, 6), seed=i, full_noise=draw.random() < 0.3,
            stored=draw.random() < 0.5,
            hidden=tuple(draw.choices(range(1, 20), k=draw.randint(0, 3))),
            dtype=draw.choice([torch.float32, torch.float64]), propagated=draw.random() < 0.5,
        )  # fmt: skip
        arguments = problem.operator_arguments()
        spoilt = draw.random() < 0.5
        full = problem.full_noise and problem.jacobian is not None  # which it does not take
        given = list(arguments)
        if spoilt:
            spoil(draw, given, draw.randrange(18))
        try:
            out = operator(*given)
        except (ValueError, RuntimeError):
            assert spoilt or full
            refused += 1
        else:
            (out[0].sum() + out[1].sum()).backward()
        if full:
            continue
        mean, ll, tape, _ = operator(*arguments)
        back = [torch.ones_like(mean), torch.ones_like(ll), tape, *arguments]
        if spoilt:
            spoil(draw, back, draw.randrange(21))
        try:
            with torch.no_grad():
                torch.ops.torchrl_drbpn.filter_rows_backward(*back)
        except (ValueError, RuntimeError):
            assert spoilt
            refused += 1
    print(f"{count} problems, each forward and back, {refused} calls refused")  # noqa: T201


def spoil(draw, arguments, place):
    """Give one argument another size or dtype, or a network fewer layers."""
    import torch

    value = arguments[place]
    if isinstance(value, torch.Tensor):
        dims = [max(0, n + draw.choice([-1, 0, 0, 1])) for n in value.shape]
        dtype = draw.choice([value.dtype, torch.float16])
        arguments[place] = torch.zeros(dims, dtype=dtype)
    elif isinstance(value, list):
        arguments[place] = value[: draw.randrange(len(value))]


if __name__ == "__main__":
    sys.exit(fuzz() if sys.argv[1:] == ["fuzz"] else main())
