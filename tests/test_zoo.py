"""The command line, run as a user runs it."""

import os
import re
import signal
import subprocess
import sys
from argparse import ArgumentParser
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import optuna
import pytest
import rl_zoo3.enjoy
import rl_zoo3.train
import yaml
from filelock import FileLock
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER
from stable_baselines3.common.callbacks import BaseCallback

from sb3_robust_bisim import BisimSAC, FrameStackReplayBuffer
from sb3_robust_bisim.cli.errors import UsageError, refusals
from sb3_robust_bisim.cli.manager import BisimExperimentManager, sample_bisim_sac_params
from sb3_robust_bisim.cli.options import SET_BY_THE_USER
from sb3_robust_bisim.cli.report import report
from sb3_robust_bisim.cli.settings import StoreSettings
from sb3_robust_bisim.cli.zoo import COMMANDS, main, shell
from sb3_robust_bisim.cli.zoo_config import check_keys, variant_settings

ROOT = Path(__file__).parent.parent
CONFIG = ROOT / "zoo_configs" / "bisim_sac.yml"
CARTPOLE, PENDULUM, MOUNTAIN_CAR = (
    f"robust_bisim/{name}-v0" for name in ("SparseCartPole", "SparsePendulum", "MountainCarContinuous")
)
SAC: dict[str, Any] = dict(bisim_coef=0, norm_constraint=False, intrinsic_reward_scale=0, inverse_dynamics_coef=0)
SHORT = ["-n", "120", "-params", "learning_starts:50", "batch_size:16", "initial_gradient_steps:5"]


class Zoo:
    """The command line in this process. A new process would spend longer on importing torch than on any of these runs."""

    def __init__(self, capsys: pytest.CaptureFixture) -> None:
        self.capsys = capsys

    def __call__(self, *arguments: str) -> str:
        try:
            main(arguments)
        finally:
            captured = self.capsys.readouterr()
            self.output = captured.out + captured.err
        return self.output


@pytest.fixture
def zoo(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path) -> Zoo:
    monkeypatch.chdir(tmp_path)  # the configuration is found from any folder
    return Zoo(capsys)


@pytest.mark.parametrize(
    ("variant", "expected"),
    [
        ("SAC", SAC),
        ("DBC", {**SAC, "bisim_coef": 0.5}),
        ("DBC-alt", {**SAC, "bisim_coef": 0.5, "c_r": 0.5, "c_t": 0.5}),
        ("DBC-normed", {**SAC, "bisim_coef": 0.5, "norm_constraint": True}),
        ("DBC-IR", {"norm_constraint": False, "inverse_dynamics_coef": 0}),
        ("normed-IR", {"inverse_dynamics_coef": 0}),
        ("normed-ID", {"intrinsic_reward_scale": 0}),
        ("normed-IR-ID", {}),
    ],
)
def test_every_method_of_the_paper_is_a_variant(variant: str, expected: dict) -> None:
    for env_id in (CARTPOLE, MOUNTAIN_CAR):
        assert variant_settings(CONFIG, env_id, variant) == expected
    layers = {"policy_kwargs": {"features_extractor_kwargs": {"n_layers": 3}}}
    normed = expected.get("norm_constraint", True)
    assert variant_settings(CONFIG, PENDULUM, variant) == (expected if normed else {**expected, **layers})


@pytest.mark.parametrize("env_id", [CARTPOLE, PENDULUM, MOUNTAIN_CAR])
def test_the_config_files_hold_known_keys_and_the_papers_numbers(env_id: str) -> None:
    entry = yaml.safe_load(CONFIG.read_text())[env_id]
    check_keys(entry, str(CONFIG))
    paper = {CARTPOLE: (2, 1, 50_000), PENDULUM: (0.1, 0.1, 100_000), MOUNTAIN_CAR: (20, 20, 100_000)}[env_id]
    assert (entry["intrinsic_reward_scale"], entry["inverse_dynamics_coef"], entry["n_timesteps"]) == paper
    assert (entry["batch_size"], entry["buffer_size"], entry["learning_rate"]) == (512, 50_000, 1e-3)
    # the published code clamps at 0.1 before scaling, which matters for this task
    assert entry.get("intrinsic_reward_max", 0.1) == (2.0 if env_id == MOUNTAIN_CAR else 0.1)


def test_train_evaluates_in_the_standard_task_and_reports_and_resumes_and_plays(zoo: Zoo, tmp_path: Path) -> None:
    common = ["--seed", "1", "--eval-freq", "40", "--eval-episodes", "2", "-f", str(tmp_path)]
    own = ["--variant", "normed-ID", "-tb", str(tmp_path / "tb"), *SHORT, "inverse_dynamics_coef:0.3"]
    output = zoo("train", "--env", CARTPOLE, *common, *own)
    run = tmp_path / "bisim_sac" / "robust_bisim-SparseCartPole-v0_1"
    evaluations = np.load(run / "evaluations.npz")
    assert evaluations["timesteps"].tolist() == [40, 80, 120]
    # every step pays 1 in the standard task, and almost no step does in the sparse one
    np.testing.assert_array_equal(evaluations["results"], evaluations["ep_lengths"])
    assert f"before training (step 40): {evaluations['results'][0].mean():.1f}" in output
    assert f"last (step 120): {evaluations['results'][-1].mean():.1f}" in output
    assert (run / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    folder = run / "robust_bisim-SparseCartPole-v0"
    assert yaml.unsafe_load((folder / "args.yml").read_text())["variant"] == ["normed-ID"]
    model = BisimSAC.load(run / "robust_bisim-SparseCartPole-v0.zip")
    assert (model.intrinsic_reward_scale, model.inverse_dynamics_coef, model.batch_size) == (0.0, 0.3, 16)
    assert model.observation_space.shape == (12,)  # noise_multiplier: 2 from the config
    assert list((tmp_path / "tb").rglob("events.out.tfevents*"))

    resumed = zoo("train", "--env", CARTPOLE, *common, "-i", str(run / "robust_bisim-SparseCartPole-v0.zip"), *SHORT)
    assert "Loading pretrained agent" in resumed
    assert "at first (step 40)" in resumed  # the agent had learned before
    second = tmp_path / "bisim_sac" / "robust_bisim-SparseCartPole-v0_2"
    model = BisimSAC.load(second / "robust_bisim-SparseCartPole-v0.zip")
    assert (model.intrinsic_reward_scale, model.inverse_dynamics_coef) == (0.0, 0.3)  # still normed-ID, with its -params
    arguments = yaml.unsafe_load((second / "robust_bisim-SparseCartPole-v0" / "args.yml").read_text())
    assert arguments["hyperparams"]["inverse_dynamics_coef"] == 0.3  # so a third run would keep it too
    killed = tmp_path / "bisim_sac" / "robust_bisim-SparseCartPole-v0_3"  # it has evaluated, and not ended
    killed.mkdir()
    (killed / "best_model.zip").write_bytes(b"")
    (tmp_path / "bisim_sac" / "robust_bisim-SparseCartPole-v0_4").mkdir()  # as left behind by Optuna or a failed run
    played = zoo("enjoy", "--env", CARTPOLE, "-f", str(tmp_path), "-n", "210", "--no-render")
    assert "SparseCartPole-v0_2/" in played
    assert "Episode Reward" in played


def test_variants_can_be_combined() -> None:
    pixels = "robust_bisim/cheetah-run-pixels-v0"
    settings = variant_settings(CONFIG, pixels, "self-prediction", "clean", "small")
    assert settings.items() >= {**SAC, "model_coef": 100.0, "batch_size": 128}.items()
    assert settings["env_kwargs"] == {"distractor": "none", "shadows": False, "size": 64}
    # mappings are merged: each variant has kept its part
    assert settings["policy_kwargs"] == {"features_extractor_kwargs": {"layer_norm": True, "strides": [3, 2, 1]}}
    with pytest.raises(ValueError, match=r"--variant small: no such variant.* For robust_bisim/SparseCartPole-v0"):
        variant_settings(CONFIG, CARTPOLE, "small")  # only the pixel tasks have it


def test_training_from_pixels_ends_with_a_video_and_what_the_agent_sees(zoo: Zoo, tmp_path: Path) -> None:
    pytest.importorskip("dm_control")
    import imageio.v2 as imageio

    output = zoo(
        *("train", "--env", "robust_bisim/cartpole-swingup-pixels-v0", "--variant", "small", "balanced"),
        *("-n", "40", "--eval-freq", "20"),
        *("--env-kwargs", "distractor:'video'", "action_repeat:50", "--eval-episodes", "1", "-f", str(tmp_path)),
        *("-params", "learning_starts:20", "batch_size:4", "buffer_size:60", "n_envs:2"),
    )
    run = tmp_path / "bisim_sac" / "robust_bisim-cartpole-swingup-pixels-v0_1"
    assert re.search(rf"Video: .*{run / 'agent.mp4'}.*, one episode with return \d+\.\d\n", output)
    video = imageio.get_reader(run / "agent.mp4")
    assert video.count_frames() == 20
    assert video.get_meta_data()["fps"] == 2.0  # 50 control steps of 10 ms per frame
    frame = video.get_data(10)
    assert frame.shape == (256, 256, 3)
    assert frame.std() > 20  # the frame is not uniform
    assert imageio.imread(run / "what_the_agent_sees.png").shape == (3 * 84, 8 * 84, 3)
    model = BisimSAC.load(run / "robust_bisim-cartpole-swingup-pixels-v0.zip")
    assert model.replay_buffer_class is FrameStackReplayBuffer
    assert (model.c_r, model.bisim_coef) == (0.02, 100.0)
    assert model.observation_space.shape == (9, 84, 84)


def test_training_from_pixels_succeeds_without_the_packages_for_video(
    zoo: Zoo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("dm_control")
    monkeypatch.delitem(sys.modules, "sb3_robust_bisim.cli.record", raising=False)
    monkeypatch.setitem(sys.modules, "imageio.v2", None)
    output = zoo(
        *("train", "--env", "robust_bisim/cartpole-swingup-pixels-v0", "-n", "20", "--eval-freq", "-1"),
        *("--env-kwargs", "distractor:'color'", "action_repeat:50", "-f", str(tmp_path)),
        *("-params", "learning_starts:20", "buffer_size:60", "n_envs:1"),
    )
    assert "imageio.v2 is missing: pip install sb3_robust_bisim[dmc]" in output
    assert "Model:          " in output


def test_env_kwargs_of_the_command_line_reach_training_and_evaluation(zoo: Zoo, tmp_path: Path) -> None:
    zoo(
        *("train", "--env", CARTPOLE, "--env-kwargs", "noise_multiplier:1", "--eval-freq", "60", "--eval-episodes", "1"),
        *("-f", str(tmp_path), *SHORT),
    )
    run = tmp_path / "bisim_sac" / "robust_bisim-SparseCartPole-v0_1"
    assert BisimSAC.load(run / "robust_bisim-SparseCartPole-v0.zip").observation_space.shape == (8,)
    evaluations = np.load(run / "evaluations.npz")
    np.testing.assert_array_equal(evaluations["results"], evaluations["ep_lengths"])

    agent = str(run / "robust_bisim-SparseCartPole-v0.zip")
    resumed = zoo("train", "--env", CARTPOLE, "-i", agent, "--eval-freq", "-1", "-f", str(tmp_path), *SHORT)
    assert "env_kwargs={'noise_multiplier': 1}" in resumed
    second = tmp_path / "bisim_sac" / "robust_bisim-SparseCartPole-v0_2" / "robust_bisim-SparseCartPole-v0" / "args.yml"
    assert yaml.unsafe_load(second.read_text())["env_kwargs"] == {"noise_multiplier": 1}  # where `enjoy` looks


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--variant", "normed-ir"], "--variant normed-ir: no such variant, did you mean 'normed-IR'.* has SAC, DBC"),
        (["-params", "bisim_coeff:1"], "-params: unknown key 'bisim_coeff', did you mean 'bisim_coef'"),
    ],
)
def test_bad_input_is_refused_before_a_run_folder_exists(zoo: Zoo, arguments: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        zoo("train", "--env", CARTPOLE, *arguments, "-f", str(tmp_path / "logs"))
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-params", "ent_coef:-1"], "ent_coef=-1: it must be a number >= 0"),
        (["--env-kwargs", "noise_multiplier:-2"], "noise_multiplier must be an integer >= 0 .* got -2"),
        (["--env-kwargs", "noise_multiplyer:3"], "unexpected keyword argument 'noise_multiplyer'"),
    ],
)
def test_a_value_that_algorithm_or_task_refuses_leaves_no_run(
    zoo: Zoo, arguments: list[str], message: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=message):
        zoo("train", "--env", CARTPOLE, *arguments, "-f", str(tmp_path / "logs"))
    assert not (tmp_path / "logs").exists()


class Broken(gym.Env):
    """An environment with an error in its code."""

    def __init__(self) -> None:
        np.zeros(3) + np.zeros(4)


def test_an_error_in_the_code_of_an_environment_keeps_its_traceback() -> None:
    with pytest.raises(ValueError, match="could not be broadcast") as raised, refusals():
        Broken()
    assert not isinstance(raised.value, UsageError)


def test_the_error_of_a_library_below_a_folder_with_our_name_keeps_its_traceback(tmp_path: Path) -> None:
    file = tmp_path / "sb3_robust_bisim" / "other.py"
    with pytest.raises(ValueError, match="theirs") as raised, refusals():
        exec(compile("raise ValueError('theirs')", str(file), "exec"), {"__name__": "other"})
    assert not isinstance(raised.value, UsageError)


@pytest.mark.parametrize("arguments", [["--no-render"], ["--video", "agent.gif"]])
@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("noise_multiplier:-2", "noise_multiplier must be an integer >= 0 .* got -2"),
        ("noise_multiplyer:3", "argument 'noise_multiplyer' .*Check --env-kwargs"),
    ],
)
def test_enjoy_says_in_one_line_what_the_task_refuses(zoo: Zoo, arguments: list[str], setting: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        zoo("enjoy", "--env", CARTPOLE, "--trained", *arguments, "--env-kwargs", setting)


def _settings(*values: str) -> dict[str, Any]:
    parser = ArgumentParser()
    parser.add_argument("-params", nargs="+", action=StoreSettings)
    return parser.parse_args(["-params", *values]).params


def test_a_word_needs_no_quotes_in_a_setting() -> None:
    words = _settings("distractor:video", "pairs:all", "ent_coef:auto_0.1", "learning_rate:lin_3e-4", "files:~/clips/a.mp4")
    assert words == {
        **{"distractor": "video", "pairs": "all", "ent_coef": "auto_0.1"},  # `all` is a function in Python
        **{"learning_rate": "lin_3e-4", "files": "~/clips/a.mp4"},
    }
    values = _settings("a:1e-3", "b:'video'", "c:None", "d:True", "e:dict(net_arch=[64])", "f:(0, 8)")
    assert values == {"a": 1e-3, "b": "video", "c": None, "d": True, "e": {"net_arch": [64]}, "f": (0, 8)}


@pytest.mark.parametrize("value", ["noise_multiplier", "noise_multiplier:", "noise_multiplier:[1", "noise_multiplier:2 3"])
def test_a_setting_that_is_neither_word_nor_value_is_an_error_of_usage(zoo: Zoo, value: str, tmp_path: Path) -> None:
    for command in ("train", "enjoy", "evaluate"):
        with pytest.raises(SystemExit):
            zoo(command, "--env", CARTPOLE, "-f", str(tmp_path), "--env-kwargs", value)
        assert f"--env-kwargs {value}: write NAME:VALUE with a word, a path or a Python value" in zoo.output


@pytest.mark.parametrize("value", ["false", "TRUE"])
def test_a_constant_in_another_spelling_is_not_taken_for_a_word(zoo: Zoo, value: str) -> None:
    with pytest.raises(SystemExit):
        zoo("train", "--env", CARTPOLE, "--env-kwargs", f"shadows:{value}")
    assert f"--env-kwargs shadows:{value}: write {value.title()}" in zoo.output


def test_a_shell_shows_what_a_command_cannot_do_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["robust-bisim", "train", "--env", CARTPOLE, "--variant", "normed-ir"])
    with pytest.raises(SystemExit, match=r"^robust-bisim: --variant normed-ir: no such variant, .* has SAC, DBC"):
        shell()


def test_a_numbered_run_that_rl_zoo3_downloads_is_left_to_it(zoo: Zoo, monkeypatch: pytest.MonkeyPatch) -> None:
    played: list[str] = []
    monkeypatch.setattr(rl_zoo3.enjoy, "enjoy", lambda: played.extend(sys.argv))
    zoo("enjoy", "--algo", "sac", "--env", "Pendulum-v1", "-f", "rl-trained-agents", "--exp-id", "1")
    assert played[played.index("--exp-id") + 1] == "1"


def test_the_error_for_a_task_without_settings_lists_the_tasks_with_settings(zoo: Zoo, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"--env Pendulum-v1: .* robust_bisim/SparsePendulum-v0.* Copy the file, rename"):
        zoo("train", "--env", "Pendulum-v1", "-f", str(tmp_path / "logs"))
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train"], "train: error: --env: name the task."),
        (["enjoy"], "enjoy: error: --env: name the task."),
        (["train", "--env", "SparseCartPole-v0"], f"no such task, did you mean '{CARTPOLE}'? If your"),
        (["train", "--env", "robust_bisim/SparseCartpole-v0"], f"no such task, did you mean '{CARTPOLE}'? If your"),
        (["train", "--env", "x"], "--env x: no such task. If your package registers it, add --gym-packages"),
    ],
)
def test_a_task_that_does_not_exist_is_refused_with_the_closest_one(zoo: Zoo, arguments: list[str], message: str) -> None:
    with pytest.raises(SystemExit):
        zoo(*arguments)
    assert message in zoo.output


@pytest.mark.parametrize("packages", [["--gym-packages", "json"], ["--gym-packages=json"]])
def test_a_task_of_a_package_is_left_to_rl_zoo3(zoo: Zoo, packages: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []
    monkeypatch.setattr(rl_zoo3.train, "train", lambda: seen.extend(sys.argv))
    zoo("train", "--env", "My-v0", *packages)
    assert seen[seen.index("--env") + 1] == "My-v0"


@pytest.mark.parametrize(
    ("file", "message"), [("", "this is a folder"), ("a file/run.pkl", "name a file in a folder with write access")]
)
def test_a_checkpoint_that_could_not_be_written_is_refused_at_once(zoo: Zoo, file: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a file").touch()
    with pytest.raises(SystemExit):
        zoo("train", "--env", CARTPOLE, "--checkpoint", str(tmp_path / file), "-f", str(tmp_path / "logs"))
    assert f"--checkpoint {tmp_path / file}: " in zoo.output
    assert message in zoo.output


@pytest.mark.parametrize(("starts", "last"), [(40, "still before training (step 40): 2.0"), (30, "last (step 40): 2.0")])
def test_the_report_calls_an_agent_trained_only_after_training(
    starts: int, last: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    np.savez(tmp_path / "evaluations.npz", timesteps=[20, 40], results=[[1.0, 2.0], [3.0, 1.0]])
    report(tmp_path, "a run", starts)
    assert last in capsys.readouterr().out


def test_runs_that_begin_together_have_folders_of_their_own(zoo: Zoo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taken = tmp_path / "bisim_sac" / "robust_bisim-SparseCartPole-v0_1"
    preprocess = BisimExperimentManager._preprocess_hyperparams

    def meanwhile(manager: BisimExperimentManager, *args: Any) -> Any:  # rl-zoo3 has chosen the number by then
        taken.mkdir(parents=True)
        return preprocess(manager, *args)

    monkeypatch.setattr(BisimExperimentManager, "_preprocess_hyperparams", meanwhile)
    output = zoo("train", "--env", CARTPOLE, "--eval-freq", "-1", "-f", str(tmp_path), *SHORT)
    assert f"Model:          {taken.with_name('robust_bisim-SparseCartPole-v0_2')}/" in output
    assert not list(taken.iterdir())


def test_a_config_may_have_one_entry_for_all_tasks_and_no_variants(zoo: Zoo, tmp_path: Path) -> None:
    config = tmp_path / "default.yml"
    config.write_text("variants:\ndefault: {policy: MlpPolicy, n_timesteps: 30, learning_starts: 20}\n")
    common = ["train", "--env", "Pendulum-v1", "-conf", str(config), "-f", str(tmp_path), "--eval-freq", "-1"]
    assert "Model:          " in zoo(*common)
    with pytest.raises(ValueError, match=r"--variant DBC: no such variant. For Pendulum-v1, .* has no variants"):
        zoo(*common, "--variant", "DBC")


def test_variants_extend_the_mappings_of_the_entry_for_all_tasks(tmp_path: Path) -> None:
    config = tmp_path / "default.yml"
    entry = {"policy_kwargs": {"net_arch": [64]}, "variants": {"small": {"policy_kwargs": {"n_critics": 1}}}}
    config.write_text(yaml.dump({"default": entry}))
    assert variant_settings(config, "Pendulum-v1", "small") == {"policy_kwargs": {"net_arch": [64], "n_critics": 1}}


def test_a_config_may_be_python(zoo: Zoo, tmp_path: Path) -> None:
    config = tmp_path / "config.py"
    entry = "dict(policy='MlpPolicy', n_timesteps=30, learning_starts=20, replay_buffer_class=ReplayBuffer)"
    config.write_text(f"from stable_baselines3.common.buffers import ReplayBuffer\nhyperparams = {{'Pendulum-v1': {entry}}}\n")
    common = ["train", "--env", "Pendulum-v1", "-conf", str(config), "-f", str(tmp_path), "--eval-freq", "-1"]
    assert "Model:          " in zoo(*common)
    study = ["--storage", f"sqlite:///{tmp_path}/study.db", "--study-name", "pendulum", "--trial-id", "1"]
    with pytest.raises(ValueError, match=r"config\.py: --trial-id needs a YAML file"):
        zoo(*common, *study)
    with pytest.raises(ValueError, match=r"config\.py: --variant needs a YAML file"):
        zoo(*common, "--variant", "SAC")


def test_a_command_that_needs_an_extra_says_so(zoo: Zoo, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(rl_zoo3, "plots", raising=False)
    monkeypatch.setitem(sys.modules, "rl_zoo3.plots", None)
    with pytest.raises(ImportError, match=r"plot_train needs the extra `plots`: pip install sb3_robust_bisim\[plots\]"):
        zoo("plot_train")


def test_a_run_that_was_stopped_says_so(zoo: Zoo, tmp_path: Path) -> None:
    content = yaml.safe_load(CONFIG.read_text())
    content[CARTPOLE]["callback"] = [{"stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes": {"max_episodes": 1}}]
    config = tmp_path / "stops.yml"
    config.write_text(yaml.dump(content))
    output = zoo("train", "--env", CARTPOLE, "-conf", str(config), "-f", str(tmp_path), "--seed", "0", *SHORT)
    assert re.search(r"Stopped at step \d\d of 120\.", output)


class Terminated(BaseCallback):
    """Sends this process SIGTERM at step 60."""

    def _on_step(self) -> bool:
        if self.num_timesteps == 60:
            os.kill(os.getpid(), signal.SIGTERM)
        return True


def test_sigterm_ends_training_with_a_saved_agent(zoo: Zoo, tmp_path: Path) -> None:
    content = yaml.safe_load(CONFIG.read_text())
    content[CARTPOLE]["callback"] = [f"{__name__}.Terminated"]
    config = tmp_path / "terminated.yml"
    config.write_text(yaml.dump(content))
    before = signal.getsignal(signal.SIGTERM)
    output = zoo("train", "--env", CARTPOLE, "-conf", str(config), "-f", str(tmp_path), "--seed", "0", *SHORT)
    assert "Stopped at step 60 of 120." in output
    path = re.search(r"^Model: +(\S+)$", output, re.MULTILINE)
    assert path is not None
    assert BisimSAC.load(path[1]).num_timesteps == 60
    assert signal.getsignal(signal.SIGTERM) == before


def test_what_fails_after_training_can_be_repeated(zoo: Zoo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint = tmp_path / "run.pkl"
    arguments = ["train", "--env", CARTPOLE, "--checkpoint", str(checkpoint), "--checkpoint-freq", "100"]
    arguments += ["-f", str(tmp_path / "logs"), "--eval-freq", "-1", *SHORT]

    def report_on_a_full_disk(*_: Any) -> None:
        Path("/dev/full").write_text("report")

    with monkeypatch.context() as patch:
        patch.setattr("sb3_robust_bisim.cli.manager.report", report_on_a_full_disk)
        with pytest.raises(OSError, match="No space left"):
            zoo(*arguments)
    assert checkpoint.exists()
    assert "Going on from step 100" in zoo(*arguments)
    assert not checkpoint.exists()


def test_a_checkpoint_that_another_process_writes_is_refused(zoo: Zoo, tmp_path: Path) -> None:
    checkpoint = tmp_path / "run.pkl"
    arguments = ("train", "--env", CARTPOLE, "--checkpoint", str(checkpoint), "-f", str(tmp_path / "logs"), *SHORT)
    with FileLock(tmp_path / ".run.pkl.lock"), pytest.raises(SystemExit, match=r"run\.pkl: another process is writing it"):
        zoo(*arguments)
    assert not (tmp_path / "logs").exists()
    assert "Model:          " in zoo(*arguments)


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("-n", "0", "--n-timesteps 0: must be at least 1."),
        ("-n", "-1", "--n-timesteps -1: must be at least 1."),
        ("--eval-episodes", "0", "--eval-episodes 0: must be at least 1."),
        ("--n-eval-envs", "0", "--n-eval-envs 0: must be at least 1."),
        ("--n-trials", "0", "--n-trials 0: must be at least 1."),
        ("-i", "nothere.zip", "-i nothere.zip: there is no such file. Pass the .zip of a saved agent."),
        ("--trial-id", "3", "--trial-id 3: needs --storage and --study-name."),
        ("--device", "gpu", "--device gpu: no such device here (Expected one of cpu, cuda"),
        ("--device", "cuda:99", "--device cuda:99: no such device here ("),
        ("--checkpoint-freq", "500", "--checkpoint-freq: needs --checkpoint FILE."),
        ("--num-threads", "0", "argument --num-threads: 0 must be an integer of at least 1, or -1"),
        ("--tensorboard-log", "/dev/null/tb", "--tensorboard-log /dev/null/tb: Not a directory; name a folder"),
        ("--log-folder", "/dev/null/logs", "--log-folder /dev/null/logs: Not a directory; name a folder"),
    ],
)
def test_a_run_that_could_not_work_is_refused(zoo: Zoo, option: str, value: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as stop:
        zoo("train", "--env", CARTPOLE, "-f", str(tmp_path / "logs"), option, value)
    assert stop.value.code == 2
    assert message in zoo.output
    assert not (tmp_path / "logs").exists()


def test_help_needs_no_folder_to_write_to(zoo: Zoo) -> None:
    with pytest.raises(SystemExit) as stop:
        zoo("train", "-f", "/dev/null/logs", "--help")
    assert stop.value.code == 0
    assert "--n-eval-envs" in zoo.output


def test_a_folder_behind_a_locked_one_is_named(zoo: Zoo, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path) -> bool:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("sb3_robust_bisim.cli.options.Path.exists", refuse)
    with pytest.raises(SystemExit):
        zoo("train", "--env", CARTPOLE, "-f", "locked/logs")
    assert "--log-folder locked/logs: Permission denied; name a folder with write access." in zoo.output


def test_a_missing_config_file_is_named(zoo: Zoo) -> None:
    with pytest.raises(SystemExit) as stop:
        zoo("train", "--env", CARTPOLE, "-conf", "nowhere.yml")
    assert stop.value.code == 2
    assert "-conf nowhere.yml: there is no such file" in zoo.output


def test_a_misspelt_key_in_a_config_file_is_named(zoo: Zoo, tmp_path: Path) -> None:
    config = tmp_path / "typo.yml"
    content = yaml.safe_load(CONFIG.read_text())
    content[CARTPOLE]["n_timestep"] = content[CARTPOLE].pop("n_timesteps")
    config.write_text(yaml.dump(content))
    with pytest.raises(ValueError, match="unknown key 'n_timestep', did you mean 'n_timesteps'"):
        zoo("train", "--env", CARTPOLE, "-conf", str(config), "-f", str(tmp_path / "logs"))
    assert not (tmp_path / "logs").exists()


NO_HER = {"using_her_replay_buffer": False, "her_kwargs": {}}


def test_optuna_samples_arguments_that_bisim_sac_accepts() -> None:
    tuned = {"intrinsic_reward_scale": 2.0, "inverse_dynamics_coef": 1.0}

    def objective(trial: optuna.Trial) -> float:
        sampled = sample_bisim_sac_params(trial, 1, 1, NO_HER, tuned)
        model = BisimSAC("MlpPolicy", CARTPOLE, buffer_size=100, **sampled)
        assert model.intrinsic_reward_scale == trial.params["intrinsic_reward_scale"]
        assert HYPERPARAMS_CONVERTER["bisim_sac"](trial.params) == sampled
        return model.bisim_coef

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    study.optimize(objective, n_trials=3)
    assert len({trial.value for trial in study.trials}) == 3


def test_optuna_tunes_the_method_of_the_command_with_its_policy_kwargs(zoo: Zoo, tmp_path: Path) -> None:
    content = yaml.safe_load(CONFIG.read_text())
    # an expression, as in rl-zoo3's own files
    content[CARTPOLE]["policy_kwargs"] = "dict(n_critics=1, optimizer_kwargs=dict(eps=1e-5))"
    config = tmp_path / "expression.yml"
    config.write_text(yaml.dump(content))
    study = ["--study-name", "cartpole", "--storage", f"sqlite:///{tmp_path}/study.db"]
    optimize = ["-optimize", "--n-trials", "1", "--n-evaluations", "1", "--no-optim-plots", "--eval-episodes", "1", *study]
    common = ["train", "--env", CARTPOLE, "-conf", str(config), "-f", str(tmp_path / "logs"), "-n", "60", "--seed", "0"]
    zoo(*common, *optimize, "--variant", "normed-ID", "-params", "learning_starts:50", "initial_gradient_steps:1")
    trial = optuna.load_study(study_name="cartpole", storage=study[-1]).trials[0]
    assert trial.state == optuna.trial.TrialState.COMPLETE
    assert {"bisim_coef", "inverse_dynamics_coef"} <= trial.params.keys()
    assert "intrinsic_reward_scale" not in trial.params  # normed-ID has no bonus
    assert "rl_zoo3" in str(rl_zoo3.train.ExperimentManager)  # the command does not change rl-zoo3


def test_optuna_samples_nothing_that_the_tuned_method_switches_off() -> None:
    tuned = {**SAC, "policy_kwargs": {"n_critics": 1}}
    sampled = sample_bisim_sac_params(optuna.create_study().ask(), 1, 1, NO_HER, tuned)
    assert not sampled.keys() & {"bisim_coef", "intrinsic_reward_scale", "inverse_dynamics_coef"}
    assert sampled["policy_kwargs"].keys() == {"n_critics", "net_arch"}
    sampled = sample_bisim_sac_params(optuna.create_study().ask(), 1, 1, NO_HER)  # BisimSAC's defaults use only the metric
    assert "bisim_coef" in sampled
    assert not sampled.keys() & {"intrinsic_reward_scale", "inverse_dynamics_coef"}


@pytest.mark.parametrize(("expression", "number"), [(False, 0), (False, 1), (True, 1)])
def test_a_trial_is_repeated_with_its_own_settings(zoo: Zoo, expression: bool, number: int, tmp_path: Path) -> None:
    storage = f"sqlite:///{tmp_path}/study.db"
    study = optuna.create_study(storage=storage, study_name="pendulum")
    layers = {"features_extractor_kwargs": {"n_layers": 3}}
    config = tmp_path / "config.yml"
    content = yaml.safe_load(CONFIG.read_text())
    if expression:  # as in rl-zoo3's own files, which evaluates it
        content[PENDULUM]["variants"]["DBC"]["policy_kwargs"] = "dict(features_extractor_kwargs=dict(n_layers=3))"
    config.write_text(yaml.dump(content))
    trials = []
    for _ in range(2):
        trial = study.ask()
        trials.append(sample_bisim_sac_params(trial, 1, 1, NO_HER, {"bisim_coef": 0.5, "policy_kwargs": layers}))
        study.tell(trial, 0.0)
    sampled = trials[number]
    zoo(
        *("train", "--env", PENDULUM, "--variant", "DBC", "--eval-freq", "-1", "-n", "20", "-f", str(tmp_path)),
        *("--storage", storage, "--study-name", "pendulum", "--trial-id", str(number)),
        *("-conf", str(config)),
    )
    model = BisimSAC.load(tmp_path / "bisim_sac/robust_bisim-SparsePendulum-v0_1/robust_bisim-SparsePendulum-v0.zip")
    assert model.bisim_coef == sampled["bisim_coef"]  # not the variant's
    assert model.policy_kwargs["features_extractor_kwargs"] == layers["features_extractor_kwargs"]
    assert model.policy_kwargs["net_arch"] == sampled["policy_kwargs"]["net_arch"]


@pytest.mark.parametrize(("command", "option"), [("train", "--variant"), ("enjoy", "--exp-id")])
def test_help_shows_the_name_of_the_command_and_its_options(zoo: Zoo, command: str, option: str) -> None:
    with pytest.raises(SystemExit):
        zoo(command, "--help")
    ours, theirs = zoo.output.split("All options of rl-zoo3:")
    assert f"usage: robust-bisim {command} " in ours
    assert f"usage: robust-bisim {command} " in theirs
    assert option in ours
    assert "--num-threads" in ours
    assert str(CONFIG) in ours or command == "enjoy"


def test_the_package_runs_as_a_module_and_its_usage_names_the_commands(tmp_path: Path) -> None:
    arguments = [sys.executable, "-m", "sb3_robust_bisim", "--help"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    result = subprocess.run(arguments, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300, check=True)
    assert "usage: python -m sb3_robust_bisim COMMAND" in result.stdout
    for command, what in COMMANDS.items():
        assert re.search(rf"^  {command} +{what}$", result.stdout, re.MULTILINE)


def test_a_misspelt_command_is_named_with_the_closest_one(zoo: Zoo) -> None:
    with pytest.raises(SystemExit):
        zoo("trian", "--env", CARTPOLE)
    assert zoo.output.startswith("robust-bisim trian: there is no such command, did you mean 'train'?\n\nusage: robust-bisim")


@pytest.mark.parametrize(
    ("variables", "arguments", "threads"),
    [
        ({}, [], "1"),
        ({}, ["--num-threads", "3"], "3"),
        ({}, ["--num-threads", "-1"], "-1"),
        ({"OMP_NUM_THREADS": "2"}, [], "-1"),
        ({"OMP_WAIT_POLICY": "passive"}, [], "-1"),
        ({"OMP_NUM_THREADS": "2"}, ["--num-threads", "3"], "3"),
    ],
)
@pytest.mark.parametrize("command", ["train", "enjoy"])
def test_torch_uses_one_thread_unless_the_user_chooses_otherwise(
    command: str, variables: dict[str, str], arguments: list[str], threads: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in SET_BY_THE_USER:
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    seen: list[list[str]] = []
    monkeypatch.setattr(getattr(rl_zoo3, command), command, lambda: seen.append(list(sys.argv)))
    main([command, "--env", CARTPOLE, "-f", "rl-trained-agents", *arguments])
    assert seen[0].count("--num-threads") == 1
    assert seen[0][seen[0].index("--num-threads") + 1] == threads


def test_optuna_with_a_checkpoint_is_refused(zoo: Zoo, tmp_path: Path) -> None:
    for optimize in ("-optimize", "--optimize-hyper"):  # rl-zoo3 takes abbreviations
        with pytest.raises(ValueError, match=r"--checkpoint with -optimize: not supported"):
            zoo("train", "--env", CARTPOLE, optimize, "--checkpoint", "run.pkl", "-f", str(tmp_path / "logs"))
    assert not (tmp_path / "logs").exists()
