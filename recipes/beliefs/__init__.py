"""Belief modules: each file builds one, each conf/belief entry names one of these builders.

A builder takes the sizes of the task and its own settings, and returns a :class:`Belief`. A new
belief module is a new file here or elsewhere and a new entry of conf/belief: docs/extending.md.

A belief that has something to say about the sensors offers it by `Belief.observing`: a module with
the same weights that writes, beside everything else, whichever of these it has. All of it is in
normalised units.

- `ESTIMATE`: every sensor without its noise, after this step's observation, shape ``(*, obs)``
- `ESTIMATE_VARIANCE`: how far off it may be, ``(*, obs)``
- `FORECAST`: every sensor's reading before this step's observation, ``(*, obs)``
- `FORECAST_COV`: its covariance, sensor noise included, ``(*, obs, obs)``
- `NOISE_VARIANCE`: of the sensor noise that the belief assumes, ``(*, obs)``
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey

OBSERVATION = "normalized_observation"
ESTIMATE: NestedKey = ("belief", "observation")
ESTIMATE_VARIANCE: NestedKey = ("belief", "observation_variance")
FORECAST: NestedKey = ("belief", "predicted_observation")
FORECAST_COV: NestedKey = ("belief", "innovation_cov")
NOISE_VARIANCE: NestedKey = ("belief", "noise_variance")


@dataclass(frozen=True)
class Belief:
    """What the rest of a recipe has to know about a belief module.

    Attributes:
        module: reads normalised observations, writes ``features`` and, where it has a model,
            ``("belief", "log_likelihood")``; recurrent ones work one step at a time by default and
            over time under ``set_recurrent_mode(True)``.
        feature_dim: components of ``features``.
        summary: numbers worth a column in metrics.csv, asked for once a rollout.
        observing: see the top of this file; None where the belief knows nothing of the sensors.
        after_rollout: called with a rollout once its epochs are over, and with the first one, from
            which statistics are taken: for what is learned otherwise than by gradients.
        pretrained: file of weights that a new run starts from, or None.
    """

    module: TensorDictModuleBase
    feature_dim: int
    summary: Callable[[], Mapping[str, float]] = dict
    observing: Callable[[], TensorDictModuleBase] | None = None
    after_rollout: Callable[[TensorDictBase], None] = lambda _: None
    pretrained: str | None = None
