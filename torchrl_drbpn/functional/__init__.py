"""Pure tensor maths of the belief filter and of the corruption; torch alone."""

from torchrl_drbpn.functional.calibration import nees, nis
from torchrl_drbpn.functional.filtering import (
    FilterOutput,
    filter_sequence,
    filter_step,
)
from torchrl_drbpn.functional.gaussian import (
    Belief,
    full_cov,
    masked_cov,
    masked_log_density,
    zero_missing,
)
from torchrl_drbpn.functional.kalman import (
    MaskModel,
    innovation,
    log_likelihood,
    predict,
    sequential_update,
    update,
    update_by_mask,
)
from torchrl_drbpn.functional.missingness import (
    MissingnessMechanism,
    draw_mechanism,
    missing_probability,
    outage_rates,
    sample_delay,
    sample_mask,
    sample_noise,
    sample_spikes,
    sample_working,
)
from torchrl_drbpn.functional.native import native_status
from torchrl_drbpn.functional.particles import (
    DiagonalGaussian,
    ParticleModel,
    ParticleNoise,
    ParticleOutput,
    ParticleStep,
    ProposalOutput,
    particle_sequence,
    particle_step,
)
from torchrl_drbpn.functional.robust import innovation_weights, robust_sequence_weights
from torchrl_drbpn.functional.sensor_selection import SensorSelection, select_sensors
from torchrl_drbpn.functional.smoothing import Forecast, forecast, smooth_sequence
from torchrl_drbpn.functional.state_space import StateSpace, TransitionMLP, predict_step, propagate

__all__ = [
    "Belief",
    "DiagonalGaussian",
    "FilterOutput",
    "Forecast",
    "MaskModel",
    "MissingnessMechanism",
    "ParticleModel",
    "ParticleNoise",
    "ParticleOutput",
    "ParticleStep",
    "ProposalOutput",
    "SensorSelection",
    "StateSpace",
    "TransitionMLP",
    "draw_mechanism",
    "filter_sequence",
    "filter_step",
    "forecast",
    "full_cov",
    "innovation",
    "innovation_weights",
    "log_likelihood",
    "masked_cov",
    "masked_log_density",
    "missing_probability",
    "native_status",
    "nees",
    "nis",
    "outage_rates",
    "particle_sequence",
    "particle_step",
    "predict",
    "predict_step",
    "propagate",
    "robust_sequence_weights",
    "sample_delay",
    "sample_mask",
    "sample_noise",
    "sample_spikes",
    "sample_working",
    "select_sensors",
    "sequential_update",
    "smooth_sequence",
    "update",
    "update_by_mask",
    "zero_missing",
]
