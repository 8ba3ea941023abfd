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
from torchrl_drbpn.functional.particles import (
    DiagonalGaussian,
    Outcome,
    ParticleModel,
    ParticleNoise,
    ParticleOutput,
    Prospect,
    diagonal_log_density,
    effective_sample_size,
    log_mean_weight,
    particle_sequence,
    particle_step,
    resample,
    systematic_ancestors,
)
from torchrl_drbpn.functional.recurrence import MeanNetwork
from torchrl_drbpn.functional.selection import SensorSelection, select_sensors

__all__ = [
    "Belief",
    "DiagonalGaussian",
    "FilterOutput",
    "MeanNetwork",
    "MissingnessMechanism",
    "Outcome",
    "ParticleModel",
    "ParticleNoise",
    "ParticleOutput",
    "Prospect",
    "SensorSelection",
    "StateSpace",
    "choose_form",
    "count_always_observed",
    "diagonal_log_density",
    "draw_mechanism",
    "effective_sample_size",
    "filter_sequence",
    "filter_step",
    "filtered_cov",
    "full_cov",
    "innovation",
    "inverse_softplus",
    "log_likelihood",
    "log_mean_weight",
    "masked_cov",
    "masked_log_density",
    "missing_probability",
    "particle_sequence",
    "particle_step",
    "positive_std",
    "predict",
    "predict_step",
    "resample",
    "sample_noise",
    "sample_observed",
    "select_sensors",
    "systematic_ancestors",
    "tril_to_vector",
    "update",
    "zero_missing",
]
