"""Training that resumes from a checkpoint ends exactly like training that was never interrupted."""

import os
import pickle
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch as th
import yaml
from sb3_contrib import QRDQN
from small_models import NormDropout, StopAt, logged_steps, make_model, pendulum
from stable_baselines3 import DQN, TD3, HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.logger import configure
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize

from sb3_robust_bisim import BisimSAC, FrameStackReplayBuffer, IntrinsicRewardVecEnv
from sb3_robust_bisim.cli import zoo, zoo_config
from sb3_robust_bisim.runs.atomic import atomic_path
from sb3_robust_bisim.runs.checkpoint import Checkpoint, load_checkpoint, read_about, save_checkpoint
from sb3_robust_bisim.runs.hashed_file import replaced

STEPS = 120
LEARNING: dict[str, Any] = dict(learning_starts=20, buffer_size=200)


def state_task() -> VecEnv:
    venv = make_vec_env("robust_bisim/cheetah-run-v0", 2, seed=3, env_kwargs=dict(noise_multiplier=1, action_repeat=40))
    return VecNormalize(IntrinsicRewardVecEnv(venv), norm_reward=False)


def pixel_task() -> VecEnv:
    kwargs = dict(distractor="video", size=16, action_repeat=40)
    return VecFrameStack(make_vec_env("robust_bisim/cartpole-swingup-pixels-v0", 2, seed=3, env_kwargs=kwargs), n_stack=3)


def model_of(task: str) -> BisimSAC:
    if task == "state":
        return make_model("MlpPolicy", state_task(), **LEARNING)
    if task == "batch norm":
        policy_kwargs = dict(net_arch=[16], features_extractor_class=NormDropout, share_features_extractor=False)
        return make_model("MlpPolicy", state_task(), **LEARNING, policy_kwargs=policy_kwargs)
    return make_model("CnnPolicy", pixel_task(), replay_buffer_class=FrameStackReplayBuffer, **LEARNING)


def hindsight_model() -> BisimSAC:
    env = BitFlippingEnv(n_bits=4, continuous=True)
    settings = dict(intrinsic_reward_scale=0.0, replay_buffer_class=HerReplayBuffer)
    return make_model("MultiInputPolicy", env, **LEARNING, **settings)


def assert_equal_weights(model: BisimSAC, expected: BisimSAC) -> None:
    for name, tensor in expected.policy.state_dict().items():
        assert th.equal(tensor, model.policy.state_dict()[name]), name


@pytest.mark.parametrize("task", ["state", "batch norm", "pixels"])
def test_resumed_training_equals_uninterrupted_training(task: str, tmp_path: Path) -> None:
    expected = model_of(task).learn(STEPS)

    interrupted = model_of(task)
    interrupted.learn(STEPS, callback=CallbackList([Checkpoint(tmp_path / "checkpoint.pkl", 50), StopAt(90)]))
    set_random_seed(99)  # another process has other generators
    model, _ = load_checkpoint(tmp_path / "checkpoint.pkl")
    assert 50 <= model.num_timesteps < 90
    model.learn(STEPS - model.num_timesteps, reset_num_timesteps=False)

    assert model.num_timesteps == expected.num_timesteps
    assert_equal_weights(model, expected)
    np.testing.assert_array_equal(model.replay_buffer.rewards, expected.replay_buffer.rewards)
    np.testing.assert_array_equal(model.env.reset(), expected.env.reset())


def test_a_continued_run_logs_where_it_began_though_another_run_has_begun_since(tmp_path: Path) -> None:
    def steps_of(run: int) -> list[int]:
        return logged_steps(tmp_path / "runs", "rollout/ep_len_mean", run)

    logs = dict(tensorboard_log=str(tmp_path / "runs"), env=pendulum(), **LEARNING)
    path = tmp_path / "checkpoint.pkl"
    make_model(**logs).learn(STEPS, CallbackList([Checkpoint(path, 50), StopAt(90)]), log_interval=1)
    make_model(**logs).learn(60, log_interval=1)
    other = steps_of(2)
    model, _ = load_checkpoint(path)
    model.save(tmp_path / "agent")
    save_checkpoint(path, model)
    assert model.log_folder == str(tmp_path / "runs/BisimSAC_1")
    model.learn(STEPS - model.num_timesteps, reset_num_timesteps=False, log_interval=1)
    assert steps_of(1)[-1] == STEPS
    assert steps_of(2) == other
    model.learn(20, log_interval=1)  # a new run
    assert steps_of(3) == [10, 20]
    BisimSAC.load(tmp_path / "agent", env=pendulum()).learn(100, reset_num_timesteps=False, log_interval=1)
    assert steps_of(1)[-1] == 150
    assert steps_of(3) == [10, 20]


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


def test_environments_that_cannot_be_saved_are_refused_at_the_start(tmp_path: Path) -> None:
    venv = make_vec_env("Pendulum-v1", 1)
    venv.envs[0].unwrapped.lock = threading.Lock()  # type: ignore[attr-defined]
    model = make_model(env=venv, **LEARNING)
    with pytest.raises(ValueError, match="PendulumEnv cannot be saved"):
        model.learn(30, callback=Checkpoint(tmp_path / "checkpoint.pkl", 100))
    with pytest.raises(ValueError, match="PendulumEnv cannot be saved"):
        save_checkpoint(tmp_path / "checkpoint.pkl", model)
    assert not list(tmp_path.iterdir())


def noise(kind: type[ActionNoise]) -> dict[str, Any]:
    return dict(action_noise=kind(np.zeros(1), 0.3 * np.ones(1)))


@pytest.mark.parametrize(
    ("n_envs", "exploration"),
    [
        (1, dict(use_sde=True)),
        (2, dict(use_sde=True, sde_sample_freq=3, train_freq=4)),
        (1, noise(NormalActionNoise)),
        (2, noise(OrnsteinUhlenbeckActionNoise)),
    ],
)
def test_exploration_continues_exactly(n_envs: int, exploration: dict[str, Any], tmp_path: Path) -> None:
    def model() -> BisimSAC:
        return make_model(env=make_vec_env("Pendulum-v1", n_envs, seed=3), **LEARNING, **exploration)

    path = tmp_path / "checkpoint.pkl"
    expected = model().learn(60)
    model().learn(60, callback=CallbackList([Checkpoint(path, 30), StopAt(48)]))
    loaded, _ = load_checkpoint(path)
    save_checkpoint(path, loaded, rollout_begun=True)  # before it has continued
    continued, _ = load_checkpoint(path)
    continued.learn(60 - continued.num_timesteps, reset_num_timesteps=False)
    assert_equal_weights(continued, expected)
    np.testing.assert_array_equal(continued.replay_buffer.actions, expected.replay_buffer.actions)


TRAINING = """
import os, signal, sys
from pathlib import Path
from small_models import make_model
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize
from sb3_robust_bisim import IntrinsicRewardVecEnv
from sb3_robust_bisim.runs import Checkpoint, ResumableSubprocVecEnv, load_checkpoint

class KilledAt(BaseCallback):
    def _on_step(self):
        if self.num_timesteps == int(sys.argv[2]):
            os.kill(os.getpid(), signal.SIGKILL)
        return True

def main():
    path = Path(sys.argv[1], "checkpoint.pkl")
    if path.exists():
        model, _ = load_checkpoint(path)
    else:
        venv = make_vec_env("Hopper-v5", 2, seed=3, vec_env_cls=ResumableSubprocVecEnv, monitor_dir=sys.argv[1])
        model = make_model(env=VecNormalize(IntrinsicRewardVecEnv(venv), norm_reward=False), use_sde=True, learning_starts=20)
    model.learn(160 - model.num_timesteps, [Checkpoint(path, 60), KilledAt()], reset_num_timesteps=False)
    model.save(Path(sys.argv[1], "agent.zip"))
    model.env.close()

if __name__ == "__main__":
    main()
"""


def test_a_killed_process_continues_exactly(tmp_path: Path) -> None:
    (tmp_path / "training.py").write_text(TRAINING)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}

    def train(name: str, killed_at: int) -> int:
        (tmp_path / name).mkdir(exist_ok=True)
        command = [sys.executable, "training.py", name, str(killed_at)]
        return subprocess.run(command, cwd=tmp_path, env=environment, timeout=300).returncode

    assert train("alone", -1) == 0
    assert train("killed", 150) == -signal.SIGKILL
    assert read_about(tmp_path / "killed" / "checkpoint.pkl")["num_timesteps"] == 120
    assert train("killed", -1) == 0
    assert_equal_weights(*(BisimSAC.load(tmp_path / name / "agent.zip") for name in ("killed", "alone")))
    for file in ("0.monitor.csv", "1.monitor.csv"):
        killed, alone = ([line.split(",")[:2] for line in (tmp_path / name / file).open()][1:] for name in ("killed", "alone"))
        assert killed == alone
        assert len(alone) > 2


@pytest.fixture
def two(tmp_path: Path) -> Path:
    """A checkpoint at step 40, with the one of step 20 before it."""
    make_model(**LEARNING).learn(50, callback=Checkpoint(tmp_path / "checkpoint.pkl", 20))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["checkpoint.pkl", "checkpoint.previous.pkl"]
    return tmp_path / "checkpoint.pkl"


def torn(content: bytes) -> bytes:
    return content[: len(content) // 2]


def altered(content: bytes) -> bytes:
    return content[:-1000] + b"x" + content[-999:]


def zeros(content: bytes) -> bytes:
    return bytes(len(content))


@pytest.mark.parametrize("damage", [torn, altered, zeros])
def test_a_damaged_checkpoint_is_replaced_by_the_one_before_with_a_warning(
    two: Path, damage: Callable[[bytes], bytes]
) -> None:
    two.write_bytes(damage(two.read_bytes()))
    with pytest.warns(UserWarning, match=r"checkpoint\.pkl: .* continues from .*checkpoint\.previous\.pkl, at step 20"):
        model, _ = load_checkpoint(two)
    assert model.learn(5, reset_num_timesteps=False).num_timesteps == 25

    older = two.with_name("checkpoint.previous.pkl")
    older.write_bytes(damage(older.read_bytes()))
    with pytest.raises(
        ValueError, match=r"checkpoint\.pkl: this (checkpoint is torn or altered|is no checkpoint).* start again"
    ):
        load_checkpoint(two)


def test_a_full_disk_keeps_only_the_newest_checkpoint(two: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=two.stat().st_size))
    with replaced(two):
        assert [path.name for path in two.parent.glob("checkpoint*")] == ["checkpoint.pkl"]


def test_a_checkpoint_of_an_earlier_run_is_not_kept_as_the_one_before(two: Path) -> None:
    two.unlink()  # to start again
    save_checkpoint(two, make_model(**LEARNING))
    assert [path.name for path in two.parent.iterdir()] == ["checkpoint.pkl"]


@pytest.mark.parametrize("task", ["state", "pixels", "hindsight"])
def test_other_versions_continue_in_new_episodes(task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "checkpoint.pkl"
    if task == "hindsight":
        model, env = hindsight_model(), hindsight_model().env
    else:
        model, env = model_of(task), {"state": state_task, "pixels": pixel_task}[task]()
    model.learn(60)
    with monkeypatch.context() as patched:
        patched.setattr("sb3_robust_bisim.runs.checkpoint._versions", lambda: {"torch": "1.0"})
        save_checkpoint(path, model)
    with pytest.raises(ValueError, match=r"not possible, .*torch is 1\.0 there and 2.* pass env \(.* --new-episodes\)"):
        load_checkpoint(path)

    continued, context = load_checkpoint(path, env=env)
    assert context is None
    assert_equal_weights(continued, model)
    assert (continued.num_timesteps, continued._n_updates) == (60, model._n_updates)
    np.testing.assert_array_equal(continued.replay_buffer.rewards, model.replay_buffer.rewards)
    if task == "state":
        np.testing.assert_array_equal(continued.env.obs_rms.mean, model.env.obs_rms.mean)
    assert continued.learn(20, reset_num_timesteps=False).num_timesteps == 80


@pytest.mark.parametrize(("algorithm", "env"), [(DQN, "CartPole-v1"), (QRDQN, "CartPole-v1"), (TD3, "Pendulum-v1")])
def test_other_algorithms_with_batch_norm_lists_are_loaded(algorithm: type[BaseAlgorithm], env: str, tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "checkpoint.pkl", algorithm("MlpPolicy", env, buffer_size=100))  # type: ignore[call-arg]
    assert type(load_checkpoint(tmp_path / "checkpoint.pkl")[0]) is algorithm


def test_new_episodes_in_another_number_of_environments_are_refused(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "checkpoint.pkl", make_model(**LEARNING))
    with pytest.raises(ValueError, match=r"env with num_envs=2: the checkpoint has a replay buffer for 1 environments. Pass"):
        load_checkpoint(tmp_path / "checkpoint.pkl", env=make_vec_env("Pendulum-v1", 2))


def test_resumed_training_with_hindsight_replay_equals_uninterrupted_training(tmp_path: Path) -> None:
    expected = hindsight_model().learn(60)
    hindsight_model().learn(60, callback=CallbackList([Checkpoint(tmp_path / "checkpoint.pkl", 30), StopAt(40)]))
    continued, _ = load_checkpoint(tmp_path / "checkpoint.pkl")
    continued.learn(60 - continued.num_timesteps, reset_num_timesteps=False)
    assert_equal_weights(continued, expected)


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


def test_a_write_that_finds_no_space_names_the_file_and_leaves_the_old_one(tmp_path: Path) -> None:
    model = make_model(**LEARNING)
    writers: dict[str, Callable[[Path], None]] = {
        "run.pkl": lambda path: save_checkpoint(path, model),
        "agent.zip": model.save,
        "buffer.pkl": model.save_replay_buffer,
    }
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    for name, write in writers.items():
        path = tmp_path / name
        write(path)
        old = path.read_bytes()
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(old) // 2, hard))
        try:
            with pytest.raises(OSError, match=name):
                write(path)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert path.read_bytes() == old
    assert sorted(path.name for path in tmp_path.iterdir() if "previous" not in path.name) == sorted(writers)


def test_two_writers_of_one_file_do_not_mix(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "clip.raw") as first, atomic_path(tmp_path / "clip.raw") as second:
        first.write_text("first")
        second.write_text("second")
    assert (tmp_path / "clip.raw").read_text() == "first"  # the last one to end
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("every", [0, 2.5])
def test_an_interval_that_is_no_number_of_steps_is_refused(every: Any) -> None:
    with pytest.raises(ValueError, match=f"every={every}: it must be an integer >= 1"):
        Checkpoint("checkpoint.pkl", every)


def test_a_value_that_cannot_be_saved_is_named_before_training() -> None:
    message = r"about\['settings'\]\['learning_rate'\]=<function .* cannot be saved in a checkpoint .*: use a plain value"
    with pytest.raises(ValueError, match=message):
        Checkpoint("checkpoint.pkl", 10, about={"settings": {"batch_size": 8, "learning_rate": lambda progress: progress}})


@pytest.fixture
def arguments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The arguments of a run that is cut off before it saves its agent. It leaves a checkpoint at step 50."""
    monkeypatch.setattr(zoo.BisimExperimentManager, "save_trained_model", lambda *_: None)
    return [
        *("train", "--env", "robust_bisim/SparseCartPole-v0", "--eval-freq", "-1", "--verbose", "0", "--n-timesteps", "60"),
        *("--log-folder", str(tmp_path), "--checkpoint", str(tmp_path / "checkpoint.pkl"), "--checkpoint-freq", "50"),
        *("-params", "learning_starts:20", "batch_size:8"),
    ]


@pytest.fixture
def command(arguments: list[str]) -> list[str]:
    """The same arguments, after a run with seed 3."""
    zoo.main([*arguments, "--seed", "3"])
    return arguments


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
    config = yaml.safe_load(zoo_config.DEFAULT_CONFIG.read_text())
    config["robust_bisim/SparseCartPole-v0"]["eval_env_kwargs"] = {"theta_rew_fraction": 0.5}
    (tmp_path / "other.yml").write_text(yaml.dump(config))
    with pytest.raises(ValueError, match=r"eval_env_kwargs is .*1\.0.* there and .*0\.5.* here"):
        zoo.main([*command, "--seed", "3", "-conf", str(tmp_path / "other.yml")])


def test_a_resumed_run_may_be_longer(command: list[str], capsys: pytest.CaptureFixture) -> None:
    zoo.main([*command, "--seed", "3", "--n-timesteps", "80"])
    assert "Going on from step 50" in capsys.readouterr().out


def test_a_moved_checkpoint_continues_in_its_new_file_and_with_the_interval_that_is_asked_for(
    command: list[str], tmp_path: Path
) -> None:
    moved = (tmp_path / "checkpoint.pkl").rename(tmp_path / "moved.pkl")
    zoo.main([*command, "--seed", "3", "--n-timesteps", "80", "--checkpoint", str(moved), "--checkpoint-freq", "20"])
    assert read_about(moved)["num_timesteps"] == 70
    assert not (tmp_path / "checkpoint.pkl").exists()


def test_the_command_line_continues_another_versions_checkpoint_in_new_episodes(
    command: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    monkeypatch.setattr("sb3_robust_bisim.runs.checkpoint._versions", lambda: {"torch": "3.0"})
    with pytest.raises(ValueError, match="not possible, because it was written with other versions"):
        zoo.main([*command, "--seed", "3"])
    zoo.main([*command, "--seed", "3", "--new-episodes"])
    printed = capsys.readouterr().out
    assert "New episodes and a new log folder, because it was written with other versions" in printed
    assert "Going on from step 50" in printed
    assert len(list(tmp_path.glob("bisim_sac/*/0.monitor.csv"))) == 2


def test_a_run_moves_to_another_device_in_new_episodes(
    command: list[str], capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    load, devices = BisimSAC.load, []
    monkeypatch.setattr(BisimSAC, "load", lambda *args, device, **kwargs: devices.append(device) or load(*args, **kwargs))
    with pytest.raises(ValueError, match="belongs to another run: device is auto there and cpu here"):
        zoo.main([*command, "--seed", "3", "--device", "cpu"])
    zoo.main([*command, "--seed", "3", "--device", "cpu", "--new-episodes"])
    printed = capsys.readouterr().out
    assert "New episodes and a new log folder, because it was written with --device auto" in printed
    assert "Going on from step 50" in printed
    assert devices == ["cpu"]


def test_the_command_line_continues_environments_in_other_processes(
    arguments: list[str], capsys: pytest.CaptureFixture
) -> None:
    for _ in range(2):
        zoo.main([*arguments, "--seed", "3", "--vec-env", "subproc"])
    assert "Going on from step 50" in capsys.readouterr().out


def test_a_checkpoint_from_a_machine_with_more_gpus_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pkl"
    save_checkpoint(path, make_model(**LEARNING), about={"name": "a"})
    about = read_about(path)
    assert (about["name"], about["gpus"]) == ("a", 0)
    with replaced(path) as file:
        pickle.dump({**about, "gpus": 99}, file)
    with pytest.raises(
        ValueError, match=r"checkpoint\.pkl: .* not possible, because it was written with 99 GPUs, here are \d"
    ):
        load_checkpoint(path)


def test_a_file_that_is_not_a_checkpoint_is_refused_by_name(command: list[str], tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pkl"
    path.write_bytes(b"PK\x03\x04 a model, say")
    with pytest.raises(ValueError, match=r"checkpoint\.pkl: this is no checkpoint.* Name another file"):
        zoo.main([*command, "--seed", "3"])
    save_checkpoint(path, make_model(**LEARNING))
    with pytest.raises(ValueError, match=r"--checkpoint .*checkpoint\.pkl: saved from Python, not by this command"):
        zoo.main([*command, "--seed", "3"])


def test_training_resumes_if_the_user_had_set_a_logger(tmp_path: Path) -> None:
    model = make_model(**LEARNING)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(40, callback=Checkpoint(tmp_path / "checkpoint.pkl", 30))
    assert load_checkpoint(tmp_path / "checkpoint.pkl")[0].learn(10, reset_num_timesteps=False).num_timesteps == 40
