"""Export an agent for a robot: ``python recipes/export.py run=agents/walker2d out=policy.pt2``.

Normalisation, filter and policy head become one file that decides once a call; docs/deploy.md says
how a control loop calls it. The agent acts for some steps first: the file is kept if it decides the
same at each of them, with NaN in the place of what did not arrive and its own state fed back.
"""

import importlib
import importlib.util
import logging
import statistics
import timeit
import warnings
from collections.abc import Callable, Sequence
from contextlib import closing
from math import inf
from pathlib import Path
from typing import Any

import torch
import torch._inductor  # where torch documents ahead-of-time compilation; it has no other name
from evaluation.trained import TrainedAgent, load_trained_agent
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs.utils import ExplorationType, set_exploration_type
from training.agent import add_primers
from training.config import check_limits, command, require_cpp_compiler
from training.console import log_line
from training.envs import make_env
from training.errors import UserError
from training.run_folder import whole

from torchrl_drbpn import PolicyStep
from torchrl_drbpn.modules import MaskedObservationNorm

Decide = Callable[..., Sequence[Tensor]]

INPUTS = ("observation", "observed", "previous_action", "is_init", "mean", "age", "cov")
OUTPUTS = ("action", "next_mean", "next_age", "chosen", "rejected", "next_cov")
FORMATS = {"aoti": ".pt2", "export": ".pt2", "onnx": ".onnx"}
PACKAGES = ("onnx", "onnxscript", "onnxruntime")
_LIMITS = dict.fromkeys(("robots", "steps", "calls"), (1, inf))
# Together they compile the matrix products too, which are calls into ATen without them.
_INDUCTOR = {"freezing": True, "max_autotune": True}
_TOLERANCE = 1e-3  # of the largest action


def run(config: dict[str, Any]) -> int:
    """Export the agent of a run; see conf/export.yaml."""
    kind, out = _check(config)
    torch.set_num_threads(config["threads"])
    trained = load_trained_agent(Path(config["run"]), config["robust"], config["robust_threshold"])
    policy, robots = trained.agent.policy, config["robots"]
    data, actions = record(trained, robots, config["steps"], config["seed"])
    step = policy_step(trained, actions, sequential=kind == "onnx")
    inputs = (*(data[:, 0][name].contiguous() for name in INPUTS[:4]), *step.initial_state(robots))
    with whole(out) as path, torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        write(kind, step, inputs, path)
        decide = load(kind, path, config["threads"])
        difference, largest = compare(decide, inputs, data)
        if not difference <= _TOLERANCE * largest:
            raise UserError(
                f"`{out}` is not written: its actions differ from the agent's by {difference:.2g}, "
                f"the largest of which is {largest:.2g}."
            )
        row = data[:, -1].select(*policy.in_keys, strict=False)
        times = [
            latency(call, config["calls"])
            for call in (lambda: decide(*inputs), lambda: policy(row.copy()))
        ]
    for what, names, values in (("in", INPUTS, inputs), ("out", OUTPUTS, decide(*inputs))):
        parts = [f"{n} {_described(v)}" for n, v in zip(names, values, strict=False)]
        log_line(f"{what}: {', '.join(parts)}")
    episodes, missing = int(data["is_init"].sum()), 1 - data["observed"].double().mean().item()
    log_line(
        f"{data.numel()} steps, episodes {episodes}, missing {missing:.3f}: actions, at most "
        f"{largest:.3g}, differ from the agent's by at most {difference:.2g}"
    )
    log_line(f"a decision takes {times[0]:,.0f} us from Python, of the agent {times[1]:,.0f} us")
    log_line(f"written: {out} ({kind}, {out.stat().st_size / 1e6:.2f} MB)")
    return 0


def record(
    trained: TrainedAgent, robots: int, steps: int, seed: int
) -> tuple[TensorDictBase, TensorSpec]:
    """Let an agent act by its mean action where it was trained, episode after episode.

    Returns the steps, ``(robots, steps)``, and the actions that the environment takes.
    """
    with closing(make_env(trained.settings, num_envs=robots, seed=seed)) as env:
        add_primers(env, trained.agent)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            data = env.rollout(steps, trained.agent.policy, break_when_any_done=False)
        return data, env.action_spec


def policy_step(trained: TrainedAgent, actions: TensorSpec, *, sequential: bool) -> PolicyStep:
    """Make the module that decides on plain tensors, within the limits of an action."""
    agent = trained.agent
    if not isinstance(agent.norm, MaskedObservationNorm):
        raise UserError("`normalisation.observation` must be a MaskedObservationNorm for export.")
    try:
        return PolicyStep(
            agent.belief,
            agent.actor.module[0].module,
            norm=agent.norm,
            action_low=actions.space.low[0],
            action_high=actions.space.high[0],
            sequential=sequential,
        )
    except TypeError as error:
        raise UserError(
            f"`run` must hold a belief filter (belief=drbpn or drbpn_propagated) to be exported, "
            f"got belief={trained.settings.belief.get('name')}."
        ) from error
    except ValueError as error:
        raise UserError(f"`format=onnx`: {error}" if sequential else str(error)) from error


def write(kind: str, step: PolicyStep, inputs: tuple[Tensor, ...], path: Path) -> None:
    """Write the file of a decision, in one of `FORMATS`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch about itself
        program = torch.export.export(step, inputs)
        if kind == "export":
            torch.export.save(program, path)
        elif kind == "onnx":
            logging.getLogger("torch.onnx").setLevel(logging.ERROR)
            names: Any = {"input_names": INPUTS[: len(inputs)]}
            names |= {"output_names": OUTPUTS[: len(inputs) - 1]}
            torch.onnx.export(program, (), path, external_data=False, verbose=False, **names)
        else:
            logging.getLogger("torch._inductor").setLevel(logging.ERROR)
            torch._inductor.aoti_compile_and_package(
                program, package_path=str(path), inductor_configs=_INDUCTOR
            )


def load(kind: str, path: Path, threads: int = 1) -> Decide:
    """Read what :func:`write` wrote, as a function of tensors."""
    if kind == "aoti":
        return torch._inductor.aoti_load_package(str(path))
    if kind == "export":
        return torch.export.load(path).module()
    runtime = importlib.import_module("onnxruntime")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = threads
    session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])

    def decide(*inputs: Tensor) -> list[Tensor]:
        given = {name: x.numpy() for name, x in zip(INPUTS, inputs, strict=False)}
        return [torch.from_numpy(x) for x in session.run(None, given)]

    return decide


def compare(
    decide: Decide, inputs: tuple[Tensor, ...], data: TensorDictBase
) -> tuple[float, float]:
    """Return by how much actions differ from recorded ones, at most, and the largest action.

    The state and the previous action are those that the file itself returned.
    """
    state, action, everything = inputs[4:], torch.zeros_like(inputs[2]), torch.ones_like(inputs[1])
    found = []
    for row in data.transpose(0, 1).contiguous():  # a compiled file takes strides for granted
        x, first = row["observation"].where(row["observed"], torch.nan), row["is_init"]
        given = x, everything, torch.where(first, 0.0, action), first, *state
        _, mean, age, action, _, *cov = decide(*given)
        state = (mean, age, *cov)
        found.append(action)
    recorded = data["action"]
    return (torch.stack(found, 1) - recorded).abs().max().item(), recorded.abs().max().item()


def latency(call: Callable[[], Any], calls: int) -> float:
    """Return the median time of a call, microseconds, after a tenth as many to warm up."""
    times = timeit.repeat(call, number=1, repeat=calls + calls // 10)
    return 1e6 * statistics.median(times[calls // 10 :])


def _described(value: Tensor) -> str:
    return f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}"


def _check(config: dict[str, Any]) -> tuple[str, Path]:
    """Refuse what can't be done before an agent is loaded; return format and file."""
    if config["run"] is None or not Path(config["run"]).is_dir():
        raise UserError(f"`run` must name a run folder: run=runs/<folder>, got {config['run']}.")
    check_limits(config, _LIMITS, whole=True)
    out = Path(str(config["out"]))
    kind = config["format"] or ("onnx" if out.suffix == ".onnx" else "aoti")
    if kind not in FORMATS:
        raise UserError(f"`format` must be aoti, export or onnx, got {kind!r}.")
    if out.suffix != FORMATS[kind]:
        raise UserError(f"`out` must end in {FORMATS[kind]} for format={kind}, got {out.name}.")
    if not out.parent.is_dir():
        raise UserError(f"`out` must lie in an existing folder, got {out}.")
    missing = [name for name in PACKAGES if kind == "onnx" and not importlib.util.find_spec(name)]
    if missing:
        raise UserError(
            f"`format=onnx` needs {' and '.join(missing)}: pip install {' '.join(missing)}"
        )
    if kind == "aoti":
        instead = "format=export, which the robot's torch runs or compiles"
        require_cpp_compiler("format=aoti", instead)
    return kind, out


if __name__ == "__main__":
    command("export", run)
