"""Names of sensors and what fails together by them."""

import gymnasium
import pytest
from omegaconf import OmegaConf
from recipe_tools import CONF, refused
from training.config import choice
from training.sensors import named_sensors, sensor_groups, sensor_names

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
    tasks = {choice("env", name).id for name in names}
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
        sensor_groups(["component 0", "component 1"], "joint")
    with refused("`group_by` must be sensor, joint or kind"):
        sensor_groups(["pole angle"], "leg")
