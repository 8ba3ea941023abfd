"""What trained beliefs say about their sensors, the names of these, and what fails together."""

import shutil
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pandas as pd
import plot_sensors
import pytest
import torch
from analysis.sensor_figures import mean_places, random_orders
from evaluation.sensor_choice import kept_sensors, learned_sensors
from evaluation.trained import load_trained_agent
from matplotlib.image import imread
from omegaconf import OmegaConf
from recipe_tools import CONF, make_config, refused
from tensordict import TensorDict
from training.sensors import named_sensors, sensor_groups, sensor_names

from torchrl_drbpn import BeliefFilterModule, GaussianTransition, LinearGaussianEmission, functional

OBS, ACTION = 11, 3
HOPPER = ("env=hopper", "env.version=v4")

pytestmark = pytest.mark.filterwarnings("ignore:.*out of date.*")


@pytest.fixture(scope="module")
def runs(trained_run, tmp_path_factory):
    """Three training seeds on Hopper, with names of their folders, and one without a model."""
    root = tmp_path_factory.mktemp("sensors")
    kinds = [("drbpn", *HOPPER, f"seed={seed}") for seed in range(3)] + [("none", *HOPPER)]
    return [
        Path(shutil.copytree(trained_run(*kind), root / f"{i}-{kind[0]}"))
        for i, kind in enumerate(kinds)
    ]


@pytest.fixture(scope="module")
def agents(runs):
    return [load_trained_agent(folder) for folder in runs[:3]]


@pytest.fixture(scope="module")
def models(agents):
    return [learned_sensors(trained) for trained in agents]


def filtered(model, rows):
    """The covariance that the library's update leaves with these sensors."""
    observed = torch.zeros(OBS, dtype=torch.bool)
    observed[rows] = True
    P = model.predicted_cov
    belief = functional.Belief(torch.zeros(len(P), dtype=P.dtype), P)
    nothing = torch.zeros(OBS, dtype=P.dtype)
    return functional.update(
        belief, nothing, observed, model.emission_matrix, model.emission_cov
    ).cov


def test_the_observation_covariance_is_that_of_a_step_inside_an_episode(agents, models):
    module = BeliefFilterModule(
        agents[0].agent.belief.filter, out_keys=[("belief", "innovation_cov")]
    )
    seen = torch.rand(1, OBS, generator=torch.Generator().manual_seed(0)) < 0.5
    data = {"observation": torch.zeros(1, OBS), "observed": seen}
    data |= {"previous_action": torch.ones(1, ACTION), "is_init": torch.zeros(1, 1).bool()}
    data["recurrent"] = {"mean": torch.ones(1, OBS), "age": torch.ones(1, 1).long()}
    with torch.no_grad():
        said = module(TensorDict(data, [1]))["belief", "innovation_cov"][0]
    torch.testing.assert_close(said.double(), models[0].observation_cov, rtol=1e-4, atol=1e-7)


def test_spikes_count_as_noise_that_was_added(agents):
    """A spike of deviation tau that hits with probability p adds p tau^2 to the variance."""
    quiet, settings = learned_sensors(agents[0]).added_std, agents[0].settings
    spikes = {"spike_probability": 0.25, "spike_std": 0.02 * 3**0.5}
    noisy = settings.copy()
    noisy.noise = {**settings.noise, **spikes}
    spiky = learned_sensors(replace(agents[0], settings=noisy)).added_std
    torch.testing.assert_close(spiky, 2 * quiet)


def test_the_kept_sensors_are_the_first_of_the_ranking(agents, models):
    ranking = models[0].ranking("D").tolist()
    assert sorted(ranking) == list(range(OBS))
    for count in (0, 1, OBS):
        assert kept_sensors(agents[0], count) == ranking[:count]


def test_a_covariance_that_depends_on_the_state_ranks_no_sensors(runs):
    trained = load_trained_agent(runs[0])
    trained.agent.belief.filter.transition = GaussianTransition(OBS, ACTION, cov_network=True)
    with refused("`belief=drbpn` predicts another covariance at every"):
        learned_sensors(trained)


@pytest.mark.parametrize("full", [False, True], ids=["diagonal R", "full R"])
def test_along_an_order_is_what_update_leaves(models, full):
    model = models[1]
    if full:
        noise = LinearGaussianEmission(OBS, OBS, ACTION, cov="full", dtype=torch.float64)
        with torch.no_grad():
            noise.noise.raw += 0.05 * torch.randn(
                OBS, OBS, generator=torch.Generator().manual_seed(1), dtype=torch.float64
            )
        model = replace(model, emission_cov=noise.cov().detach())
    H, P = model.emission_matrix, model.predicted_cov
    orders = random_orders(3, OBS, 5)
    information, left = model.along(orders)
    for line, order in enumerate(orders.tolist()):
        for k in range(OBS):
            cov = filtered(model, order[: k + 1])
            gained = 0.5 * (torch.logdet(P) - torch.logdet(cov))
            share = (H @ cov @ H.mT).trace() / (H @ P @ H.mT).trace()
            assert information[line, k] == pytest.approx(float(gained), abs=1e-9)
            assert left[line, k] == pytest.approx(float(share), abs=1e-9)


def test_mean_places_count_from_one(models):
    places = mean_places(models[:1], "D")
    assert sorted(places) == list(range(1, OBS + 1))
    assert places[models[0].ranking("D")[0]] == 1
    both = (places + mean_places(models[1:2], "D")) / 2
    np.testing.assert_array_equal(mean_places(models[:2], "D"), both)


FILES = ["observation_covariance.png", "sensor_ranking.csv", "sensor_ranking.png"]


def draw(run, out, **changes):
    base = {"run": run, "out": out and str(out), "correlation": True, "orders": 20, "seed": 0}
    return plot_sensors.run(base | {"dpi": 50} | changes)


def test_runs_are_drawn_together_with_a_row_a_seed_criterion_and_place(runs, tmp_path):
    out = tmp_path / "new" / "sensors"
    assert draw([str(runs[1]), str(runs[0])], out) == 0
    assert sorted(path.name for path in out.iterdir()) == FILES
    for name in (FILES[0], FILES[2]):
        pixels = imread(out / name)[..., :3]
        assert 0.01 < (pixels.min(-1) < 0.9).mean() < 0.9
    rows = pd.read_csv(out / "sensor_ranking.csv")
    groups = rows.groupby(["training_seed", "criterion"])
    assert sorted(groups.groups) == [(0, "A"), (0, "D"), (1, "A"), (1, "D")]
    for _, part in groups:
        assert part.place.tolist() == list(range(1, OBS + 1))
        assert part.sensor.nunique() == OBS
        assert part.information.is_monotonic_increasing
        assert part.variance_left.is_monotonic_decreasing


def test_runs_without_a_model_or_a_checkpoint_are_left_out_with_a_line(
    runs, young, tmp_path, capsys
):
    assert draw([str(runs[3]), str(runs[0]), str(young)], tmp_path / "out") == 0
    said = capsys.readouterr().out
    assert "3-none: left out; `belief=none` has learned no H, P and R" in said
    assert "young: left out, it has no checkpoint yet" in said
    assert "1 run, written" in said
    twin = shutil.copytree(runs[3], tmp_path / "twin")
    with refused("`run` must name runs that have learned H, P and R"):
        draw([str(runs[3]), str(twin)], tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_methods_are_drawn_apart(agents):
    settings = OmegaConf.merge(agents[0].settings, {"method": "ppo_ours"})
    named = replace(agents[0], settings=settings)
    assert plot_sensors.title(named).startswith("Hopper-v4, ppo_ours\n")
    assert plot_sensors.title(agents[0]).startswith("Hopper-v4, drbpn\n")
    assert plot_sensors.title(agents[0]) == plot_sensors.title(agents[1])


def test_one_run_is_drawn_into_its_folder_the_same_bytes_each_time(runs, tmp_path):
    copied = shutil.copytree(runs[0], tmp_path / "run")
    written = []
    for _ in range(2):
        assert draw(str(copied), None, correlation=False) == 0
        written.append([(copied / name).read_bytes() for name in FILES])
    assert written[0] == written[1]
    wide = imread(copied / FILES[0]).shape[1]
    assert draw(str(copied), None) == 0
    assert imread(copied / FILES[0]).shape[1] > 1.5 * wide  # the correlations stand beside


TASKS = sorted(
    tuple(task.rsplit("-", 1)) for task in OmegaConf.load(CONF / "sensors.yaml") if task[0] != "_"
)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("task", "version"), TASKS, ids=lambda value: value)
def test_every_component_of_a_task_has_a_name_of_its_own(task, version):
    env = gymnasium.make(f"{task}-{version}")
    names = sensor_names(task, version, env.observation_space.shape[0])
    env.close()
    assert len(set(names)) == len(names) == env.observation_space.shape[0]


def test_all_tasks_of_the_recipe_have_names_in_both_versions():
    names = {path.stem for path in (CONF / "env").glob("*.yaml")} - {"gym", "torchrl"}
    tasks = {make_config(f"env={name}").env.id for name in names}
    assert set(TASKS) == {(task, version) for task in tasks for version in ("v4", "v5")}


def test_angles_and_velocities_are_where_the_simulator_has_them():
    names = sensor_names("Walker2d", "v5", 17)
    env = gymnasium.make("Walker2d-v5").unwrapped
    joints = [env.model.joint(i).name for i in range(env.model.njnt)]
    assert joints[3:6] == ["thigh_joint", "leg_joint", "foot_joint"]
    assert names[2:5] == ["right thigh angle", "right leg angle", "right foot angle"]
    assert names[8] == "torso x velocity"
    assert names[11:14] == ["right thigh velocity", "right leg velocity", "right foot velocity"]


def test_an_unknown_task_has_numbers_for_names_and_a_known_one_of_another_size_is_refused():
    assert sensor_names("Pusher", "v5", 2) == ["component 0", "component 1"]
    with refused(r"`Hopper-v5` has 11 named components.* has 12"):
        sensor_names("Hopper", "v5", 12)
    with refused(r"`Hopper-v4` has 11 named components.* has 12"):
        sensor_names("Hopper-v4", None, 12)


@pytest.mark.parametrize(("task", "version"), TASKS, ids=lambda value: value)
def test_groups_hold_every_component_once(task, version):
    names = named_sensors(task, version)
    for by in ("joint", "kind"):
        groups = sensor_groups(names, by)
        assert groups is not None
        assert sorted(i for group in groups for i in group) == list(range(len(names)))
        assert 1 < len(groups) < len(names), by


def test_a_joint_is_its_angle_and_its_velocity_and_a_kind_all_positions():
    names = sensor_names("Hopper", "v5", 11)
    assert sensor_groups(names, "sensor") is None
    joints = sensor_groups(names, "joint")
    assert joints == [[0, 1, 5, 6, 7], [2, 8], [3, 9], [4, 10]]
    assert sensor_groups(names, "kind") == [[0, 1, 2, 3, 4], [5, 6, 7, 8, 9, 10]]


def test_groups_need_names():
    with refused("goes by the names of the sensors"):
        sensor_groups([], "joint")
    with refused("`group_by` must be sensor, joint or kind"):
        sensor_groups(["pole angle"], "leg")
