"""The configuration and the commands: all is built and explained, what is wrong is one line."""

import importlib
import sys

import pytest
from evaluation.points import missingness_name
from evaluation_tools import ROOT, configured
from omegaconf import OmegaConf
from recipe_tools import CONF, assembled, command, make_config, refused
from training.config import choice
from training.config import command as run_command
from training.errors import UserError
from training.run_folder import load_config, read_config, resumed_config, write_config

CHOICES = sorted(
    (path.parent.name, path.stem)
    for path in CONF.glob("*/*.yaml")
    if path.parent.name != "study" and path.stem != "gym"
)


@pytest.mark.parametrize(("group", "name"), CHOICES, ids=lambda value: value)
def test_every_choice_of_every_group_composes_and_passes_the_checks(group, name):
    own = ["env.id=x", "env.make._target_=x"] if name == "torchrl" else []
    config = make_config(f"{group}={name}", *own)
    assert config.optim.lr > 0


@pytest.mark.parametrize(
    "words",
    [("belief=fill", "missingness=nmar"), ("missingness=outages", "missingness.group_by=kind"),
     ("missingness=delay", "noise=stuck", "noise.group_by=joint"), ("experiment=sensor_faults",),
     ("missingness=multi_rate", "missingness.group_by=kind", "noise=drift"),
     ("noise=spikes", "heads.critic_input=complete"), ("env=gym", "env.id=Pendulum-v1"),
     ("env=hopper", "+env.kwargs.terminate_when_unhealthy=false")],
    ids=" ".join,
)  # fmt: skip
def test_what_is_composed_is_built(words):
    training, config = assembled(*words, "collector.num_envs=8")
    assert training.env.batch_size == (8,)
    data = training.collector.rollout()
    assert data.shape == (8, config.collector.steps_per_env)
    assert data["normalized_observation"].isfinite().all()


def test_a_task_says_what_it_needs_and_the_command_line_wins():
    words = (["env=hopper"], ["env=ant"], ["env=halfcheetah"], ["env=ant", "heads.log_std=-1"])
    assert [make_config(*w).heads.log_std for w in words] == [0.0, -0.5, -0.5, -1]
    swimmer = make_config("env=swimmer", "method=gru")
    assert (swimmer.advantage.gamma, swimmer.collector.steps_per_env) == (0.9999, 128)
    assert make_config("env=swimmer", "collector=batched").collector.num_envs == 64
    assert make_config("evaluation.modes=sampled").evaluation.modes == ["sampled"]


def test_a_bare_number_is_a_network_of_one_layer():
    words = ("heads.hidden=48", "belief.transition.hidden_sizes=24", "collector.num_envs=8")
    training, _ = assembled(*words)
    shapes = {tuple(parameter.shape) for parameter in training.agent.parameters()}
    assert {(48,), (24,)} < shapes
    assert {(48, 48), (24, 24)}.isdisjoint(shapes)


@pytest.mark.parametrize("path", sorted(CONF.rglob("*.yaml")), ids=lambda path: path.stem)
def test_every_default_is_explained_on_its_line_or_above(path):
    structure = ("defaults:", "hydra:", "_target_:", "_partial_:", "name:", "- ", "in_keys:")
    if (
        path.parent.name in ("study", "experiment") or path.stem == "sensors"
    ):  # it says what it is for at its head
        assert any("# " in line for line in path.read_text().splitlines()[:2])
        return
    for line in path.read_text().split("\nhydra:")[0].splitlines():
        text = line.strip()
        if ":" in text and not text.startswith(("#", *structure)) and "_target_" not in text:
            explained = "#" in text or text.endswith(":") or "${" in text
            assert explained or text.startswith(("id: ", "logger_type: ", "experiment_name: ")), (
                f"{path.name}: {text}"
            )


def test_cfg_job_prints_everything_that_is_built(tmp_path):
    done = command("recipes/ppo_drbpn.py", "--cfg", "job", "--resolve", "env=hopper", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    printed = OmegaConf.create(done.stdout)
    assert printed == OmegaConf.create(
        OmegaConf.to_container(make_config("env=hopper"), resolve=True)
    )
    for target in ("transforms.missingness", "belief", "heads", "loss", "optim", "collector"):
        assert "_target_" in OmegaConf.select(printed, target)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        # what can not be composed
        ("loss.modelcoeff=1", "`loss.modelcoeff` is no setting: did you mean `loss.model_coeff`?"),
        ("missingnes=mar", "`missingnes` is no setting: did you mean `missingness`?"),
        ("belief=drpbn", "`belief=drpbn` is no choice: did you mean `drbpn`?"),
        ("missingness.eta=much", "`missingness.eta` must be a finite number, got 'much'"),
        ("missingness=mcar missingness.eta=nan", "`missingness.eta` must be a finite number"),
        ("optim.lr=inf", "`optim.lr` must be a finite number, got inf"),
        ("optim.lr=-1", "`optim.lr` must be at least 0, got -1"),
        ("total_frames=1.5", "`total_frames` must be a whole number, got 1.5"),
        ("total_frames=nan", "`total_frames` must be a whole number, got nan"),
        ("loss.normalize_advantage=3", "`loss.normalize_advantage` must be true or false, got 3"),
        ("optim.fused=1", "`optim.fused` is no setting: did you mean `optim.optimizer.fused`?"),
        ("seed=-1", "`seed` must be in [0, "),
        ("seed=9223372036854775808", "`seed` must be in [0, "),
        ("threads=100000", "`threads` must be in [1, 256], got 100000"),
        ("noise.sigma=-1", "`noise.sigma` must be at least 0, got -1"),
        ("heads.hidden=null", "`heads.hidden` must be a list such as [64, 64], got None"),
        ("optim.sequence_length=48", "`optim.sequence_length` must divide"),
        ("optim.minibatches=7", "`optim.minibatches` must divide the 8 sequences"),
        ("evaluation.modes=[]", "`evaluation.modes` must be sampled or mean, got []"),
        ("evaluation.modes=best", "`evaluation.modes` must be sampled or mean, got 'best'"),
        ("evaluation.modes=[best]", "`evaluation.modes` must be sampled or mean, got 'best'"),
        ("missingness.always_observed=1.0", "`missingness.always_observed` must be under 1"),
        ("env=gym", "`env.id` must be given"),
        ("env.name=CartPole-v1", "`env.name` is no setting: did you mean"),
        # what can not be built
        ("missingness.eta=1.5", "`missingness`: `eta` must be"),
        ("missingness=delay missingness.delay=-1", "`missingness`: `delay` must be a whole"),
        ("missingness=delay missingness.delay=1000", "`missingness.delay` must be shorter"),
        ("missingness=multi_rate missingness.period=0", "`missingness`: `period` must be"),
        ("missingness=from_mask", "`transforms`: mask is to be read, and the environment"),
        ("noise=stuck noise.stuck_probability=2", "`noise`: `probability` must be"),
        ("noise=drift noise.drift_std=-1", "`noise`: `walk_std` must be"),
        ("belief.state_dim=0", "`belief`: `state_dim` must be an int of at least 1, got 0"),
        ("belief.policy_input=guess", "`belief`: `policy_input` must be 'mean' or 'mean_cov'"),
        ("belief=gru belief.cell=rnn", "`belief`: `cell` must be 'gru' or 'lstm', got 'rnn'"),
        ("belief._target_=nowhere.build", "`belief`: Error loading 'nowhere.build'"),
        ("+belief.colour=red", "`belief`: build() got an unexpected keyword argument 'colour'"),
        ("heads.critic_input=all", "`heads`: `critic_input` must be features or complete"),
        ("collector=ray collector.workers=3", "`collector.workers` must divide `collector.num_"),
        ("env.backend=paper", "`env.backend` must be gymnasium or envpool, got 'paper'"),
        ("transforms.own=3", "`transforms.own` must name what is built by `_target_`"),
        ("env.id=Wlaker2d", "`env.id=Wlaker2d-v5`: "),
        ("env=gym env.id=CartPole-v1", "`env.id=CartPole-v1`: "),
        ("env=gym env.id=FrozenLake-v1", "`env.id=FrozenLake-v1`: "),
        ("env=gym env.id=Pendulum-v1 missingness=outages missingness.group_by=joint",
         "`group_by=joint` goes by the names of the sensors"),
        *[(f"algo=acktr belief={belief}", "`algo=acktr` must have a belief module without weights")
          for belief in ("drbpn", "gru", "transformer")],
        ("algo=acktr belief=none algo._target_=nowhere.build", "`algo`: Error loading 'nowhere.bu"),
        ("algo=acktr belief=none +algo.colour=red", "`algo`: ACKTR.__init__() got an"),
        ("algo=acktr belief=none algo.desired_kl=0", "`algo`: `desired_kl` must be positive"),
        ("algo=acktr belief=none algo.policy.damping=0", "`algo`: `damping` must be positive, got"),
        ("algo=acktr belief=none algo.critic.momentum=1", "`algo`: `momentum` must lie in [0, 1)"),
    ],
)  # fmt: skip
def test_what_can_not_be_composed_or_built_is_one_line(words, line):
    with pytest.raises(UserError) as error:
        # Few simulators: MuJoCo sets 15 MB of address space aside for each, and a process whose
        # heap is larger than the machine's memory can't be forked.
        assembled("collector.num_envs=4", *words.split())
    assert str(error.value).startswith(line)
    assert "\n" not in str(error.value)


def test_missingness_has_one_name_that_reads_back():
    kinds = ("none", "mcar", "mar", "nmar", "outages", "delay", "multi_rate")
    names = [missingness_name(make_config(f"missingness={n}").missingness) for n in kinds]
    assert names == ["none:0", "mcar:0.5", "mar:0.5", "nmar:0.5", "outages:0.5:20:sensor",
                     "delay:2", "multi_rate:4:sensor"]  # fmt: skip
    assert missingness_name(choice("missingness", "mcar", eta=0.2)) == "mcar:0.2"
    words = ["missingness=from_nan"], ["missingness=from_mask", "missingness.eta=0.2"]
    names = [missingness_name(make_config(*w).missingness) for w in words]
    assert names == ["from_nan none:0", "from_mask mcar:0.2"]  # a sensor's own gaps are no none:0
    with refused("`missingness=mcar` has no `mean_length`"):
        choice("missingness", "mcar", mean_length=3)


def test_a_configuration_is_written_as_it_was_composed(tmp_path):
    config = make_config("env=hopper", "seed=7")
    write_config(tmp_path, config)
    assert load_config(tmp_path) == config
    assert load_config(tmp_path).transforms.noise == config.noise
    loaded = load_config(tmp_path)
    loaded.noise.sigma = 3.0  # what is read back follows its references
    assert loaded.transforms.noise.sigma == 3.0


def test_resume_takes_the_settings_of_its_folder_and_only_the_allowed_overrides(tmp_path):
    write_config(tmp_path, make_config("env=hopper", "seed=7"))
    words = ["resume=x", "total_frames=4096", "evaluation.episodes=3", "logger=tensorboard"]
    config = resumed_config(make_config(*words), words, tmp_path)
    assert (config.env.id, config.seed) == ("Hopper", 7)
    assert (config.total_frames, config.evaluation.episodes) == (4096, 3)
    assert config.logger.logger_type == "tensorboard"
    assert config.resume == str(tmp_path)
    assert read_config(tmp_path)["total_frames"] == 1_000_000


@pytest.mark.parametrize(
    ("word", "line"),
    [
        ("seed=1", "only total_frames, device, optim.compile, logger, evaluation .*seed=1"),
        ("env=hopper", "only total_frames, device, optim.compile, logger, .*env=hopper"),
        ("optim.lr=1", "only total_frames, device, optim.compile, logger, .*optim.lr=1"),
        ("hydra.run.dir=there", "`resume` names the run folder already; .*hydra.run.dir=there"),
    ],
)
def test_resume_refuses_other_overrides(tmp_path, word, line):
    write_config(tmp_path, make_config())
    with refused(line):
        resumed_config(make_config(), ["resume=x", word], tmp_path)


NO_RUN = "`run` must name "
COMMANDS = ("evaluate", "diagnose", "export", "play", "plot_sensors", "report", "save_agent")


@pytest.mark.parametrize(
    ("name", "changes", "line"),
    [
        ("evaluate", {"run": None}, NO_RUN),
        ("evaluate", {"episodes": 0}, "`episodes` must be at least 1, got 0"),
        ("evaluate", {"processes": 1.5}, "`processes` must be at least 1, got 1.5"),
        ("evaluate", {"modes": ["best"]}, "`modes` must be sampled or mean"),
        ("evaluate", {"modes": "best"}, "`modes` must be sampled or mean, got 'best'"),
        ("evaluate", {"modes": []}, r"`modes` must be sampled or mean, got \[\]"),
        ("evaluate", {"output": "no/such/folder/x.csv"}, "`output` must lie in an existing folder"),
        ("evaluate", {"points": []}, "`points` must hold at least one"),
        ("evaluate", {"robust": "gate"}, "`robust` must be one of huber, imq, or None"),
        ("evaluate", {"robust": "imq", "robust_threshold": 0},
         "`robust_threshold` must be a positive, finite"),
        ("diagnose", {"run": None}, NO_RUN),
        ("diagnose", {"redraw": "nowhere"}, "nowhere has no tables"),
        ("diagnose", {"points": []}, "`points` must hold at least one"),
        ("diagnose", {"mode": "best"}, "`mode` must be sampled or mean"),
        ("diagnose", {"episodes": 0}, "`episodes` must be at least 1, got 0"),
        ("diagnose", {"bins": [1, 3, 3]}, "`bins` must be whole numbers that start at 1 and asc"),
        ("diagnose", {"resamples": 1}, "`resamples` must be at least 2"),
        ("diagnose", {"out": __file__}, "`out` must be a folder, .* is a file"),
        ("export", {"run": None}, "`run` must name a run folder"),
        ("export", {"run": str(ROOT)}, f"`{ROOT}` must be a run folder with config.yaml"),
        ("export", {"out": "p.bin"}, "`out` must end in .pt2 for format=aoti, got p.bin"),
        ("export", {"out": "p.pt2", "format": "onnx"}, "`out` must end in .onnx for format=onnx"),
        ("export", {"out": "nowhere/p.pt2"}, "`out` must lie in an existing folder"),
        ("export", {"format": "tflite"}, "`format` must be aoti, export or onnx, got 'tflite'"),
        ("export", {"robots": 0}, "`robots` must be at least 1, got 0"),
        ("play", {"run": None}, NO_RUN),
        ("play", {"point": "mcar:2"}, "`points` must hold"),
        ("play", {"mode": "best"}, "`mode` must be sampled or mean"),
        ("play", {"steps": 0}, "`steps` must be at least 1, got 0"),
        ("play", {"every": 1.5}, "`every` must be at least 1, got 1.5"),
        ("play", {"start": -1}, "`start` must be at least 0, got -1"),
        ("play", {"start": 100_000}, "`start` must lie inside the episode"),
        ("play", {"fps": 60}, r"`fps` must be in \[1, 50\], got 60"),
        ("play", {"sensors": ["pole"]}, "`sensors` must be among 0 cart position, .*got 'pole'"),
        ("play", {"sensors": [4]}, "`sensors` must be among .*got 4"),
        ("play", {"sensors": 0}, "`sensors` must be 1 or more"),
        ("play", {"out": "nowhere/video.gif"}, "`out` must lie in an existing folder"),
        ("play", {"out": "video.avi"}, r"`out` must end in .gif, .mp4 or .png, got video.avi"),
        ("plot_sensors", {"run": None}, NO_RUN),
        ("plot_sensors", {"run": "nowhere/*"}, "run folders, none is at nowhere/\\*"),
        ("plot_sensors", {"run": "nowhere"}, "run folders, none is at nowhere"),
        ("plot_sensors", {"orders": 5}, "`orders` must be at least 20"),
        ("plot_sensors", {"dpi": 0}, "`dpi` must be at least 1"),
        ("report", {"run": "nowhere"}, "`run` must name run folders, none is at nowhere"),
        ("report", {"run": None}, NO_RUN),
        ("report", {"out": None}, "`out` must be the folder of a study"),
        ("report", {"from": "nowhere"}, "`from` reads and writes the tables of a study: leave out"),
        ("report", {"from": "nowhere", "run": None, "out": None}, "`from` must name folders with"),
        ("report", {"rows": 1}, "`rows` must be at least 2, got 1"),
        ("save_agent", {"run": None}, "`run` must name a folder"),
        ("save_agent", {"out": None}, "`out` must name a folder"),
        ("save_agent", {}, "has no final evaluation yet"),
    ],
)  # fmt: skip
def test_bad_input_is_answered_with_one_line_before_anything_is_done(
    drbpn, tmp_path, name, changes, line
):
    config = configured(name) | {"run": str(drbpn), "start": 0} | changes
    if "out" not in changes:
        written = {"play": "video.gif", "export": "policy.pt2"}.get(name, "out")
        config["out"] = str(tmp_path / written)
    if name == "evaluate" and "output" not in changes:
        config |= {"output": str(tmp_path / "out.csv"), "processes": changes.get("processes", 1)}
    with refused(line):
        importlib.import_module(name).run(config)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["diagnose", "plot_sensors"])
def test_several_runs_need_a_folder(drbpn, feedforward, name):
    with refused("`out` must name a folder for 2 runs"):
        importlib.import_module(name).run(
            configured(name) | {"run": [str(drbpn), str(feedforward)]}
        )


@pytest.mark.parametrize("name", COMMANDS)
def test_the_line_goes_to_standard_error_with_status_2(name, tmp_path, monkeypatch, capsys):
    for words in (["run=nowhere", f"out={tmp_path}"], ["runs=x"]):
        if name == "evaluate":
            words = words[:1]
        monkeypatch.setenv("HYDRA_FULL_ERROR", "0")  # the command sets it: undone after the test
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *words])
        with pytest.raises(SystemExit) as left:
            run_command(name, importlib.import_module(name).run)
        (line,) = capsys.readouterr().err.splitlines()
        assert left.value.code == 2
        assert line.startswith(("error: `run", "error: `nowhere"))


@pytest.mark.parametrize(
    ("word", "line"),
    [
        ("seed=-1", "`seed` must be in [0, "),
        ("reduction_seed=-1", "`reduction_seed` must be at least 0, got -1"),
        ("threads=0", "`threads` must be in [1, 256], got 0"),
    ],
)
def test_what_several_commands_have_is_checked_before_any_of_them_runs(
    word, line, monkeypatch, capsys
):
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    monkeypatch.setattr(sys, "argv", ["diagnose.py", word])
    with pytest.raises(SystemExit):
        run_command("diagnose", pytest.fail)
    assert capsys.readouterr().err.startswith(f"error: {line}")
