"""Clipped PPO and the likelihood of the belief's model: loss, advantages, minibatches, steps."""

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from torch.linalg import LinAlgError  # type: ignore[attr-defined]
from torchrl.objectives import ClipPPOLoss, LossModule
from torchrl.objectives.value import GAE

from torchrl_drbpn import BeliefModelLoss, DRBPNLoss
from training.agent import Agent
from training.config import require_cpp_compiler
from training.errors import DivergedError, UserError

_ESTIMATES = ("advantage", "value_target", "state_value")
_NAMES = {"kl_approx": "kl", "ESS": "ess"}


def make_loss(
    agent: Agent,
    *,
    entropy_coeff: float,
    model_coeff: float,
    normalize: Literal["entry", "step"],
    detach_belief: bool,
    **ppo: Any,
) -> LossModule:
    """Build the loss, see conf/loss/ppo.yaml; its outputs named ``loss*`` are to be summed."""
    clipped = ClipPPOLoss(
        agent.actor,
        agent.critic,
        entropy_bonus=entropy_coeff > 0,
        entropy_coeff=entropy_coeff,
        # The recipe reports it once a rollout; here it is a fifth of the PPO loss.
        log_explained_variance=False,
        # The parameters are those of the modules: swapping them in costs a tenth of an update.
        functional=False,
        **ppo,
    )
    modelled = ("belief", "log_likelihood") in agent.belief.out_keys
    model = BeliefModelLoss(normalize=normalize) if modelled else None
    weights: Any = {"model_coeff": model_coeff, "detach_belief": detach_belief}
    return DRBPNLoss(agent.belief, clipped, model, **weights)


@torch.no_grad()
def add_advantages(
    data: TensorDictBase, agent: Agent, gae: GAE, *, recompute: bool = False
) -> None:
    """Write values and advantages into a normalised rollout ``(environments, time)``, in place.

    Where an episode goes on, the belief that follows a step is the one stored at the next step;
    where one ends, or the rollout is cut, there is another one to value. ``recompute`` values by
    the current parameters: every belief is taken one step on from the stored one before it.
    """
    value = agent.one_step_value(data) if recompute else agent.value(data)
    following = data.get("next")
    ends = following.get("done").squeeze(-1).clone()
    ends[:, -1] = True
    next_value = torch.cat([value[:, 1:], value[:, :1]], 1)
    next_value[ends] = agent.one_step_value(following, ends)
    data.set("state_value", value)
    following.set("state_value", next_value)
    gae(data)


def to_sequences(data: TensorDictBase, loss: LossModule, length: int) -> TensorDictBase:
    """Cut a rollout with advantages into sequences ``(-1, length)`` and keep what the loss reads.

    The last step of each environment is marked ``final``: the rollout ends there, so that the
    observation after it is nobody's root step and its likelihood is counted here. Where sequences
    are cut from each other nothing is marked.
    """
    final = torch.zeros_like(data.get(("next", "done")))
    final[:, -1] = True
    kept = data.select(*loss.in_keys, *_ESTIMATES, strict=False).set("final", final)
    return kept.reshape(-1, length).contiguous()


def minibatches(
    sequences: TensorDictBase, count: int, generator: torch.Generator
) -> Iterator[TensorDictBase]:
    """Yield the sequences in random order, each once, in so many minibatches."""
    order = torch.randperm(sequences.shape[0], generator=generator)
    # One gather an epoch; the minibatches are views of it.
    yield from sequences[order].split(sequences.shape[0] // count)


class GradientSteps:
    """Hold an optimiser and how it steps, see conf/optim/adam.yaml."""

    def __init__(
        self,
        parameters: Iterable[torch.nn.Parameter],
        *,
        optimizer: Callable[..., torch.optim.Optimizer],
        lr: float,
        max_grad_norm: float,
        epochs: int,
        minibatches: int,
        sequence_length: int,
        recompute_advantages: bool,
        compile: bool,
    ) -> None:
        if compile:
            require_cpp_compiler("optim.compile=true", "optim.compile=false, which is slower")
        self.parameters = list(parameters)
        self.optimizer = optimizer(self.parameters, lr=lr)
        self.lr, self.max_grad_norm = lr, max_grad_norm
        self.epochs, self.minibatches, self.sequence_length = epochs, minibatches, sequence_length
        self.recompute_advantages, self.compile = recompute_advantages, compile


class PPO:
    """Take epochs of minibatch steps, in the order of ``seed``, on one loss."""

    def __init__(
        self, agent: Agent, *, loss: LossModule, steps: GradientSteps, gae: GAE, seed: int
    ) -> None:
        self.agent, self.loss, self.steps, self.gae = agent, loss, steps, gae
        self.terms: Callable[[TensorDictBase], TensorDictBase] = loss
        if steps.compile:
            self.terms = torch.compile(loss)
            # Of the compiler about itself, into the progress bar.
            warnings.filterwarnings("ignore", category=FutureWarning, module=r"torch\._inductor")
        # Without memory no gradient flows through time: steps drawn one by one depend less on each
        # other than sequences do, and train better for nothing (docs/reproduction.md).
        self.sequence_length = steps.sequence_length if agent.recurrent else 1
        self.generator = torch.Generator().manual_seed(seed)

    def update(self, data: TensorDictBase, remaining: float) -> dict[str, float]:
        """Take the gradient steps of one rollout; return the means of what the loss reports.

        The learning rate falls with ``remaining``, the share of the run still to come.
        """
        lr = self.steps.lr * remaining
        for group in self.steps.optimizer.param_groups:
            group["lr"] = lr
        seen: dict[str, list[torch.Tensor]] = {}
        for sequences in self.cut(data):
            for minibatch in minibatches(sequences, self.steps.minibatches, self.generator):
                for key, value in self.step(minibatch).items():
                    seen.setdefault(key, []).append(value.detach())
        check_finite(dict(self.agent.named_parameters()), "weight")
        means = {key: torch.stack(values).mean() for key, values in seen.items()}
        row = {_NAMES.get(key, key): mean.item() for key, mean in means.items()}
        return {**row, "lr": lr}

    def cut(self, data: TensorDictBase) -> Iterator[TensorDictBase]:
        """Yield the sequences of each epoch; advantages are recomputed in place."""
        sequences = to_sequences(data, self.loss, self.sequence_length)
        for epoch in range(self.steps.epochs):
            if epoch and self.steps.recompute_advantages:
                add_advantages(data, self.agent, self.gae, recompute=True)
                for key in _ESTIMATES:
                    sequences.get(key).copy_(data.get(key).reshape(*sequences.shape, 1))
            yield sequences

    def step(self, minibatch: TensorDictBase) -> dict[str, torch.Tensor]:
        """Take one gradient step; return what the loss reports, and ``grad_norm``."""
        try:
            terms = dict(self.terms(minibatch).items())
        except RuntimeError as error:  # torch has no public name for what a compiler raises
            if not self.steps.compile or isinstance(error, LinAlgError):
                raise
            reason = str(error).partition("\n")[0]
            raise UserError(
                f"`optim.compile=true`: the compiled loss failed: {reason}. optim.compile=false "
                "runs it as it is."
            ) from error
        losses = {key: value for key, value in terms.items() if key.startswith("loss")}
        check_finite(losses, "loss")
        self.steps.optimizer.zero_grad()
        torch.autograd.backward(torch.stack(list(losses.values())).sum())
        norm = torch.nn.utils.clip_grad_norm_(self.steps.parameters, self.steps.max_grad_norm)
        check_finite({"grad_norm": norm}, "gradient")
        self.steps.optimizer.step()
        return {**terms, "grad_norm": norm}

    def state_dict(self) -> dict[str, Any]:
        """Return the optimiser's state and the generator's: entries of the checkpoint, by name."""
        return {
            "optimizer": self.steps.optimizer.state_dict(),
            "minibatch_generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take up a saved state."""
        self.steps.optimizer.load_state_dict(state["optimizer"])
        self.generator.set_state(state["minibatch_generator"])


def check_finite(tensors: Mapping[str, torch.Tensor], kind: str) -> None:
    """Raise for the first of the tensors that holds a number that is not finite."""
    if torch.stack([value.detach().sum() for value in tensors.values()]).sum().isfinite():
        return
    for name, value in tensors.items():
        wrong = value.detach()[~value.detach().isfinite()]
        if wrong.numel():
            raise DivergedError(f"the {kind} `{name}` is {wrong[0].item()}.")


def rollout_metrics(data: TensorDictBase) -> dict[str, float | None]:
    """Return what a rollout with advantages says of the sensors, the belief and the value."""
    observed, target = data.get("observed"), data.get("value_target")
    likelihood = data.get(("belief", "log_likelihood"), None)
    spread = target.var()
    left = (target - data.get("state_value")).var() / spread if spread > 0 else spread + 1
    return {
        "missing_ratio": 1.0 - observed.to(torch.float64).mean().item(),
        "log_likelihood": None
        if likelihood is None
        else (likelihood.sum() / observed.sum().clamp_min(1)).item(),
        "explained_variance": (1 - left).item(),
        "action_std": data.get("scale").mean().item(),
    }


def finished_episodes(data: TensorDictBase, frames: int) -> list[dict[str, Any]]:
    """Return the episodes that ended in a rollout, in the order of time; ``return`` is raw."""
    # Time first, so that the order does not depend on the environment's place in the batch.
    done, returns, lengths = (
        data.get(("next", key)).squeeze(-1).transpose(0, 1)
        for key in ("done", "episode_reward", "step_count")
    )
    pairs = zip(returns[done].tolist(), lengths[done].tolist(), strict=True)
    return [{"frames": frames, "return": value, "length": length} for value, length in pairs]
