"""Bad data is found where it enters: before the replay buffer, with environment, step and key; useless runs are announced."""

import re
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from small_models import StopAt, dicts, make_model, pendulum
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_robust_bisim import IntrinsicRewardVecEnv

NAN, INF = float("nan"), float("inf")


class Broken(gym.Wrapper):
    """A sensor fails: observation or reward of one step is not finite. Step 0 is the reset."""

    def __init__(self, env: gym.Env, step: int, value: float, part: str) -> None:
        super().__init__(env)
        self.broken_step, self.value, self.part, self.count = step, value, part, 0

    def spoil(self, obs: Any) -> Any:
        if self.count != self.broken_step or self.part == "reward":
            return obs
        if isinstance(obs, dict):
            return {**obs, self.part: np.full_like(obs[self.part], self.value)}
        obs = obs.copy()
        obs[2] = self.value
        return obs

    def reset(self, **kwargs: Any) -> Any:
        obs, info = self.env.reset(**kwargs)
        return self.spoil(obs), info

    def step(self, action: np.ndarray) -> Any:
        self.count += 1
        obs, reward, terminated, truncated, info = self.env.step(action)
        broken = self.part == "reward" and self.count == self.broken_step
        return self.spoil(obs), self.value if broken else reward, terminated, truncated, info


def broken(step: int, value: float = NAN, part: str = "obs", env: Callable[[], gym.Env] = pendulum) -> DummyVecEnv:
    """Two environments, of which the second breaks."""
    return DummyVecEnv([env, lambda: Broken(env(), step, value, part)])


def plain(venv: DummyVecEnv) -> DummyVecEnv:
    return venv


def normalized(venv: DummyVecEnv) -> VecNormalize:
    return VecNormalize(IntrinsicRewardVecEnv(venv), norm_reward=False)


@pytest.mark.parametrize(("chain", "value"), [(plain, NAN), (plain, -INF), (normalized, NAN), (normalized, INF)])
@pytest.mark.parametrize(
    ("part", "step", "message"),
    [
        ("obs", 0, "The observation of environment 1 at step 0 is {value} at index (2,)"),
        ("obs", 3, "The observation of environment 1 at step 6 is {value} at index (2,)"),
        ("obs", 14, "The observation of environment 1 at step 28 is {value} at index (2,)"),
        ("reward", 3, "The reward of environment 1 at step 6 is {value}"),
        ("reward", 14, "The reward of environment 1 at step 28 is {value}"),
    ],
)
def test_what_is_not_finite_is_named_and_never_stored(chain: Any, value: float, part: str, step: int, message: str) -> None:
    model = make_model(env=chain(broken(step, value, part)))
    expected = message.format(value=value) + ". The environment gave it, and nothing of this step has been stored. Correct the"
    with pytest.raises(ValueError, match=re.escape(expected)):
        model.learn(60)
    buffer = model.replay_buffer
    assert buffer.pos == max(step - 1, 0)
    assert np.isfinite(buffer.observations).all()
    assert np.isfinite(buffer.rewards).all()


def test_the_last_observation_of_an_episode_is_checked_too() -> None:
    model = make_model(env=broken(10))  # the observation that the VecEnv returns then is the first of the next episode
    with pytest.raises(
        ValueError, match=r"The terminal observation of environment 1 at step 20 is nan at index \(2,\)\. The env"
    ):
        model.learn(60)


@pytest.mark.parametrize("step", [0, 2])
def test_the_key_of_a_dict_is_named(step: int) -> None:
    model = make_model("MultiInputPolicy", broken(step, part="vec", env=dicts), intrinsic_reward_scale=0.0)
    with pytest.raises(ValueError, match=rf"of environment 1 at step {2 * step} is nan with key 'vec' at index \(0,\)"):
        model.learn(60)


def test_frames_in_a_stack_are_checked() -> None:
    with pytest.raises(ValueError, match=r"The observation of environment 1 at step 6 is nan at index \(5,\)"):
        make_model(env=VecFrameStack(broken(3), 2)).learn(60)


def test_an_action_that_is_not_finite_is_blamed_on_the_actor_and_not_on_the_environment() -> None:
    noise = NormalActionNoise(np.zeros(1), np.full(1, NAN))
    message = r"The action of environment 0 at step 1 is nan at index \(0,\)\. All observations were finite, so the actor "
    with pytest.raises(ValueError, match=message + r"\(or action_noise\) diverged: load the last checkpoint, and lower"):
        make_model(action_noise=noise).learn(20)


def test_a_bonus_that_is_not_finite_is_blamed_on_the_models() -> None:
    model = make_model()
    model.policy.representation.dynamics.members[0][0].bias.data.fill_(NAN)
    message = (
        "The intrinsic reward of environment 0 at step 1 is nan. All observations were finite, so encoder or dynamics model"
    )
    with pytest.raises(ValueError, match=message):
        model.learn(20)


def test_the_checks_come_before_the_callbacks_of_the_user() -> None:
    steps = []
    with pytest.raises(ValueError, match="The reward of environment 1 at step 6"):
        make_model(env=broken(3, part="reward")).learn(60, lambda values, _: not steps.append(values["self"].num_timesteps))
    assert steps == [2, 4]


@pytest.mark.parametrize("callback", [StopAt(3), [StopAt(3)], lambda values, _: values["self"].num_timesteps < 3])
def test_every_kind_of_callback_still_runs(callback: Any) -> None:
    assert make_model().learn(60, callback).num_timesteps == 3


def rewards_of(run: Callable[[], Any], pattern: str) -> list[str]:
    """The warnings of a run that match."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run()
    return [message for entry in caught if re.search(pattern, message := str(entry.message))]


def late(reward: float, at: int) -> gym.Env:
    """Every step pays 0.5, but one."""
    steps = iter(range(1, 1000))
    return gym.wrappers.TransformReward(pendulum(), lambda _: reward if next(steps) == at else 0.5)


@pytest.mark.parametrize("norm", [plain, normalized])
def test_rewards_beyond_the_range_are_said_once_when_learning_starts(norm: Any) -> None:
    model = make_model(env=norm(DummyVecEnv([partial(late, -2.0, 4), partial(late, 2.5, 5)])), c_t=0.9)
    (message,) = rewards_of(lambda: model.learn(60), "reward_range")
    assert message.startswith(
        "reward_range=(0.0, 1.0): rewards from -2.0 to 2.5 have been seen, without the bonus. "
        "They need a ball of radius 22.5, and it has 5: "
    )
    assert "Pass reward_range=(-2.0, 2.5), wider if" in message


def test_a_reward_that_comes_late_is_said() -> None:
    (message,) = rewards_of(lambda: make_model(env=late(9.0, 25)).learn(30), "reward_range")
    assert "rewards from 0.5 to 9.0" in message


@pytest.mark.parametrize(
    ("env", "settings"),
    [
        (partial(late, 1.0, 4), dict(intrinsic_reward_scale=1e9, intrinsic_reward_max=50.0)),  # the bonus does not count
        (partial(late, -0.5, 4), dict()),  # outside, but no wider than the range: the radius is right
        (partial(late, 9.0, 4), dict(reward_range=(0, 9))),
        (partial(late, 9.0, 4), dict(norm_constraint=False)),
        (partial(late, 9.0, 4), dict(norm_constraint="sphere")),
        (partial(late, 9.0, 4), dict(bisim_coef=0.0)),
    ],
)
def test_nothing_is_said_where_the_ball_fits_or_none_is_needed(env: Callable[[], gym.Env], settings: dict[str, Any]) -> None:
    assert rewards_of(lambda: make_model(env=env(), **settings).learn(30), "reward_range") == []


def test_absorbing_states_pay_0_also_where_rewards_are_compared() -> None:
    settings: dict[str, Any] = dict(metric_kwargs=dict(absorbing=True), reward_range=(0.2, 0.4))
    (message,) = rewards_of(lambda: make_model(env=pendulum(0.5), **settings).learn(30), "reward_range")
    assert "from 0.5 to 0.5 have been seen" in message
    assert "They need a ball of radius 25, and it has 20" in message
    settings["reward_range"] = (0.1, 0.5)
    assert rewards_of(lambda: make_model(env=pendulum(0.5), **settings).learn(30), "reward_range") == []


def test_a_run_that_ends_before_learning_starts_is_announced(tmp_path: Path) -> None:
    said = partial(
        rewards_of, pattern="learning_starts=10, and learn.. ends at step 10: actions are random, and nothing is trained"
    )
    model = make_model()
    assert len(said(lambda: model.learn(10))) == 1
    assert model._n_updates == 0
    assert said(lambda: model.learn(10, reset_num_timesteps=False)) == []
    assert model._n_updates == 10
    assert said(lambda: make_model(gradient_steps=0).learn(10)) == []  # nothing is to be trained
