"""The bonus is computed from true transitions, even at the end of an episode and among other wrappers."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_models import images, layers, make_model
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecNormalize,
    is_vecenv_wrapped,
)

from sb3_robust_bisim import BisimSAC, IntrinsicRewardVecEnv

ENV = "robust_bisim/SparsePendulum-v0"
SATURATED = dict(intrinsic_reward_scale=1e6, intrinsic_reward_max=0.5)  # every bonus is 0.5


class Countdown(gym.Env):
    """Episodes of three steps with actions in [-2, 2]. The observation holds the numbers of the episode and the step."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = spaces.Box(-2, 2, (1,), np.float32)

    def __init__(self, as_dict: bool = False) -> None:
        self.episode, self.as_dict = 0, as_dict
        if as_dict:
            self.observation_space = spaces.Dict({"a": Countdown.observation_space})

    def _obs(self) -> Any:
        obs = np.array([self.episode, self.t], dtype=np.float32)
        return {"a": obs} if self.as_dict else obs

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        self.episode, self.t = self.episode + 1, 0
        return self._obs(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict]:
        self.t += 1
        return self._obs(), 5.0, self.t == 3, False, {}


@pytest.mark.parametrize("as_dict", [False, True])
def test_the_bonus_sees_the_true_successor_also_at_the_end_of_an_episode(as_dict: bool) -> None:
    venv = IntrinsicRewardVecEnv(DummyVecEnv([lambda: Countdown(as_dict)]))
    seen = []

    def bonus(obs: Any, actions: np.ndarray, next_obs: Any) -> np.ndarray:
        seen.append([(o["a"] if as_dict else o)[0].tolist() for o in (obs, next_obs)])
        return np.array([0.25])

    venv.bind(bonus)
    venv.reset()
    for _ in range(5):
        _, rewards, _, infos = venv.step(np.zeros((1, 1)))
        assert rewards.tolist() == [5.25]
        assert infos[0]["intrinsic_reward"] == 0.25
    transitions = [[[1, 0], [1, 1]], [[1, 1], [1, 2]], [[1, 2], [1, 3]], [[2, 0], [2, 1]], [[2, 1], [2, 2]]]
    assert seen == transitions


def test_every_stored_reward_is_the_reward_plus_the_formula() -> None:
    arguments = dict(intrinsic_reward_scale=0.1, intrinsic_reward_max=0.03, learning_starts=100)
    model = make_model(env=DummyVecEnv([Countdown, Countdown]), **arguments)
    model.learn(18)  # random actions only: the models stay as they were built
    buffer = model.replay_buffer
    for step in range(9):
        obs, next_obs = (th.as_tensor(array[step]) for array in (buffer.observations, buffer.next_observations))
        assert next_obs[:, 1].tolist() == (obs[:, 1] + 1).tolist()  # even the terminal transition stays within its episode
        with th.no_grad():
            z, next_z = model.critic.features_extractor.encode(obs), model.critic.features_extractor.encode(next_obs)
            mean = model.policy.representation.dynamics(z, th.as_tensor(buffer.actions[step])).mean[0]
        n = z.shape[1]
        expected = np.minimum(0.03, 0.1 * ((mean - next_z) ** 2).sum(dim=1).numpy() / (2 * n))
        np.testing.assert_allclose(buffer.rewards[step], 5.0 + expected, rtol=1e-5)
    assert 0 < (buffer.rewards[:9] == np.float32(5.03)).mean() < 1  # some bonuses are clamped and some are not


def test_the_bonus_scales_actions_as_the_buffer_does() -> None:
    model = make_model(env=DummyVecEnv([Countdown])).learn(1)
    obs = np.array([[1.0, 0.0]], dtype=np.float32)
    seen = []
    model.policy.representation.dynamics.register_forward_hook(lambda module, inputs, output: seen.append(inputs[1].item()))
    model._intrinsic_reward(obs, np.array([[2.0]]), obs)
    model._intrinsic_reward(obs, np.array([[-1.0]]), obs)
    assert seen == [1.0, -0.5]


def test_an_unbound_wrapper_passes_everything_through() -> None:
    plain, wrapped = make_vec_env(ENV, 2, seed=3), IntrinsicRewardVecEnv(make_vec_env(ENV, 2, seed=3))
    np.testing.assert_array_equal(plain.reset(), wrapped.reset())
    for _ in range(210):
        actions = np.full((2, 1), 0.7)
        for left, right in zip(plain.step(actions)[:3], wrapped.step(actions)[:3], strict=True):
            np.testing.assert_array_equal(left, right)
    assert "intrinsic_reward" not in wrapped.step(actions)[3][0]


def layer_names(model: BisimSAC) -> list[str]:
    return [type(layer).__name__ for layer in layers(model.get_env())]


def test_the_wrapper_is_added_once_and_survives_set_env_and_load(tmp_path: Any) -> None:
    model = make_model(env=ENV)
    wrapped = ["IntrinsicRewardVecEnv", "DummyVecEnv"]
    assert layer_names(model) == wrapped
    model.set_env(model.get_env())
    assert layer_names(model) == wrapped
    model.set_env(gym.make(ENV))
    assert layer_names(model) == wrapped
    model.learn(20)
    model.save(tmp_path / "m")
    for env in (gym.make(ENV), model.get_env()):
        loaded = BisimSAC.load(tmp_path / "m", env=env)
        assert layer_names(loaded) == wrapped
        loaded.learn(5, reset_num_timesteps=False)
        assert "rollout/intrinsic_reward" in loaded.logger.name_to_value
    assert BisimSAC.load(tmp_path / "m").get_env() is None


def test_a_model_without_bonus_ignores_the_bonus_of_an_earlier_model() -> None:
    env = make_model(env=DummyVecEnv([Countdown])).get_env()
    model = make_model(env=env, intrinsic_reward_scale=0.0).learn(12)
    assert model.replay_buffer.rewards[:12].tolist() == [[5.0]] * 12


def test_models_that_share_environments_each_learn_from_their_own_bonus(tmp_path: Any) -> None:
    model = make_model(env=DummyVecEnv([Countdown]), **SATURATED)
    model.learn(3)
    without = make_model(env=model.get_env(), intrinsic_reward_scale=0.0).learn(3)
    model.learn(3, reset_num_timesteps=False)
    assert model.replay_buffer.rewards[:6].tolist() == [[5.5]] * 6
    assert without.replay_buffer.rewards[:3].tolist() == [[5.0]] * 3


def test_a_vec_env_without_terminal_observations_trains() -> None:
    class Silent(VecEnvWrapper):
        def reset(self) -> np.ndarray:
            return self.venv.reset()

        def step_wait(self) -> Any:
            obs, rewards, dones, infos = self.venv.step_wait()
            return obs, rewards, dones, [{} for _ in infos]

    model = make_model(env=Silent(DummyVecEnv([Countdown])))
    assert model.learn(30).num_timesteps == 30


def test_the_bonus_reads_normalised_observations_under_vecnormalize_and_reaches_the_buffer() -> None:
    venv = VecNormalize(IntrinsicRewardVecEnv(DummyVecEnv([Countdown])), norm_reward=False)
    model = make_model(env=venv, **SATURATED)
    encoded = []
    model.critic.features_extractor.register_forward_pre_hook(lambda module, inputs: encoded.append(inputs[0].clone()))
    model.learn(9)
    np.testing.assert_allclose(model.replay_buffer.rewards[:9], 5.5)
    obs = np.array([[2.0, 1.0]], dtype=np.float32)
    model._intrinsic_reward(obs, np.zeros((1, 1)), obs)
    for seen in encoded[-2:]:
        np.testing.assert_array_equal(seen, venv.normalize_obs(obs))
        assert not np.allclose(seen, obs)


def test_the_wrapper_must_see_whole_frame_stacks() -> None:
    model = make_model("CnnPolicy", VecFrameStack(DummyVecEnv([images]), 3)).learn(20)
    assert layer_names(model)[0] == "IntrinsicRewardVecEnv"
    with pytest.raises(ValueError, match="VecFrameStack"):
        make_model("CnnPolicy", VecFrameStack(IntrinsicRewardVecEnv(DummyVecEnv([images])), 3))


class OneArray(VecEnvWrapper):
    """Writes every observation into the same array."""

    def reset(self) -> np.ndarray:
        self.array = self.venv.reset()
        return self.array

    def step_wait(self) -> Any:
        self.array[:], *rest = self.venv.step_wait()
        return self.array, *rest


def test_a_vec_env_that_reuses_its_array_gets_the_same_bonuses() -> None:
    rewards = []
    for reuse in (False, True):
        venv: VecEnv = DummyVecEnv([Countdown] * 2)
        env = OneArray(venv) if reuse else venv
        model = make_model(env=env, intrinsic_reward_max=1e9, gradient_steps=0).learn(30)  # no bonus is clamped
        rewards.append(model.replay_buffer.rewards[: model.replay_buffer.pos])
    assert len(np.unique(rewards[0])) > 2
    np.testing.assert_array_equal(*rewards)


def test_the_bonus_is_bound_only_while_learn_runs_even_if_it_fails() -> None:
    model = make_model(env=DummyVecEnv([Countdown]))
    venv = model.get_env()
    venv.reset()
    assert "intrinsic_reward" not in venv.step(np.zeros((1, 1)))[3][0]

    class Fail(BaseCallback):
        def _on_step(self) -> bool:
            assert "intrinsic_reward" in self.locals["infos"][0]
            raise KeyError

    with pytest.raises(KeyError):
        model.learn(5, callback=Fail())
    assert "intrinsic_reward" not in venv.step(np.zeros((1, 1)))[3][0]


def test_the_bonus_works_with_environments_in_other_processes() -> None:
    venv = SubprocVecEnv([Countdown, Countdown], start_method="forkserver")
    model = make_model(env=venv, **SATURATED).learn(24)
    np.testing.assert_allclose(model.replay_buffer.rewards[:12], 5.5)
    venv.close()


def test_evaluation_in_the_training_environments_sees_no_bonus_after_learn() -> None:
    # without a Monitor, which would report the reward below the bonus in any case
    model = make_model(env=DummyVecEnv([Countdown]), **SATURATED).learn(12)
    assert model.replay_buffer.rewards[:12].tolist() == [[5.5]] * 12
    returns, _ = evaluate_policy(model, model.get_env(), n_eval_episodes=2, warn=False, return_episode_rewards=True)
    assert returns == [15.0, 15.0]


def test_evaluation_and_monitor_show_the_extrinsic_return() -> None:
    model = make_model(env=make_vec_env(Countdown, 1), **SATURATED).learn(12)
    assert {episode["r"] for episode in model.ep_info_buffer} == {15.0}
    assert evaluate_policy(model, model.get_env(), n_eval_episodes=2)[0] == 15.0
    assert is_vecenv_wrapped(model.get_env(), IntrinsicRewardVecEnv)
