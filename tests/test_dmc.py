"""The DeepMind Control Suite: every task steps, frames are exact, seeds reproduce episodes, errors name missing packages."""

import importlib.util
import os
import subprocess
import sys
import warnings
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_of_sb3
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

import sb3_robust_bisim.envs  # noqa: F401
from sb3_robust_bisim.envs import pixels
from sb3_robust_bisim.envs.distractors import ColorDistractor
from sb3_robust_bisim.envs.dmc import SUITE
from sb3_robust_bisim.envs.pixels import PixelTask

ALL_TASKS = [f"{domain}-{task}" for domain, tasks in SUITE.items() for task in tasks]
# Gymnasium's checker would like bounds on positions and velocities, which have none
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:gymnasium")


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SB3_ROBUST_BISIM_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two clips of noise. No two frames are alike."""
    paths = []
    for index in range(2):
        paths.append(tmp_path_factory.mktemp("clips") / f"{index}.mkv")
        writer = imageio_ffmpeg.write_frames(str(paths[-1]), (84, 84), codec="png", pix_fmt_out="rgb24", macro_block_size=1)
        writer.send(None)
        for frame in np.random.default_rng(index).integers(0, 256, (20, 84, 84, 3), dtype=np.uint8):
            writer.send(frame)
        writer.close()
    return paths


def make(task: str, **kwargs: Any) -> PixelTask:
    env = gym.make(f"robust_bisim/{task}-pixels-v0", **kwargs).unwrapped
    assert isinstance(env, PixelTask)
    return env


def play(env: gym.Env[Any, Any], seed: int | None, steps: int = 4) -> dict[str, np.ndarray]:
    """Observations, rewards and clean observations of the first steps of an episode. The actions are always the same."""
    observation, info = env.reset(seed=seed)
    env.action_space.seed(0)
    observations, rewards, clean = [observation], [], [info.get("clean_obs")]
    for _ in range(steps):
        observation, reward, *_, info = env.step(env.action_space.sample())
        observations.append(observation)
        rewards.append(reward)
        clean.append(info.get("clean_obs"))
    return {"observations": np.array(observations), "rewards": np.array(rewards), "clean": np.array(clean)}


def run(code: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run code in a fresh process. MUJOCO_GL and the display are unset unless they are given."""
    environment = {
        name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY")
    }
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=environment | variables, capture_output=True, text=True, timeout=120, check=False)


# The suite


def test_the_ids_are_those_of_the_suite() -> None:
    from dm_control import suite

    assert [(domain, task) for domain, tasks in SUITE.items() for task in tasks] == list(suite.ALL_TASKS)


@pytest.mark.parametrize("task", ALL_TASKS)
def test_every_task_steps_from_pixels_and_from_state_and_is_reproduced_by_a_seed(task: str) -> None:
    pixels = gym.make(f"robust_bisim/{task}-pixels-v0", distractor="color", size=32, action_repeat=1)
    frames = play(pixels, seed=1, steps=10)["observations"]
    assert frames.shape == (11, 32, 32, 3)
    assert frames.dtype == np.uint8
    assert frames.min(axis=(1, 2, 3)).max() < frames.max()
    pixels.close()
    state = gym.make(f"robust_bisim/{task}-v0")
    first, second = play(state, seed=1, steps=10), play(state, seed=1, steps=10)
    state.close()
    assert first["observations"].dtype == np.float32
    assert first["observations"][-1] in state.observation_space
    for key in ("observations", "rewards"):
        np.testing.assert_array_equal(first[key], second[key])


def test_a_task_whose_model_is_drawn_at_random_is_reproduced_by_a_seed_too() -> None:
    first, second = (play(gym.make("robust_bisim/lqr-lqr_6_2-v0"), seed=1)["observations"] for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(
    ("task", "repeat", "steps"), [("cartpole-swingup", 4, 250), ("pendulum-swingup", 3, 334), ("lqr-lqr_2_1", 8, 125)]
)
def test_an_episode_is_truncated_after_1000_control_steps(task: str, repeat: int, steps: int) -> None:
    env = gym.make(f"robust_bisim/{task}-v0", action_repeat=repeat)
    env.reset(seed=0)
    idle = 0 * env.action_space.sample()
    ends = [env.step(idle)[2:4] for _ in range(steps)]
    assert ends == [(False, False)] * (steps - 1) + [(False, True)]
    with pytest.raises(ResetNeeded, match="The episode is over: call reset"):
        env.step(env.action_space.sample())
    env.reset()
    env.step(env.action_space.sample())


def test_a_pixel_episode_is_truncated_after_1000_control_steps() -> None:
    env = make("pendulum-swingup", distractor="noise", action_repeat=50, size=8)
    env.reset(seed=0)
    assert [env.step(env.action_space.high)[3] for _ in range(20)] == [False] * 19 + [True]


def test_an_action_is_repeated_and_its_rewards_are_added_up() -> None:
    once, thrice = (gym.make("robust_bisim/reacher-easy-v0", action_repeat=repeat) for repeat in (1, 3))
    once.reset(seed=3), thrice.reset(seed=3)
    for _ in range(20):
        action = once.action_space.sample()
        singles = [once.step(action) for _ in range(3)]
        observation, reward, *_ = thrice.step(action)
        np.testing.assert_array_equal(observation, singles[-1][0])
        assert reward == pytest.approx(sum(float(single[1]) for single in singles))


def test_actions_cover_the_whole_range_of_every_actuator() -> None:
    env = make("quadruped-walk", distractor="color", size=8)  # its actuators move in [-1, 1.1] and [-0.8, 0.8]
    low, high = env.physics.model.actuator_ctrlrange.T
    assert high.max() > 1
    assert env.action_space == gym.spaces.Box(-1, 1, (12,), np.float32)
    for action, expected in ((env.action_space.low, low), (env.action_space.high, high)):
        env.reset(seed=0)
        env.step(action)
        np.testing.assert_allclose(env.physics.control(), expected)


def test_an_action_that_is_not_a_number_is_refused() -> None:
    env = gym.make("robust_bisim/pendulum-swingup-v0")
    env.reset()
    with pytest.raises(ValueError, match="action must hold finite numbers"):
        env.step(np.array([np.nan], dtype=np.float32))


def test_the_state_is_one_vector_to_which_noise_is_appended() -> None:
    plain = gym.make("robust_bisim/walker-walk-v0", action_repeat=2)  # its height has the shape ()
    noisy = gym.make("robust_bisim/walker-walk-v0", action_repeat=2, noise_multiplier=2, noise_std=5.0)
    assert plain.observation_space.shape == (24,)
    assert noisy.observation_space.shape == (72,)
    clean, distracted = play(plain, seed=1)["observations"], play(noisy, seed=1)["observations"]
    np.testing.assert_array_equal(distracted[:, :24], clean)
    assert 4 < distracted[:, 24:].std() < 6


def test_state_and_noise_can_be_mixed_by_a_random_projection() -> None:
    kwargs: dict[str, Any] = dict(noise_multiplier=1, noise_mean=2.0)
    plain = gym.make("robust_bisim/walker-walk-v0", **kwargs)
    mixed = gym.make("robust_bisim/walker-walk-v0", random_projection=True, **kwargs)
    matrix = mixed.get_wrapper_attr("projection")
    assert mixed.observation_space == gym.spaces.Box(-np.inf, np.inf, (48,), np.float32)
    first, second = play(plain, seed=1), play(mixed, seed=1)
    np.testing.assert_allclose(second["observations"], first["observations"] @ matrix.T, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(second["rewards"], first["rewards"])
    with pytest.raises(ValueError, match="projection_seed must be an integer >= 0"):
        gym.make("robust_bisim/walker-walk-v0", projection_seed=-1)


def test_environments_without_a_seed_differ() -> None:
    envs = [gym.make("robust_bisim/reacher-easy-v0") for _ in range(2)]
    assert not np.array_equal(envs[0].reset()[0], envs[1].reset()[0])


# Frames


@pytest.mark.parametrize("task", ["cheetah-run", "reacher-easy", "quadruped-fetch"])
def test_a_frame_without_distractor_equals_that_of_dm_control(task: str) -> None:
    from dm_control import suite

    env = make(task, render_mode="rgb_array", render_size=120)
    stock = suite.load(*task.split("-"), task_kwargs={"random": 0})
    env.reset(seed=1)
    stock.task._random = np.random.RandomState(1)
    stock.reset()
    camera = env.camera_id
    for _ in range(3):
        action = 0.5 * env.action_space.high
        observation = env.step(action)[0]
        low, high = stock.action_spec().minimum, stock.action_spec().maximum
        for _ in range(env.action_repeat):
            stock.step((low + high) / 2 + (high - low) / 2 * action)
        np.testing.assert_array_equal(observation, stock.physics.render(84, 84, camera_id=camera))
        assert observation.flags["C_CONTIGUOUS"]
    np.testing.assert_array_equal(env.render(), stock.physics.render(120, 120, camera_id=camera))


@pytest.mark.parametrize("task", ["cartpole-swingup", "finger-spin", "reacher-easy", "cheetah-run", "fish-swim"])
def test_the_background_fills_exactly_the_pixels_without_objects(task: str) -> None:
    env = make(task, distractor="color", render_mode="rgb_array", render_size=84)
    assert isinstance(env.distraction.background, ColorDistractor)
    model = env.physics.model
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(4):
        env.step(env.action_space.sample())
        frames = []
        for shade in (0, 255):
            env.distraction.background.paint(np.full(3, shade, dtype=np.uint8))
            frames.append(np.asarray(env.render()))
        replaced = (frames[0] != frames[1]).any(-1)
        assert (frames[0][replaced] == 0).all()
        assert (frames[1][replaced] == 255).all()
        ids, types = np.moveaxis(env.physics.render(84, 84, camera_id=env.camera_id, segmentation=True), -1, 0)
        plane = (types == 5) & (model.geom_type[ids] == 0)  # mjOBJ_GEOM and mjGEOM_PLANE
        background = (ids == -1) | plane
        assert not (replaced & ~background).any()
        assert (replaced != background).sum() <= 1  # a foot that sank into the ground, which is not drawn


def test_the_ground_reappears_for_other_cameras() -> None:
    env = make("cheetah-run", distractor="color", clean_obs=True)
    _, info = env.reset(seed=0)
    np.testing.assert_array_equal(info["clean_obs"], env.physics.render(84, 84, camera_id=0))


def test_render_shows_the_distractor_at_any_size() -> None:
    env = make("cheetah-run", distractor="noise", render_mode="rgb_array", render_size=168)
    observation, _ = env.reset(seed=0)
    picture = env.render()
    assert picture is not None
    assert picture.shape == (168, 168, 3)
    np.testing.assert_array_equal(picture[:40:2, :40:2], observation[:20, :20])
    np.testing.assert_array_equal(picture[1:40:2, 1:40:2], observation[:20, :20])
    assert env.metadata["render_fps"] == 25  # 0.01 s per control step, four of which make a step


@pytest.mark.parametrize("gpu", [True, False])
def test_without_a_gpu_shadows_are_said_to_be_slow(gpu: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pixels, "has_gpu", lambda: gpu)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for kwargs in ({}, {"shadows": False}, {"distractor": "color"}):
            make("cheetah-run", **kwargs).close()
    assert sum("shadows=False draws" in str(warning.message) for warning in caught) == (0 if gpu else 1)


def test_frames_without_shadows_still_show_sky_and_ground() -> None:
    stock, fast = (play(make("cartpole-swingup", shadows=shadows), seed=0)["observations"] for shadows in (True, False))
    difference = np.abs(stock.astype(int) - fast)
    assert 0 < difference.mean() < 3


# Distractors in the environment


@pytest.mark.parametrize("distractor", ["color", "noise", "images", "video", "balls"])
def test_a_seed_reproduces_the_frames_and_the_clean_frame_shows_the_task(distractor: str, clips: list[Path]) -> None:
    files = clips if distractor in ("images", "video") else None
    shadows = distractor == "video"  # with them, the clean frame comes from another OpenGL context
    runs = []
    for seed in (1, 1, 2):
        env = make("reacher-easy", distractor=distractor, distractor_files=files, clean_obs=True, shadows=shadows)
        runs.append(play(env, seed))
        env.close()
    clean = play(make("reacher-easy", clean_obs=True, shadows=shadows), seed=1)
    np.testing.assert_array_equal(runs[0]["observations"], runs[1]["observations"])
    assert (runs[0]["observations"][0] != runs[2]["observations"][0]).any(-1).mean() > 0.05
    np.testing.assert_array_equal(runs[0]["clean"], clean["observations"])
    np.testing.assert_array_equal(clean["clean"], clean["observations"])
    np.testing.assert_array_equal(runs[0]["rewards"], clean["rewards"])
    background = runs[0]["observations"][:, :5, :5]
    moves = [(now != before).any() for before, now in pairwise(background)]
    assert distractor == "balls" or moves == [distractor in ("noise", "video")] * 4


def test_training_and_evaluation_show_different_clips() -> None:
    backgrounds = {
        split: make("pendulum-swingup", distractor="video", split=split).distraction.background for split in ("train", "eval")
    }
    paths = {split: background.paths for split, background in backgrounds.items()}  # type: ignore[union-attr]
    assert len(paths["train"]) == 2
    assert len(paths["eval"]) == 1
    assert not set(paths["train"]) & set(paths["eval"])


@pytest.mark.parametrize(
    "kwargs", [{"shadows": False}, {"distractor": "video", "clean_obs": True, "render_mode": "rgb_array"}]
)
def test_the_environment_keeps_the_contracts_of_gymnasium_and_sb3(kwargs: dict[str, Any]) -> None:
    env = gym.make("robust_bisim/point_mass-easy-pixels-v0", **kwargs)
    check_env(env.unwrapped)
    check_env_of_sb3(env)
    check_env_of_sb3(gym.make("robust_bisim/point_mass-easy-v0"))


def test_several_environments_in_one_process_stack_their_frames() -> None:
    def build() -> gym.Env[Any, Any]:
        return gym.make("robust_bisim/cartpole-balance-pixels-v0", distractor="video", action_repeat=250)

    stacked = VecFrameStack(DummyVecEnv([build] * 3), n_stack=3)
    stacked.seed(0)
    observations = np.asarray(stacked.reset())
    assert observations.shape == (3, 84, 84, 9)
    for step in range(1, 9):
        stacked_frames, _, dones, infos = stacked.step(np.zeros((3, 1), dtype=np.float32))
        assert dones.all() == dones.any() == (step % 4 == 0)
        assert all(info.get("TimeLimit.truncated", False) == done for info, done in zip(infos, dones, strict=True))
    observations = np.asarray(stacked_frames)
    assert (observations[0] != observations[1]).any()
    stacked.close()


# What goes wrong


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"size": 0}, r"size must be an integer in \[1, 4096\], got 0"),
        ({"size": 84.0}, "size must be an integer"),
        ({"size": True}, "size must be an integer"),
        ({"render_size": 5000}, "render_size must be an integer"),
        ({"action_repeat": 0}, "action_repeat must be an integer"),
        ({"camera_id": 2}, r"camera_id must be a number in \[0, 1\] or one of \['fixed', 'lookatcart'\], got 2"),
        ({"camera_id": "side"}, "camera_id must be .*'side'"),
        ({"distractor": "vidoe"}, "distractor must be one of"),
        ({"split": "test"}, "split must be 'train' or 'eval'"),
        ({"distractor_files": "clips"}, "distractor_files is only for"),
        ({"distractor": "video", "distractor_files": "no_such.mp4"}, r"distractor_files names 'no_such\.mp4'"),
        ({"render_mode": "depth"}, "render_mode must be None or 'rgb_array'"),
    ],
)
def test_a_bad_argument_is_named_when_the_environment_is_built(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make("cartpole-swingup", **arguments)


def test_a_corrupt_clip_is_named_when_the_environment_is_built(tmp_path: Path, clips: list[Path]) -> None:
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"no video" * 100)
    with pytest.raises(ValueError, match=r"broken\.mp4.*ffmpeg cannot decode"):
        make("cartpole-swingup", distractor="video", distractor_files=[broken, *clips])


MAKE_STATE_AND_PIXELS = """
import gymnasium as gym, sb3_robust_bisim.envs
gym.make("robust_bisim/cartpole-swingup-v0").reset(seed=0); print("state")
env = gym.make("robust_bisim/cartpole-swingup-pixels-v0", distractor="color", size=8); env.reset(seed=0); print("pixels")
"""


def test_state_tasks_work_without_opengl_and_pixel_tasks_say_what_to_install() -> None:
    done = run("import ctypes.util; ctypes.util.find_library = lambda name: None\n" + MAKE_STATE_AND_PIXELS)
    assert done.stdout == "state\n"
    assert "RuntimeError: Drawing frames needs OpenGL" in done.stderr  # not that MUJOCO_GL disables it: nobody set that
    assert "apt-get install libegl1" in done.stderr


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ("", "neither libEGL nor libOSMesa is installed"),
        ("osmesa", "MUJOCO_GL=osmesa needs the library libOSMesa, which is missing"),
        ("disable", "MUJOCO_GL=disable disables drawing"),
    ],
)
def test_the_error_says_why_nothing_can_be_rendered(monkeypatch: pytest.MonkeyPatch, wanted: str, message: str) -> None:
    monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    monkeypatch.setenv("MUJOCO_GL", wanted)
    with pytest.raises(RuntimeError, match=f"{message}.*apt-get install"):
        make("cartpole-swingup")


def test_the_error_for_a_backend_that_cannot_render_says_what_to_install() -> None:
    done = run(MAKE_STATE_AND_PIXELS, MUJOCO_GL="glfw")  # without a display
    assert done.stdout == "state\n"
    assert "RuntimeError: dm_control cannot draw with MUJOCO_GL=glfw" in done.stderr


def test_the_error_names_the_packages_that_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in ("mujoco", "shimmy") else find(name))
    message = r"DeepMind Control needs mujoco, shimmy: install it with `pip install sb3_robust_bisim\[dmc\]`"
    with pytest.raises(ImportError, match=message):
        make("cartpole-swingup")


def test_tasks_work_after_an_earlier_import_of_dm_control() -> None:
    done = run("import dm_control.suite\n" + MAKE_STATE_AND_PIXELS)
    assert done.stdout == "state\npixels\n", done.stderr


def test_the_ids_are_registered_without_importing_anything_of_the_extra() -> None:
    code = """
import sys
import warnings
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("mujoco", "dm_control", "shimmy", "imageio_ffmpeg", "skvideo"):
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Missing())
import gymnasium, sb3_robust_bisim
print(sum(id.startswith("robust_bisim/") for id in gymnasium.registry))
gymnasium.make("robust_bisim/cheetah-run-pixels-v0")
"""
    done = run(code)
    assert int(done.stdout) >= 2 * len(ALL_TASKS)
    assert "No module named 'torch" not in done.stderr
