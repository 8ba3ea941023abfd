"""Pure tensor maths of the belief filter and of the corruption; torch alone."""

from torchrl_drbpn.functional.corruption import (
    MissingnessMechanism,
    count_always_observed,
    draw_mechanism,
    missing_probability,
    sample_noise,
    sample_observed,
)
from torchrl_drbpn.functional.filtering import (
    FilterOutput,
    filter_sequence,
    filter_step,
    filtered_cov,
)
from torchrl_drbpn.functional.gaussian import (
    Belief,
    full_cov,
    inverse_softplus,
    masked_cov,
    masked_log_density,
    positive_std,
    tril_to_vector,
    zero_missing,
)
from torchrl_drbpn.functional.kalman import innovation, log_likelihood, predict, update
from torchrl_drbpn.functional.model import StateSpace, choose_form, predict_step
from torchrl_drbpn.functional.recurrence import MeanNetwork

__all__ = [
    "Belief",
    "FilterOutput",
    "MeanNetwork",
    "MissingnessMechanism",
    "StateSpace",
    "choose_form",
    "count_always_observed",
    "draw_mechanism",
    "filter_sequence",
    "filter_step",
    "filtered_cov",
    "full_cov",
    "innovation",
    "inverse_softplus",
    "log_likelihood",
    "masked_cov",
    "masked_log_density",
    "missing_probability",
    "positive_std",
    "predict",
    "predict_step",
    "sample_noise",
    "sample_observed",
    "tril_to_vector",
    "update",
    "zero_missing",
]
