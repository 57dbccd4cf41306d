"""An environment that was pickled in the middle of an episode continues exactly like the original."""

import pickle
import threading
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import RecordEpisodeStatistics
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_robust_bisim import BisimSAC, IntrinsicRewardVecEnv
from sb3_robust_bisim.envs.opengl import import_suite
from sb3_robust_bisim.intrinsic_reward import bound
from sb3_robust_bisim.runs import ResumableSubprocVecEnv
from sb3_robust_bisim.runs.pickling import NotSaveable, WorkerEnded, check_environments, dumps

LIMIT = 60  # steps per episode


class GlobalNoise(gym.ObservationWrapper):
    """Noise from NumPy's global random generator, which belongs to the process."""

    def observation(self, observation: np.ndarray) -> np.ndarray:
        return observation + np.random.normal(size=observation.shape)  # noqa: NPY002


class Locked(gym.Wrapper):
    """Cannot be pickled, because it has a lock."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.lock = threading.Lock()


class Relocked(Locked):
    """Follows the protocol that the refusal names."""

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, lock=threading.Lock())


def mujoco_task(name: str) -> gym.Env:
    return Monitor(RecordEpisodeStatistics(gym.make(name, max_episode_steps=LIMIT)))


def noisy_pendulum(wrapper: type[gym.Wrapper] = GlobalNoise) -> gym.Env:
    return Monitor(wrapper(gym.make("Pendulum-v1", max_episode_steps=LIMIT)))


def some_steps(env: gym.Env, steps: int) -> int:
    """Random actions of the environment itself. The number of episodes that ended."""
    ends = 0
    for _ in range(steps):
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
            ends += 1
    return ends


# The rewards of Ant and Humanoid depend on body positions that MuJoCo's own state does not contain
@pytest.mark.parametrize("name", ["Hopper-v5", "HalfCheetah-v5", "Ant-v5", "Humanoid-v5"])
def test_a_mujoco_task_continues_exactly(name: str) -> None:
    env = mujoco_task(name)
    env.reset(seed=1)
    env.action_space.seed(2)
    some_steps(env, LIMIT + 7)
    copy = pickle.loads(dumps(env))
    ends = 0
    for _ in range(200):
        action = env.action_space.sample()
        np.testing.assert_array_equal(copy.action_space.sample(), action)
        (obs, *outcome, info), (copied_obs, *copied_outcome, copied_info) = env.step(action), copy.step(action)
        np.testing.assert_array_equal(copied_obs, obs)
        assert copied_outcome == outcome
        if any(outcome[1:]):  # terminated or truncated
            assert copied_info["episode"]["l"] == info["episode"]["l"]
            np.testing.assert_array_equal(copy.reset()[0], env.reset()[0])
            ends += 1
    assert ends > 1


def test_a_mujoco_task_that_has_rendered_can_be_saved() -> None:
    import_suite(rendering=True)  # chooses an OpenGL backend, which Gymnasium's renderer reads
    env = gym.make("HalfCheetah-v5", render_mode="rgb_array", width=32, height=32)
    env.reset(seed=1)
    frame = env.render()
    copy = pickle.loads(dumps(env))
    np.testing.assert_array_equal(copy.render(), frame)
    env.close()
    copy.close()


def test_a_killed_process_of_an_environment_is_named_and_the_others_are_closed() -> None:
    venv = ResumableSubprocVecEnv([noisy_pendulum, noisy_pendulum], start_method="fork")
    venv.reset()
    venv.processes[0].kill()
    for use in (lambda: venv.step(np.zeros((2, 1))), venv.reset, lambda: check_environments(venv)):
        with pytest.raises(WorkerEnded, match=r"process has ended \(exit codes \[-9, None\]"):
            use()
    venv.close()
    assert [process.exitcode for process in venv.processes] == [-9, 0]


@pytest.mark.parametrize("make", [partial(mujoco_task, "Hopper-v5"), noisy_pendulum])
def test_environments_in_other_processes_continue_exactly(make: Any) -> None:
    venv = ResumableSubprocVecEnv([make, make], start_method="fork")
    venv.seed(1)
    venv.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, size=(LIMIT + 20, 2, *venv.action_space.shape))  # type: ignore[misc]
    for action in actions[:9]:
        venv.step(action)
    once = pickle.loads(dumps(venv))
    twice = pickle.loads(dumps(once))
    ended = 0
    for action in actions:
        obs, rewards, dones, _ = venv.step(action)
        for copy in (once, twice):
            copied_obs, copied_rewards, copied_dones, _ = copy.step(action)
            np.testing.assert_array_equal(copied_obs, obs)
            np.testing.assert_array_equal(copied_rewards, rewards)
            np.testing.assert_array_equal(copied_dones, dones)
        ended += dones.sum()
    assert ended >= 2
    for env in (venv, once, twice):
        env.close()


@pytest.mark.parametrize("venv_class", [DummyVecEnv, partial(ResumableSubprocVecEnv, start_method="fork")])
def test_an_environment_that_cannot_be_pickled_is_named_with_what_to_implement(venv_class: type[VecEnv]) -> None:
    venv = venv_class([partial(noisy_pendulum, Locked)])
    with pytest.raises(NotSaveable, match=r"^Locked cannot be saved .*lock.* Give it __getstate__\(\) and __setstate__"):
        check_environments(venv)
    venv.reset()  # the refusal has not ended the worker
    venv.close()
    check_environments(venv_class([partial(noisy_pendulum, Relocked)]))


def test_the_pickle_of_an_environment_does_not_hold_the_agent_whose_bonus_is_bound_to_it() -> None:
    sizes = []
    for buffer_size in (100, 100_000):
        model = BisimSAC("MlpPolicy", "Pendulum-v1", intrinsic_reward_scale=1.0, buffer_size=buffer_size)
        assert isinstance(model.env, IntrinsicRewardVecEnv)
        with bound(model.env, model._intrinsic_reward):
            pickled = dumps(model.env)
            assert model.env._bonus is not None
        assert pickle.loads(pickled)._bonus is None
        sizes.append(len(pickled))
    assert abs(sizes[1] - sizes[0]) < 100


def test_sb3s_environments_in_other_processes_are_refused_with_the_class_to_use() -> None:
    venv = SubprocVecEnv([noisy_pendulum], start_method="fork")
    with pytest.raises(NotSaveable, match=r"replace it with sb3_robust_bisim\.runs\.ResumableSubprocVecEnv"):
        check_environments(venv)
    venv.close()
