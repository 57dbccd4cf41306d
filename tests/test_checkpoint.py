"""Training that resumes from a checkpoint ends exactly like training that was never interrupted."""

import pickle
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
import yaml
from small_models import make_model
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecFrameStack, VecNormalize

from sb3_robust_bisim import BisimSAC, FrameStackReplayBuffer, IntrinsicRewardVecEnv
from sb3_robust_bisim.cli import zoo
from sb3_robust_bisim.runs.atomic import atomic_path
from sb3_robust_bisim.runs.checkpoint import Checkpoint, load_checkpoint, read_about, save_checkpoint

STEPS = 120
LEARNING: dict[str, Any] = dict(learning_starts=20, buffer_size=200)


class StopAt(BaseCallback):
    """Ends training at a step, like a kill. All steps after the last checkpoint are lost."""

    def __init__(self, step: int) -> None:
        super().__init__()
        self.step = step

    def _on_step(self) -> bool:
        return self.num_timesteps < self.step


def state_task() -> VecEnv:
    venv = make_vec_env("robust_bisim/cheetah-run-v0", 2, seed=3, env_kwargs=dict(noise_multiplier=1, action_repeat=40))
    return VecNormalize(IntrinsicRewardVecEnv(venv), norm_reward=False)


def pixel_task() -> VecEnv:
    kwargs = dict(distractor="video", size=16, action_repeat=40)
    return VecFrameStack(make_vec_env("robust_bisim/cartpole-swingup-pixels-v0", 2, seed=3, env_kwargs=kwargs), n_stack=3)


def model_of(task: str) -> BisimSAC:
    if task == "state":
        return make_model("MlpPolicy", state_task(), **LEARNING)
    return make_model("CnnPolicy", pixel_task(), replay_buffer_class=FrameStackReplayBuffer, **LEARNING)


@pytest.mark.parametrize("task", ["state", "pixels"])
def test_resumed_training_equals_uninterrupted_training(task: str, tmp_path: Path) -> None:
    expected = model_of(task).learn(STEPS)

    interrupted = model_of(task)
    interrupted.learn(STEPS, callback=CallbackList([Checkpoint(tmp_path / "checkpoint.pkl", 50), StopAt(90)]))
    set_random_seed(99)  # another process has other generators
    model, _ = load_checkpoint(tmp_path / "checkpoint.pkl")
    assert 50 <= model.num_timesteps < 90
    model.learn(STEPS - model.num_timesteps, reset_num_timesteps=False)

    assert model.num_timesteps == expected.num_timesteps
    for name, tensor in expected.policy.state_dict().items():
        assert th.equal(tensor, model.policy.state_dict()[name]), name
    np.testing.assert_array_equal(model.replay_buffer.rewards, expected.replay_buffer.rewards)
    np.testing.assert_array_equal(model.env.reset(), expected.env.reset())


def test_a_monitor_file_lists_each_episode_once(tmp_path: Path) -> None:
    def model(folder: Path) -> BisimSAC:
        venv = make_vec_env("robust_bisim/SparseCartPole-v0", 1, seed=3, monitor_dir=str(folder))
        return make_model(env=venv, **LEARNING)

    def episodes(folder: Path) -> list[tuple[str, ...]]:
        return [tuple(line.split(",")[:2]) for line in (folder / "0.monitor.csv").read_text().splitlines()[1:]]

    path = tmp_path / "checkpoint.pkl"
    model(tmp_path / "a").learn(STEPS)
    model(tmp_path / "b").learn(STEPS, callback=CallbackList([Checkpoint(path, 50), StopAt(90)]))
    interrupted = episodes(tmp_path / "b")
    assert len(interrupted) < len(episodes(tmp_path / "a"))
    continued, _ = load_checkpoint(path)
    assert episodes(tmp_path / "b") == interrupted  # loading changes nothing
    save_checkpoint(path, continued)  # before another episode has ended
    for stop in (105, STEPS):
        continued, _ = load_checkpoint(path)
        steps = STEPS - continued.num_timesteps
        continued.learn(steps, CallbackList([Checkpoint(path, 45), StopAt(stop)]), reset_num_timesteps=False)
    assert episodes(tmp_path / "b") == episodes(tmp_path / "a")


@pytest.mark.parametrize(
    ("env", "venv_class", "message"),
    [
        ("Pendulum-v1", SubprocVecEnv, "use DummyVecEnv"),
        (
            "InvertedPendulum-v5",
            DummyVecEnv,
            r"InvertedPendulumEnv is pickled as the arguments of its constructor .* begin anew",
        ),
    ],
)
def test_environments_that_cannot_be_saved_are_refused_at_the_start(
    env: str, venv_class: type[VecEnv], message: str, tmp_path: Path
) -> None:
    venv = make_vec_env(env, 1, vec_env_cls=venv_class)
    model = make_model(env=venv, **LEARNING)
    with pytest.raises(ValueError, match=message):
        model.learn(30, callback=Checkpoint(tmp_path / "checkpoint.pkl", 100))
    with pytest.raises(ValueError, match=message):
        save_checkpoint(tmp_path / "checkpoint.pkl", model)
    assert not list(tmp_path.iterdir())
    venv.close()


def test_resumed_training_with_hindsight_replay_equals_uninterrupted_training(tmp_path: Path) -> None:
    def model() -> BisimSAC:
        env = BitFlippingEnv(n_bits=4, continuous=True)
        settings = dict(intrinsic_reward_scale=0.0, replay_buffer_class=HerReplayBuffer)
        return make_model("MultiInputPolicy", env, **LEARNING, **settings)

    expected = model().learn(60)
    model().learn(60, callback=CallbackList([Checkpoint(tmp_path / "checkpoint.pkl", 30), StopAt(40)]))
    continued, _ = load_checkpoint(tmp_path / "checkpoint.pkl")
    continued.learn(60 - continued.num_timesteps, reset_num_timesteps=False)
    for name, tensor in expected.policy.state_dict().items():
        assert th.equal(tensor, continued.policy.state_dict()[name]), name


def test_a_half_written_checkpoint_is_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pkl"
    script = f"""
import os, signal
from sb3_robust_bisim.runs.atomic import atomic_path
with atomic_path({str(path)!r}, alone=True) as temporary:
    temporary.write_text("half a checkpoint")
    os.kill(os.getpid(), signal.SIGKILL)
"""
    assert subprocess.run([sys.executable, "-c", script], timeout=300).returncode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 1
    save_checkpoint(path, make_model(**LEARNING))
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.pkl"]
    assert read_about(path)["num_timesteps"] == 0


def test_two_writers_of_one_file_do_not_mix(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "clip.raw") as first, atomic_path(tmp_path / "clip.raw") as second:
        first.write_text("first")
        second.write_text("second")
    assert (tmp_path / "clip.raw").read_text() == "first"  # the last one to end
    assert len(list(tmp_path.iterdir())) == 1


def test_an_interval_of_no_steps_between_checkpoints_is_refused() -> None:
    with pytest.raises(ValueError, match="every=0"):
        Checkpoint("checkpoint.pkl", 0)


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The arguments of a run that is cut off before it saves its agent. It leaves a checkpoint at step 50."""
    monkeypatch.setattr(zoo.BisimExperimentManager, "save_trained_model", lambda *_: None)
    common = [
        *("train", "--env", "robust_bisim/SparseCartPole-v0", "--eval-freq", "-1", "--verbose", "0", "--n-timesteps", "60"),
        *("--log-folder", str(tmp_path), "--checkpoint", str(tmp_path / "checkpoint.pkl"), "--checkpoint-freq", "50"),
        *("-params", "learning_starts:20", "batch_size:8"),
    ]
    zoo.main([*common, "--seed", "3"])
    return common


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (["--seed=4"], r"seed is 3 there and 4 here\. Name another file"),
        (["--seed", "3", "--eval-episodes", "2"], "eval_episodes is 5 there and 2 here"),
        (["--seed", "3", "-params", "learning_starts:20", "batch_size:16"], "batch_size is 8 there and 16 here"),
        (["--seed", "3", "--eval-env-kwargs", "theta_rew_fraction:0.5"], "eval_env_kwargs is .*1.0.* there and .*0.5.* here"),
        (["--seed", "3", "--n-timesteps", "40"], r"--n-timesteps 40: .* is at step 50 already"),
    ],
)
def test_the_command_line_refuses_the_checkpoint_of_another_run(
    command: list[str], changed: list[str], message: str, tmp_path: Path
) -> None:
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(ValueError, match=message):
        zoo.main([*command, *changed])
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_checkpoint_is_refused_if_the_config_evaluates_differently(command: list[str], tmp_path: Path) -> None:
    config = yaml.safe_load(zoo.DEFAULT_CONFIG.read_text())
    config["robust_bisim/SparseCartPole-v0"]["eval_env_kwargs"] = {"theta_rew_fraction": 0.5}
    (tmp_path / "other.yml").write_text(yaml.dump(config))
    with pytest.raises(ValueError, match=r"eval_env_kwargs is .*1\.0.* there and .*0\.5.* here"):
        zoo.main([*command, "--seed", "3", "-conf", str(tmp_path / "other.yml")])


def test_a_resumed_run_may_be_longer(command: list[str], capsys: pytest.CaptureFixture) -> None:
    zoo.main([*command, "--seed", "3", "--n-timesteps", "80"])
    assert "Going on from step 50" in capsys.readouterr().out


def test_a_checkpoint_from_other_package_versions_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_robust_bisim.runs.checkpoint._versions", lambda: {"torch": "1.0"})
    save_checkpoint(tmp_path / "checkpoint.pkl", make_model(**LEARNING))
    monkeypatch.undo()
    with pytest.raises(ValueError, match=r"needs the versions that it was written with: .*torch is 1\.0 there and 2"):
        load_checkpoint(tmp_path / "checkpoint.pkl")


def test_a_checkpoint_from_a_machine_with_more_gpus_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_checkpoint(tmp_path / "checkpoint.pkl", make_model(**LEARNING), about={"name": "a"})
    assert read_about(tmp_path / "checkpoint.pkl")["gpus"] == 0
    with (tmp_path / "checkpoint.pkl").open("rb") as file:
        header, rest = pickle.load(file), file.read()
    (tmp_path / "elsewhere.pkl").write_bytes(pickle.dumps({**header, "gpus": 99}) + rest)
    with pytest.raises(ValueError, match=r"elsewhere\.pkl: written with 99 GPUs, here are \d"):
        load_checkpoint(tmp_path / "elsewhere.pkl")


def test_a_file_that_is_not_a_checkpoint_is_refused_by_name(command: list[str], tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pkl"
    path.write_bytes(b"PK\x03\x04 a model, say")
    with pytest.raises(ValueError, match=r"checkpoint\.pkl: this is no checkpoint. Name another file"):
        zoo.main([*command, "--seed", "3"])
    path.write_bytes(pickle.dumps([1, 2]))
    with pytest.raises(ValueError, match=r"checkpoint\.pkl: this is no checkpoint, but some other pickle"):
        zoo.main([*command, "--seed", "3"])
    save_checkpoint(path, make_model(**LEARNING))
    with pytest.raises(ValueError, match=r"--checkpoint .*checkpoint\.pkl: saved from Python, not by this command"):
        zoo.main([*command, "--seed", "3"])


def test_training_resumes_if_the_user_had_set_a_logger(tmp_path: Path) -> None:
    model = make_model(**LEARNING)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(40, callback=Checkpoint(tmp_path / "checkpoint.pkl", 30))
    assert load_checkpoint(tmp_path / "checkpoint.pkl")[0].learn(10, reset_num_timesteps=False).num_timesteps == 40
