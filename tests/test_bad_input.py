"""BisimSAC refuses bad input before any work starts. Each message names the argument and its value."""

import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_models import SMALL, dicts, images, make_model, pendulum
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecNormalize
from stable_baselines3.her import HerReplayBuffer
from stable_baselines3.sac.policies import SACPolicy

from sb3_robust_bisim import BisimSAC, IntrinsicRewardVecEnv
from sb3_robust_bisim.policies import CnnPolicy, MlpPolicy

NAN, INF = float("nan"), float("inf")


def venv() -> VecEnv:
    return DummyVecEnv([pendulum])


WEIGHTS = ("bisim_coef", "c_r", "model_coef", "intrinsic_reward_scale", "intrinsic_reward_max", "inverse_dynamics_coef")
OUT_OF_RANGE: list[tuple[str, Any]] = [
    *((name, value) for name in WEIGHTS for value in (-0.1, NAN, INF, "1")),
    *(("c_t", value) for value in (1.0, 1.5, -0.1, NAN, "0.5")),
    *(("reward_range", value) for value in ((1, 0), (1, 1), (0,), (0, 1, 2), (0, INF), (NAN, 1), None, 1.0, "ab")),
    *(("distance", value) for value in ("L1", None)),
    *(("dynamics", value) for value in ("gaussian", None)),
    *(("policy_delay", value) for value in (0, -1, NAN, 1.5, "2", None)),
    *(("initial_gradient_steps", value) for value in (-1, 1.5, None)),
    *((name, value) for name in ("batch_size", "buffer_size", "target_update_interval") for value in (0, -8, 8.0, True, None)),
    *(("gradient_steps", value) for value in (-2, 1.5, "1", True)),
    *(("learning_starts", value) for value in (-1, NAN, "100", None)),
    *(
        ("train_freq", value)
        for value in (0, -1, 1.5, True, "4", (4,), (0, "episode"), (4, "steps"), (1, "step", 2), [4, "step"])
    ),
    *(("tau", value) for value in (-0.1, 1.1, NAN, None)),
    *(("bf16", value) for value in (1, None)),
    *(("ent_coef", value) for value in ("foo", "auto_", "auto_0", "auto_x", "auto_nan", -1.0, NAN, None)),
    *(("target_entropy", value) for value in ("foo", NAN, None)),
    *(("learning_rate", value) for value in (-1.0, NAN, "x", None)),
    ("learning_starts", INF),
    ("replay_buffer_class", "ReplayBuffer"),
]


@pytest.mark.parametrize(("name", "value"), OUT_OF_RANGE)
def test_a_value_out_of_range_is_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=re.escape(f"{name}={value!r}: it must be ")):
        make_model(**{name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("ent_coef", value) for value in ("auto", "auto_0.1", "auto_1e-3", "0.1", 0, np.float32(0.1))),
        *(("target_entropy", value) for value in ("auto", -1, "-1", np.float64(-0.5))),
        *(("learning_rate", value) for value in (0.0, 1, lambda rest: rest, lambda rest: th.tensor(rest))),
        ("learning_starts", 10**20),
    ],
)
def test_what_sac_accepts_is_accepted(name: str, value: Any) -> None:
    make_model(**{name: value})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (dict(gamma=1.0), r"gamma=1.0: it must be a number in \[0, 1\), because c_t=None takes"),
        (dict(gamma="0.99"), r"gamma='0.99': it must be a number in \[0, 1\), because c_t=None takes"),
        (dict(c_r=0), "c_r=0: it must be above 0, or norm_constraint=False"),
        (dict(model_coef=0.0), "model_coef=0.0: it must be above 0 where bisim_coef or intrinsic_reward_scale needs"),
        (dict(n_steps=3), "n_steps=3 .* Use n_steps=1"),
        (dict(replay_buffer_kwargs=dict(n_steps=3)), "n_steps=3 .* Use n_steps=1"),
        (dict(n_steps=3, replay_buffer_kwargs=dict(n_steps=1)), "n_steps=3 .* Use n_steps=1"),
        (dict(replay_buffer_class=NStepReplayBuffer), "NStepReplayBuffer"),
        (dict(gamma=1.5, c_t=0.9), r"gamma=1.5: it must be a number in \[0, 1\]"),
        (dict(batch_size=np.array([8, 16])), r"batch_size=array\(\[ 8, 16\]\): it must be an integer >= 1"),
        (
            dict(policy_kwargs=dict(features_extractor_kwargs=dict(n_layers=0))),
            "n_layers=0: an encoder needs at least one layer",
        ),
    ],
)
def test_settings_without_a_meaning_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_model(**settings)


def test_the_same_settings_are_accepted_where_they_have_a_meaning() -> None:
    make_model(gamma=1.0, c_t=0.9)
    make_model(c_r=0, norm_constraint=False)
    make_model(c_t=0, bisim_coef=0, model_coef=0, intrinsic_reward_scale=0, intrinsic_reward_max=0, reward_range=[-1, 0])


@pytest.mark.parametrize(
    ("wrong", "right"),
    [
        ("bisim_coeff", "'bisim_coef'"),
        ("intrinsic_reward", "'intrinsic_reward_max' or 'intrinsic_reward_scale'"),
        ("learning_start", "'learning_starts'"),
    ],
)
def test_a_misspelt_argument_is_refused_and_the_right_one_suggested(wrong: str, right: str) -> None:
    with pytest.raises(TypeError, match=rf"no argument '{wrong}' \(value 3\), did you mean {right}\?"):
        make_model(**{wrong: 3})


def test_an_argument_that_resembles_no_other_is_refused() -> None:
    with pytest.raises(TypeError, match=r"no argument 'xyz' \(value 3\): see the documentation"):
        make_model(xyz=3)


def test_discrete_actions_are_refused() -> None:
    message = r"action_space=Discrete\(2\): BisimSAC needs continuous actions, a Box. For discrete ones use SB3's DQN or PPO"
    with pytest.raises(ValueError, match=message):
        make_model(env=gym.make("CartPole-v1"))
    with pytest.raises(ValueError, match=message):
        make_model(env="CartPole-v1")
    with pytest.raises(ValueError, match=message):
        make_model(env=DummyVecEnv([lambda: gym.make("CartPole-v1")]))


@pytest.mark.parametrize("bounds", [(-INF, 1), (-1, INF), (1, 1)])
def test_actions_that_cannot_be_scaled_are_refused(bounds: tuple[float, float]) -> None:
    env = pendulum()
    env.action_space = gym.spaces.Box(*bounds, (1,))
    with pytest.raises(
        ValueError, match=r"action_space=Box.*all bounds must be finite, with low < high. Use gymnasium.wrappers"
    ):
        make_model(env=env)


def test_episodes_of_several_environments_do_not_end_together() -> None:
    env = DummyVecEnv([pendulum, pendulum])
    with pytest.raises(ValueError, match=r"""train_freq=\(1, 'episode'\) with 2 environments: .* Use \(n, "step"\)"""):
        make_model(env=env, train_freq=(1, "episode"))
    make_model(env=env, train_freq=(1, "step"))
    make_model(train_freq=(1, "episode"))


def test_a_buffer_below_the_batch_is_told_when_training_starts() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = make_model(buffer_size=7)  # as agents are loaded that only play
    with pytest.warns(UserWarning, match="buffer_size=7 is below batch_size=8: every batch repeats transitions. Raise"):
        model.learn(1)


@pytest.mark.parametrize(
    ("policy", "env", "message"),
    [
        ("MlpPolicy", images, 'policy="MlpPolicy" with images .*: use "CnnPolicy"'),
        (MlpPolicy, images, 'policy="MlpPolicy" with images .*: use "CnnPolicy"'),
        ("CnnPolicy", pendulum, r"CnnPolicy needs images, .* Box\(.*: use MlpPolicy"),
        (CnnPolicy, dicts, r"policy=CnnPolicy with observations Dict\(.*use MultiInputPolicy"),
        ("MlpPolicy", dicts, "MultiInputPolicy"),
        (MlpPolicy, dicts, "MultiInputPolicy"),
        ("MultiInputPolicy", pendulum, r"Box\("),
        (SACPolicy, pendulum, r"policy=.*SACPolicy'>: it must be a subclass of .*BisimPolicy.*SB3's SAC"),
        (3, pendulum, "policy=3"),
        ("Mlp", pendulum, "Policy Mlp unknown"),
    ],
)
def test_a_policy_that_does_not_fit_is_refused(policy: Any, env: Callable[[], gym.Env], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_model(policy, env())


@pytest.mark.parametrize("n_stack", [1, 3])
def test_float_images_with_the_channels_last_are_refused(n_stack: int) -> None:
    class FloatImages(gym.Env):
        observation_space = spaces.Box(0, 1, (84, 84, 3))
        action_space = spaces.Box(-1, 1, (1,))

    env = VecFrameStack(DummyVecEnv([FloatImages]), n_stack)
    with pytest.raises(ValueError, match=r"channels first, the observation space is Box\(.*TransformObservation"):
        make_model("CnnPolicy", env, policy_kwargs=dict(normalize_images=False))


def test_hindsight_replay_with_a_bonus_is_refused() -> None:
    env = BitFlippingEnv(n_bits=4, continuous=True)
    with pytest.raises(ValueError, match=r"intrinsic_reward_scale=0\.5 with HerReplayBuffer"):
        make_model("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, intrinsic_reward_scale=0.5)


RIGHT_ORDER = r"use VecNormalize\(IntrinsicRewardVecEnv\(venv\), norm_reward=False\)"
CHAINS: list[tuple[Callable[[], VecEnv], str]] = [
    (lambda: VecNormalize(venv(), training=False), r"VecNormalize\(norm_reward=True\).*Pass norm_reward=False"),
    (lambda: VecNormalize(venv(), norm_obs=False), r"VecNormalize\(norm_reward=True\).*Pass norm_reward=False"),
    (lambda: VecNormalize(IntrinsicRewardVecEnv(venv())), r"VecNormalize\(norm_reward=True\).*Pass norm_reward=False"),
    (
        lambda: IntrinsicRewardVecEnv(VecNormalize(venv(), norm_reward=False)),
        f"IntrinsicRewardVecEnv outside of VecNormalize.*{RIGHT_ORDER}",
    ),
    (lambda: VecNormalize(venv(), norm_reward=False), rf"intrinsic_reward_scale=1\.0 under VecNormalize: {RIGHT_ORDER}"),
]


@pytest.mark.parametrize(("chain", "message"), CHAINS)
def test_wrappers_in_the_wrong_order_are_refused_by_constructor_set_env_and_load(
    chain: Callable[[], VecEnv], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=message):
        make_model(env=chain())
    model = make_model()
    before = model.get_env()
    with pytest.raises(ValueError, match=message):
        model.set_env(chain())
    assert model.get_env() is before
    model.save(tmp_path / "model")
    with pytest.raises(ValueError, match=message):
        BisimSAC.load(tmp_path / "model", env=chain())


@pytest.mark.parametrize(("policy", "env"), [("MlpPolicy", pendulum), ("MultiInputPolicy", dicts)])
def test_a_bonus_below_a_frame_stack_is_refused(policy: str, env: Callable[[], gym.Env]) -> None:
    with pytest.raises(ValueError, match=r"IntrinsicRewardVecEnv sees observations of .* outside .*VecFrameStack"):
        make_model(policy, VecFrameStack(IntrinsicRewardVecEnv(DummyVecEnv([env])), 2))


@pytest.mark.parametrize(
    ("policy", "env", "outside"),
    [
        ("MlpPolicy", lambda: VecFrameStack(VecNormalize(venv(), norm_reward=False), 2), "VecFrameStack"),
        ("CnnPolicy", lambda: VecNormalize(DummyVecEnv([images]), norm_obs=False, norm_reward=False), "VecTransposeImage"),
    ],
)
def test_vec_normalize_inside_of_what_changes_shapes_is_refused(policy: str, env: Callable[[], VecEnv], outside: str) -> None:
    with pytest.raises(ValueError, match=f"VecNormalize inside of {outside}, .* Make VecNormalize the outermost"):
        make_model(policy, env(), intrinsic_reward_scale=0.0)


def test_set_env_refuses_another_number_of_environments_and_binds_nothing() -> None:
    model, other = make_model(intrinsic_reward_scale=1.0), IntrinsicRewardVecEnv(DummyVecEnv([pendulum, pendulum]))
    with pytest.raises(AssertionError, match="number of environments"):
        model.set_env(other)
    assert other._bonus is None


@pytest.mark.parametrize(
    ("name", "message"),
    [("objective", "BisimSAC sets it; pass its settings to BisimSAC"), ("bf16", "BisimSAC sets it; pass bf16 to BisimSAC")],
)
def test_policy_kwargs_that_bisim_sac_sets_itself_are_refused(name: str, message: str) -> None:
    with pytest.raises(ValueError, match=f"policy_kwargs with {name}=1: {message}"):
        make_model(policy_kwargs={name: 1})


def test_set_env_refuses_an_environment_with_other_spaces() -> None:
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        make_model().set_env(gym.make("MountainCarContinuous-v0"))


@pytest.mark.parametrize(("name", "value"), [("c_t", 1.5), ("reward_range", (1, 0)), ("n_steps", 3), ("policy_delay", 0)])
def test_load_refuses_what_the_constructor_refuses(name: str, value: Any, tmp_path: Path) -> None:
    make_model().save(tmp_path / "model")
    with pytest.raises(ValueError, match=re.escape(f"{name}={value!r}")):
        BisimSAC.load(tmp_path / "model", **{name: value})


def test_load_refuses_a_misspelt_argument(tmp_path: Path) -> None:
    make_model().save(tmp_path / "model")
    with pytest.raises(TypeError, match="did you mean 'bisim_coef'"):
        BisimSAC.load(tmp_path / "model", bisim_coeff=0.1)


def test_load_accepts_the_arguments_of_a_subclass(tmp_path: Path) -> None:
    class Renamed(BisimSAC):
        def __init__(self, *args: Any, nickname: str = "", **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)
            self.nickname = nickname

    Renamed("MlpPolicy", pendulum(), **SMALL).save(tmp_path / "model")
    assert Renamed.load(tmp_path / "model", nickname="b", c_t=0.5).nickname == "b"
    with pytest.raises(TypeError, match="did you mean 'nickname'"):
        Renamed.load(tmp_path / "model", nicknam="b")


def test_the_message_names_the_first_loss_that_breaks() -> None:
    model = make_model().learn(20)
    inner, calls = model.policy.representation.dynamics.forward, []

    def break_at_the_third(z: th.Tensor, actions: th.Tensor) -> Any:
        calls.append(None)
        prediction = inner(z, actions)
        return prediction._replace(mean=prediction.mean * float("nan")) if len(calls) == 3 else prediction

    model.policy.representation.dynamics.forward = break_at_the_third  # type: ignore[method-assign]
    third = model._n_updates + 3
    with pytest.raises(ValueError, match=rf"train/(dynamics|reward|bisim)_loss became nan at update {third}"):
        model.train(gradient_steps=10, batch_size=8)


def test_the_message_names_the_update_that_leaves_broken_weights() -> None:
    model = make_model(policy_delay=1).learn(20)
    for state in model.actor.optimizer.state.values():
        state["exp_avg"].fill_(NAN)
    with pytest.raises(ValueError, match=rf"train/parameter_norm became nan at update {model._n_updates + 1}: training has"):
        model.train(gradient_steps=1, batch_size=8)  # no loss is broken yet


@pytest.mark.parametrize("gradient_steps", [1, 5])
def test_a_far_too_high_learning_rate_stops_training_and_the_message_says_where(gradient_steps: int) -> None:
    model = make_model(learning_rate=100.0, gradient_steps=gradient_steps)
    with pytest.raises(ValueError, match=r"train/critic_loss became (nan|inf) at update \d: .* lower learning_rate"):
        model.learn(30)
