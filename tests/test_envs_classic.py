"""The Gym tasks of the paper: their rewards, dynamics, noise and use inside Gymnasium and SB3."""

import copy
import math
import pickle
import subprocess
import sys
import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_robust_bisim.envs import NoiseObservation

CARTPOLE = "robust_bisim/SparseCartPole-v0"
PENDULUM = "robust_bisim/SparsePendulum-v0"
MOUNTAIN_CAR = "robust_bisim/MountainCarContinuous-v0"
STATE_SIZE = {CARTPOLE: 4, PENDULUM: 3, MOUNTAIN_CAR: 2}
THETA_LIMIT, X_LIMIT = 12 * 2 * math.pi / 360, 2.4  # 12 deg in the rounding of Gymnasium

every_task = pytest.mark.parametrize("env_id", STATE_SIZE)
every_noise = pytest.mark.parametrize(
    "kwargs",
    [{}, {"noise_multiplier": 2}, {"noise_multiplier": 2, "random_projection": True, "projection_seed": 3, "noise_mean": 1.0}],
    ids=["clean", "noisy", "projected"],
)


@pytest.fixture(autouse=True)
def no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets pygame open its "human" windows nowhere."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


@pytest.fixture
def no_warning() -> Iterator[None]:
    """
    Turns every warning into an error, but for three pieces of the checkers' advice that a task of the paper cannot follow:
    CartPole's velocities and Gaussian noise are unbounded, Pendulum's action is a torque of up to 2 N m, and a made
    environment is a wrapped one.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        advice = (
            ".*observation space (minimum|maximum) value is -?infinity",
            ".*we recommend using a symmetric and normalized space|We recommend you to use a symmetric and normalized Box",
            ".*is different from the unwrapped version",
        )
        for message in advice:
            warnings.filterwarnings("ignore", message=message)
        yield


def action_of(value: float) -> np.ndarray:
    return np.array([value], dtype=np.float64)


def bounds(space: gym.Space) -> tuple[np.ndarray, np.ndarray]:
    assert isinstance(space, gym.spaces.Box)
    return space.low, space.high


def reward_after(env: gym.Env, state: list[float], action: float = 0.0) -> tuple[float, bool]:
    """Reward and termination of one step from a given physical state."""
    env.reset(seed=0)
    env.set_wrapper_attr("state", np.array(state))
    _, reward, terminated, _, _ = env.step(action_of(action))
    return float(reward), terminated


def episode(env: gym.Env, seed: int, steps: int = 30) -> tuple[np.ndarray, list[float]]:
    """Observations (steps + 1, n) and rewards of an episode with this seed. The small actions depend only on the step."""
    observations, rewards = [env.reset(seed=seed)[0]], []
    for step in range(steps):
        observation, reward, terminated, truncated, _ = env.step(action_of(0.1 * math.sin(step)).astype(np.float32))
        observations.append(observation)
        rewards.append(float(reward))
        if terminated or truncated:
            break
    return np.stack(observations), rewards


# Rewards


@pytest.mark.parametrize(
    ("x", "theta", "expected"),
    [
        (0.0, 0.0, 1.0),
        (0.0, 0.01 * THETA_LIMIT, 1.0),
        (0.0, -0.01 * THETA_LIMIT, 1.0),
        (0.0, 0.0101 * THETA_LIMIT, 0.0),
        (0.0, -0.0101 * THETA_LIMIT, 0.0),
        (0.01 * X_LIMIT, 0.0, 1.0),
        (-0.01 * X_LIMIT, 0.0, 1.0),
        (0.0101 * X_LIMIT, 0.0, 0.0),
        (-0.0101 * X_LIMIT, 0.0, 0.0),
        (0.5 * X_LIMIT, 0.5 * THETA_LIMIT, 0.0),
    ],
)
def test_sparse_cartpole_pays_only_within_a_hundredth_of_both_ranges(x: float, theta: float, expected: float) -> None:
    # at rest, one Euler step leaves position and angle where they are
    assert reward_after(gym.make(CARTPOLE), [x, 0.0, theta, 0.0]) == (expected, False)


def test_cartpole_pays_one_for_the_failing_step_at_every_fraction_and_nothing_beyond() -> None:
    for fraction in (0.01, 1.0):
        env = gym.make(CARTPOLE, theta_rew_fraction=fraction)
        assert reward_after(env, [0.0, 0.0, 0.99 * THETA_LIMIT, 3.0]) == (1.0, True)
        with pytest.warns(UserWarning, match="already returned terminated"):
            assert env.step(action_of(0.0))[1] == 0.0


def test_cartpole_can_leave_the_position_out_of_the_reward_as_the_papers_text_does() -> None:
    env = gym.make(CARTPOLE, x_rew_fraction=1.0)
    assert reward_after(env, [2.0, 0.0, 0.0, 0.0]) == (1.0, False)
    assert reward_after(env, [2.0, 0.0, 0.02 * THETA_LIMIT, 0.0]) == (0.0, False)


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("turns", [0, 3])
def test_pendulum_pays_for_the_wrapped_angle_that_a_step_leads_to(sign: int, turns: int) -> None:
    env = gym.make(PENDULUM, tolerance_degrees=5.0)
    for degrees, expected in ((0.0, 1.0), (4.5, 1.0), (5.5, 0.0), (90.0, 0.0), (180.0, 0.0)):
        # 20 deg earlier, moving at the speed that (with gravity) covers them in one step of 0.05 s
        end, start = math.radians(sign * degrees), math.radians(sign * (degrees + 20))
        speed = (end - start) / 0.05 - 15 * math.sin(start) * 0.05
        assert reward_after(env, [start + 2 * math.pi * turns, speed]) == (expected, False)
        assert math.isclose(env.get_wrapper_attr("state")[0], end + 2 * math.pi * turns, abs_tol=1e-9)


def test_pendulum_tolerance_defaults_to_one_degree() -> None:
    env = gym.make(PENDULUM)
    # at rest and nearly upright, gravity moves the pole by 4 % of its angle in one step
    assert reward_after(env, [math.radians(0.9), 0.0])[0] == 1.0
    assert reward_after(env, [math.radians(1.0), 0.0])[0] == 0.0


# Dynamics, against Gymnasium's own


def test_standard_cartpole_equals_gymnasiums_under_the_same_forces() -> None:
    ours = gym.make(CARTPOLE, theta_rew_fraction=1.0)
    theirs = gym.make("CartPole-v1", max_episode_steps=200)
    lengths = set()
    for seed in range(20):
        np.testing.assert_array_equal(ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0])
        rng, steps, done = np.random.default_rng(seed), 0, False
        while not done:
            _, _, theta, theta_dot = theirs.get_wrapper_attr("state")
            right = int(theta + theta_dot > 0) if seed % 2 else int(rng.integers(2))  # a good policy and a random one
            mine, reference = ours.step(action_of((2 * right - 1) / 3)), theirs.step(right)  # 30 N / 3 = CartPole's 10 N
            np.testing.assert_array_equal(mine[0], reference[0])
            assert mine[1:] == reference[1:]
            steps, done = steps + 1, mine[2] or mine[3]
        lengths.add(steps)
    assert 200 in lengths
    assert min(lengths) < 50


def test_a_full_push_is_thirty_newtons_and_the_force_is_continuous() -> None:
    accelerations = []
    for action in (-1.0, -0.25, 0.0, 0.5, 1.0):
        env = gym.make(CARTPOLE)
        env.reset(seed=0)
        env.set_wrapper_attr("state", np.zeros(4))
        env.step(action_of(action))
        accelerations.append(env.get_wrapper_attr("state")[1] / 0.02)
    # Newton for a cart of 1 kg with an upright pole of 0.1 kg and half-length 0.5 m: F / (M + m / 4)
    np.testing.assert_allclose(accelerations, 30 * np.array([-1.0, -0.25, 0.0, 0.5, 1.0]) / 1.025, atol=1e-9)


@pytest.mark.parametrize(("env_id", "reference_id"), [(PENDULUM, "Pendulum-v1"), (MOUNTAIN_CAR, "MountainCarContinuous-v0")])
def test_pendulum_and_mountain_car_move_as_gymnasiums_do(env_id: str, reference_id: str) -> None:
    ours, theirs = gym.make(env_id), gym.make(reference_id)
    np.testing.assert_array_equal(ours.reset(seed=5)[0], theirs.reset(seed=5)[0])
    theirs.action_space.seed(5)
    for _ in range(150):
        action = 1.5 * theirs.action_space.sample()  # beyond the space now and then
        mine, reference = ours.step(action), theirs.step(action)
        np.testing.assert_array_equal(mine[0], reference[0])
        assert mine[2:] == reference[2:]
        if env_id == MOUNTAIN_CAR:
            assert mine[1] == reference[1]


def test_mountain_car_is_solved_above_ninety_by_swinging_up() -> None:
    env = gym.make(MOUNTAIN_CAR)
    observation, total, done = env.reset(seed=1)[0], 0.0, False
    while not done:
        observation, reward, terminated, truncated, _ = env.step(action_of(math.copysign(0.9, observation[1])))
        total, done = total + float(reward), terminated or truncated
    assert env.spec is not None
    assert env.spec.reward_threshold == 90.0
    assert total > env.spec.reward_threshold


@pytest.mark.parametrize(("env_id", "limit"), [(CARTPOLE, 200), (PENDULUM, 200), (MOUNTAIN_CAR, 999)])
def test_an_episode_is_truncated_at_the_tasks_limit(env_id: str, limit: int) -> None:
    env = gym.make(env_id, noise_multiplier=1)
    env.reset(seed=0)
    for step in range(1, limit + 1):
        if env_id == CARTPOLE:
            env.set_wrapper_attr("state", np.zeros(4))  # holds the pole up
        _, _, terminated, truncated, _ = env.step(action_of(0.0))
        assert (terminated, truncated) == (False, step == limit)


@every_task
def test_actions_beyond_the_space_act_like_its_bounds(env_id: str) -> None:
    bounded, beyond = gym.make(env_id), gym.make(env_id)
    bounded.reset(seed=0)
    beyond.reset(seed=0)
    np.testing.assert_array_equal(bounded.step(bounds(bounded.action_space)[1])[0], beyond.step(action_of(7.0))[0])


@every_task
@pytest.mark.parametrize("action", [[np.nan], [np.inf], [0.1, 0.2], 0.1])
def test_an_action_that_is_not_one_finite_number_is_refused(env_id: str, action: Any) -> None:
    env = gym.make(env_id)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action must hold one finite number"):
        env.step(np.array(action, dtype=np.float32))


# Noise


@every_task
def test_noise_extends_the_observation_and_does_not_change_the_trajectory(env_id: str) -> None:
    size = STATE_SIZE[env_id]
    clean, clean_rewards = episode(gym.make(env_id), seed=11)
    for noise_multiplier in (1, 2, 10):
        env = gym.make(env_id, noise_multiplier=noise_multiplier)
        noisy, rewards = episode(env, seed=11)
        assert noisy.shape == (len(clean), (1 + noise_multiplier) * size)
        assert noisy.dtype == np.float32
        np.testing.assert_array_equal(noisy[:, :size], clean)
        assert rewards == clean_rewards
        assert env.observation_space.dtype == np.float32
        low, high = bounds(env.observation_space)
        np.testing.assert_array_equal([low[:size], high[:size]], bounds(gym.make(env_id).observation_space))
        assert np.all(high[size:] == np.inf)
        assert np.all(low[size:] == -np.inf)


@every_task
def test_without_noise_no_wrapper_is_added(env_id: str) -> None:
    assert "NoiseObservation" not in str(gym.make(env_id, noise_multiplier=0))


@every_task
def test_a_seed_fixes_noise_and_states_and_another_seed_changes_them(env_id: str) -> None:
    env = gym.make(env_id, noise_multiplier=2)
    first, again, other = episode(env, seed=3)[0], episode(env, seed=3)[0], episode(env, seed=4)[0]
    np.testing.assert_array_equal(first, again)
    assert not np.isin(other[:, STATE_SIZE[env_id] :], first).any()
    # a reset without a seed continues the noise
    assert not np.isin(env.reset()[0][STATE_SIZE[env_id] :], other).any()


def test_noise_is_white_standard_normal_and_scales_with_its_deviation() -> None:
    env = gym.make(PENDULUM, noise_multiplier=4, max_episode_steps=5000)
    noise = episode(env, seed=0, steps=5000)[0][:, 3:]
    # 60,000 numbers: the standard errors of mean, deviation and fourth moment are 0.004, 0.003 and 0.04
    assert abs(noise.mean()) < 0.02
    assert abs(noise.std() - 1.0) < 0.015
    assert abs((noise**4).mean() - 3.0) < 0.2
    correlation = np.corrcoef(np.hstack([noise[1:], noise[:-1]]), rowvar=False)  # between numbers, and with the step before
    assert np.abs(correlation - np.eye(24)).max() < 0.07
    scaled = episode(gym.make(PENDULUM, noise_multiplier=4, noise_std=2.5), seed=0)[0][:, 3:]
    np.testing.assert_allclose(scaled, 2.5 * noise[: len(scaled)], rtol=1e-6)
    assert not episode(gym.make(PENDULUM, noise_multiplier=4, noise_std=0.0), seed=0)[0][:, 3:].any()


def test_noise_and_environment_draw_from_different_random_streams() -> None:
    env = gym.make(PENDULUM, noise_multiplier=4)
    noise = env.reset(seed=9)[0][3:]
    for reference in (np.random.default_rng(9), np.random.default_rng(np.random.SeedSequence(9).spawn(1)[0])):
        assert not np.isin(noise, reference.normal(size=100).astype(np.float32)).any()


def test_the_mean_of_the_noise_shifts_the_noise_and_nothing_else() -> None:
    centred = episode(gym.make(PENDULUM, noise_multiplier=2, noise_std=0.5), seed=0)[0]
    shifted = episode(gym.make(PENDULUM, noise_multiplier=2, noise_std=0.5, noise_mean=-3.0), seed=0)[0]
    np.testing.assert_array_equal(shifted[:, :3], centred[:, :3])
    np.testing.assert_allclose(shifted[:, 3:], centred[:, 3:] - 3.0, atol=1e-6)


@pytest.mark.parametrize("random_projection", [False, True])
def test_a_second_look_shows_the_same_state_under_new_noise(random_projection: bool) -> None:
    env = gym.make(PENDULUM, noise_multiplier=1, random_projection=random_projection)
    look, projection = env.get_wrapper_attr("look"), env.get_wrapper_attr("projection")
    with pytest.raises(ResetNeeded, match="call reset"):
        look()
    env.reset(seed=0)
    for _ in range(3):
        looks = np.stack([env.step(action_of(1.0))[0], look(), look()]).astype(np.float64)
        if random_projection:
            looks = np.linalg.solve(projection, looks.T).T
        np.testing.assert_allclose(looks[:, :3], looks[:1, :3].repeat(3, axis=0), atol=1e-5)
        assert np.unique(looks[:, 3:].round(4)).size == 9
        theta, speed = env.get_wrapper_attr("state")
        np.testing.assert_allclose(looks[0, :3], [math.cos(theta), math.sin(theta), speed], atol=1e-5)


def test_noise_keeps_the_float_type_of_other_environments() -> None:
    space = gym.spaces.Box(-1.0, 1.0, (5,), np.float64)
    env = NoiseObservation(gym.wrappers.TransformObservation(gym.make(PENDULUM), lambda _: np.zeros(5), space), 3)
    assert env.reset(seed=0)[0].dtype == env.observation_space.dtype == np.float64
    assert env.reset(seed=0)[0] in env.observation_space


@pytest.mark.parametrize(
    "space",
    [gym.spaces.Box(0.0, 1.0, (2, 2)), gym.spaces.Box(0, 255, (4,), np.uint8), gym.spaces.Discrete(3)],
    ids=["matrix", "bytes", "discrete"],
)
def test_noise_refuses_what_is_not_a_vector_of_floats(space: gym.Space) -> None:
    env = gym.wrappers.TransformObservation(gym.make(PENDULUM), lambda _: space.sample(), space)
    with pytest.raises(ValueError, match=r"env must have a Box observation space of shape \(n,\) and a float dtype"):
        NoiseObservation(env, 1)


# Random projection


@every_task
@pytest.mark.parametrize("noise_multiplier", [0, 2])
def test_a_projection_mixes_all_numbers_and_does_not_change_states_and_noise(env_id: str, noise_multiplier: int) -> None:
    plain, rewards = episode(gym.make(env_id, noise_multiplier=noise_multiplier), seed=11)
    env = gym.make(env_id, noise_multiplier=noise_multiplier, random_projection=True)
    mixed, mixed_rewards = episode(env, seed=11)
    size = (1 + noise_multiplier) * STATE_SIZE[env_id]
    matrix = env.get_wrapper_attr("projection")
    assert matrix.shape == (size, size)
    assert mixed.dtype == np.float32
    np.testing.assert_allclose(mixed, plain @ matrix.T, rtol=1e-5, atol=1e-5)
    assert mixed_rewards == rewards
    assert env.observation_space == gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)


def test_the_entries_of_a_projection_are_standard_normal_and_its_rank_is_full() -> None:
    matrix = gym.make(PENDULUM, noise_multiplier=99, random_projection=True).get_wrapper_attr("projection")
    # 90,000 numbers: the standard errors of mean, deviation and fourth moment are 0.003, 0.002 and 0.03
    assert abs(matrix.mean()) < 0.015
    assert abs(matrix.std() - 1.0) < 0.01
    assert abs((matrix**4).mean() - 3.0) < 0.15
    assert np.linalg.matrix_rank(matrix) == 300


def test_a_nearly_singular_matrix_is_drawn_again(monkeypatch: pytest.MonkeyPatch) -> None:
    first = gym.make(CARTPOLE, random_projection=True).get_wrapper_attr("projection")
    limit = np.linalg.cond(first) / 1.5
    monkeypatch.setattr("sb3_robust_bisim.envs.noise._LARGEST_CONDITION", limit)
    assert np.linalg.cond(gym.make(CARTPOLE, random_projection=True).get_wrapper_attr("projection")) <= limit


def test_another_projection_seed_gives_another_matrix_and_a_reset_keeps_the_matrix() -> None:
    env = gym.make(CARTPOLE, noise_multiplier=1, random_projection=True)
    before = env.get_wrapper_attr("projection").copy()
    for seed in (0, 1, None):
        env.reset(seed=seed)
        np.testing.assert_array_equal(env.get_wrapper_attr("projection"), before)
    other = gym.make(CARTPOLE, noise_multiplier=1, random_projection=True, projection_seed=1)
    assert not np.isin(other.get_wrapper_attr("projection"), before).any()


def test_training_evaluation_and_workers_share_the_projection() -> None:
    kwargs = {"noise_multiplier": 1, "random_projection": True}
    training = make_vec_env(CARTPOLE, n_envs=2, seed=1, env_kwargs=kwargs)
    evaluation = make_vec_env(CARTPOLE, n_envs=1, seed=5, env_kwargs={**kwargs, "theta_rew_fraction": 1.0, "noise_mean": 2.0})
    workers = make_vec_env(f"sb3_robust_bisim.envs:{CARTPOLE}", n_envs=2, seed=7, env_kwargs=kwargs, vec_env_cls=SubprocVecEnv)
    try:
        first, *others = (matrix for venv in (training, evaluation, workers) for matrix in venv.get_attr("projection"))
        assert len(others) == 4
        for matrix in others:
            np.testing.assert_array_equal(matrix, first)
    finally:
        workers.close()


def test_a_later_process_sees_the_same_projection() -> None:
    script = (
        "import gymnasium, sb3_robust_bisim.envs; "
        f"env = gymnasium.make({CARTPOLE!r}, noise_multiplier=1, random_projection=True); "
        "print(*env.reset(seed=3)[0])"
    )
    printed = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True).stdout
    here = gym.make(CARTPOLE, noise_multiplier=1, random_projection=True).reset(seed=3)[0]
    np.testing.assert_allclose(np.array(printed.split(), dtype=np.float32), here, rtol=1e-6)


def test_the_projection_of_a_seed_is_that_of_earlier_releases() -> None:
    # an agent that was saved with them needs it
    matrix = gym.make(CARTPOLE, random_projection=True).get_wrapper_attr("projection")
    np.testing.assert_allclose(matrix[0], [0.0286583, -1.6360048, -0.40640808, -0.33081501], rtol=1e-6)


@pytest.mark.parametrize("copier", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["deepcopy", "pickle"])
def test_a_copied_environment_keeps_its_own_projection(copier: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    env = gym.make(CARTPOLE, noise_multiplier=1, random_projection=True)
    env.reset(seed=0)
    # what is drawn from the seed today may not be what the environment was made with
    monkeypatch.setattr("sb3_robust_bisim.envs.noise._draw_projection", lambda size, seed: np.zeros((size, size)))
    twin = copier(env)
    np.testing.assert_array_equal(twin.get_wrapper_attr("projection"), env.get_wrapper_attr("projection"))
    np.testing.assert_array_equal(twin.get_wrapper_attr("look")(), env.get_wrapper_attr("look")())
    np.testing.assert_array_equal(twin.step(action_of(0.1))[0], env.step(action_of(0.1))[0])


# Arguments


@every_task
@pytest.mark.parametrize(
    "kwargs",
    [
        {"noise_multiplier": -1},
        {"noise_multiplier": 1.0},
        {"noise_multiplier": True},
        {"noise_multiplier": "2"},
        {"noise_multiplier": None},
        {"noise_std": -0.1},
        {"noise_std": math.nan},
        {"noise_std": math.inf, "noise_multiplier": 1},
        {"noise_std": "1e-2"},
        {"noise_mean": math.nan},
        {"noise_mean": -math.inf, "noise_multiplier": 1},
        {"noise_mean": "0"},
        {"random_projection": 1},
        {"random_projection": "yes"},
        {"projection_seed": -1},
        {"projection_seed": 0.5},
        {"projection_seed": None, "random_projection": True},
    ],
    ids=str,
)
def test_bad_noise_arguments_are_named(env_id: str, kwargs: dict[str, Any]) -> None:
    name, value = next(iter(kwargs.items()))
    with pytest.raises(ValueError, match=f"{name} must be .*, got {value!r}"):
        gym.make(env_id, **kwargs)


@pytest.mark.parametrize("value", [0.0, -0.5, 1.0001, math.nan, "1e-2"])
@pytest.mark.parametrize("name", ["theta_rew_fraction", "x_rew_fraction"])
def test_cartpole_fractions_outside_zero_to_one_are_refused(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"{name} must lie in \(0, 1\]"):
        gym.make(CARTPOLE, **{name: value})


@pytest.mark.parametrize("value", [0.0, -1.0, 181.0, math.nan, math.inf, None])
def test_pendulum_tolerances_that_are_not_angles_are_refused(value: Any) -> None:
    with pytest.raises(ValueError, match=r"tolerance_degrees must lie in \(0, 180\]"):
        gym.make(PENDULUM, tolerance_degrees=value)


def test_arguments_of_another_task_are_refused() -> None:
    with pytest.raises(TypeError, match="tolerance_degrees"):
        gym.make(MOUNTAIN_CAR, tolerance_degrees=1.0)


# Life inside Gymnasium and Stable-Baselines3


@every_task
@pytest.mark.usefixtures("no_warning")
@every_noise
@pytest.mark.parametrize("render_mode", [None, "rgb_array"])
def test_both_env_checkers_pass_without_a_warning(env_id: str, kwargs: dict[str, Any], render_mode: str | None) -> None:
    env = gym.make(env_id, render_mode=render_mode, **kwargs)
    check_env(env.unwrapped)
    check_env(env)
    sb3_check_env(env)
    env.close()


@every_task
def test_frames_show_the_state_and_need_no_display(env_id: str) -> None:
    env = gym.make(env_id, noise_multiplier=1, render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    for _ in range(5):
        env.step(bounds(env.action_space)[1])
    after = env.render()
    assert isinstance(before, np.ndarray)
    assert before.shape in ((400, 600, 3), (500, 500, 3))
    assert before.dtype == np.uint8
    assert 0 < (before != after).any(axis=2).mean() < 0.2


@every_task
def test_an_unknown_render_mode_is_handled_as_in_gymnasium(env_id: str) -> None:
    with pytest.warns(UserWarning, match="render_mode='ascii' that is not in the possible render_modes"):
        gym.make(env_id, render_mode="ascii")
    env = gym.make(env_id, render_mode="rgb_array_list")
    env.reset(seed=0)
    frames = env.render()
    assert isinstance(frames, list)
    assert len(frames) == 1


@every_task
@every_noise
def test_an_environment_can_be_rebuilt_from_its_spec(env_id: str, kwargs: dict[str, Any]) -> None:
    env = gym.make(env_id, noise_std=0.5, **kwargs)
    assert env.spec is not None
    for spec in (env.spec, copy.deepcopy(env.spec), EnvSpec.from_json(env.spec.to_json())):
        twin = gym.make(spec)
        assert str(twin) == str(env)
        assert twin.spec == env.spec
        np.testing.assert_array_equal(episode(twin, seed=2)[0], episode(env, seed=2)[0])


@every_task
@pytest.mark.parametrize("copier", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["deepcopy", "pickle"])
def test_a_copied_environment_continues_exactly_like_the_original(env_id: str, copier: Any) -> None:
    env = gym.make(env_id, noise_multiplier=1, render_mode="rgb_array", max_episode_steps=6)
    env.reset(seed=0)
    env.step(action_of(0.1))
    env.render()
    twin = copier(env)
    for _ in range(5):
        original, copied = env.step(action_of(0.1)), twin.step(action_of(0.1))
        np.testing.assert_array_equal(original[0], copied[0])
        assert original[1:] == copied[1:]
    assert copied[3]  # the time limit went along
    np.testing.assert_array_equal(env.reset()[0], twin.reset()[0])
    np.testing.assert_array_equal(env.render(), twin.render())


@every_task
def test_gymnasium_vectorises_the_task(env_id: str) -> None:
    venv = gym.make_vec(env_id, num_envs=3, noise_multiplier=1)
    observations, _ = venv.reset(seed=0)
    assert observations.shape == (3, 2 * STATE_SIZE[env_id])
    np.testing.assert_array_equal(observations[1], gym.make(env_id, noise_multiplier=1).reset(seed=1)[0])
    venv.close()


def test_sb3_runs_the_task_in_worker_processes() -> None:
    # the long id lets a fresh process find the registration
    env_id = f"sb3_robust_bisim.envs:{CARTPOLE}"
    venv = make_vec_env(env_id, n_envs=2, seed=7, env_kwargs={"noise_multiplier": 2}, vec_env_cls=SubprocVecEnv)
    try:
        np.testing.assert_array_equal(np.asarray(venv.reset())[1], gym.make(CARTPOLE, noise_multiplier=2).reset(seed=8)[0])
    finally:
        venv.close()


def test_changing_a_returned_observation_does_not_move_the_car() -> None:
    env, untouched = gym.make(MOUNTAIN_CAR), gym.make(MOUNTAIN_CAR)
    env.reset(seed=0)
    untouched.reset(seed=0)
    env.step(action_of(1.0))[0][:] = 0.5
    untouched.step(action_of(1.0))
    np.testing.assert_array_equal(env.step(action_of(1.0))[0], untouched.step(action_of(1.0))[0])
