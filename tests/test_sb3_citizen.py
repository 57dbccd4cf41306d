"""BisimSAC keeps the contract of a Stable-Baselines3 algorithm, with bonus and inverse dynamics switched on."""

from contextlib import nullcontext
from copy import deepcopy
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_models import EPISODE, NormDropout, StopAt, dicts, images, make_model, parameters, pendulum, with_data
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecFrameStack,
    VecNormalize,
    VecTransposeImage,
    is_vecenv_wrapped,
)
from stable_baselines3.her import HerReplayBuffer
from torch import nn

from sb3_robust_bisim import BisimSAC, IntrinsicRewardVecEnv
from sb3_robust_bisim.encoders import MlpEncoder
from sb3_robust_bisim.latent_models import DYNAMICS
from sb3_robust_bisim.losses import DISTANCES

# It pays no reward, so the replay buffer holds only the bonus
unpaid_pendulum = partial(pendulum, reward=0.0)


def learning_rate_of(optimizer: th.optim.Optimizer | None) -> float:
    assert optimizer is not None
    return optimizer.param_groups[0]["lr"]


@pytest.mark.parametrize(("dynamics", "distance"), product(DYNAMICS, DISTANCES))
def test_every_dynamics_model_trains_under_every_distance(dynamics: Any, distance: Any) -> None:
    on_sphere = dict(norm_constraint="sphere", metric_kwargs=dict(successors="sample"))
    model = make_model(dynamics=dynamics, distance=distance, **(on_sphere if distance == "cosine" else {}))
    before = parameters(model.policy)
    model.learn(EPISODE + 3)
    after = parameters(model.policy)
    assert model._n_updates == 3
    assert th.isfinite(after).all()
    assert not th.equal(before, after)


@pytest.mark.parametrize(
    ("ent_coef", "initial", "learned"), [("auto", 1.0, True), ("auto_0.01", 0.01, True), (0.01, 0.01, False)]
)
def test_the_entropy_coefficient_is_learned_or_fixed(ent_coef: str | float, initial: float, learned: bool) -> None:
    model = make_model(ent_coef=ent_coef)
    assert (model.ent_coef_optimizer is not None) == (model.log_ent_coef is not None) == learned
    model.learn(EPISODE + 4)
    now = model.ent_coef_tensor if model.log_ent_coef is None else model.log_ent_coef.exp()
    assert float(now.detach()) == pytest.approx(initial, rel=0.05)
    assert (float(now.detach()) != pytest.approx(initial, rel=1e-6)) == learned


@pytest.mark.parametrize("n_critics", [1, 3])
def test_any_number_of_critics_trains(n_critics: int) -> None:
    model = make_model(policy_kwargs=dict(net_arch=[16], n_critics=n_critics)).learn(EPISODE + 2)
    assert len(model.critic.q_networks) == len(model.critic_target.q_networks) == n_critics
    assert th.isfinite(parameters(model.critic)).all()


@pytest.mark.parametrize(
    ("n_envs", "train_freq", "gradient_steps", "updates"),
    [
        (1, 4, 2, 16),  # after steps 12, 16, ..., 40
        (1, (4, "step"), -1, 32),
        (1, (1, "episode"), -1, 30),  # no updates during the first episode
        (2, (3, "step"), -1, 36),  # 12, 18, ..., 42 transitions
        (2, 5, 0, 0),
    ],
)
def test_train_freq_and_gradient_steps_count_as_in_sac(
    n_envs: int, train_freq: Any, gradient_steps: int, updates: int
) -> None:
    model = make_model(env=DummyVecEnv([pendulum] * n_envs), train_freq=train_freq, gradient_steps=gradient_steps)
    assert model.learn(40)._n_updates == updates


@pytest.mark.parametrize("venv_class", [DummyVecEnv, SubprocVecEnv])
def test_several_environments_train_with_gsde_and_action_noise(venv_class: type) -> None:
    options = dict(start_method="spawn") if venv_class is SubprocVecEnv else {}
    noise = NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))
    env = venv_class([unpaid_pendulum] * 2, **options)
    # gSDE must draw new noise for each of the actor updates of a call
    model = make_model(env=env, use_sde=True, sde_sample_freq=2, action_noise=noise, train_freq=10, gradient_steps=4)
    model.learn(40)
    assert model._n_updates == 8
    rewards = model.replay_buffer.rewards[:20]
    assert (rewards[1:] > 0).all()  # every environment got its bonus
    model.env.close()


def test_cnn_policy_takes_channel_last_images() -> None:
    env = images()
    model = make_model("CnnPolicy", env, policy_kwargs=dict(net_arch=[16], features_extractor_kwargs=dict(features_dim=8)))
    before = parameters(model.critic.features_extractor)
    model.learn(EPISODE + 2)
    assert is_vecenv_wrapped(model.get_env(), VecTransposeImage)
    assert not th.equal(before, parameters(model.critic.features_extractor))
    obs, _ = env.reset()
    assert model.predict(obs)[0].shape == env.action_space.shape


@pytest.mark.parametrize(("policy", "env"), [("MlpPolicy", pendulum), ("CnnPolicy", images)])
def test_actor_and_critic_share_one_encoder_or_train_one_each(policy: str, env: Any) -> None:
    shared = make_model(policy, env())
    assert shared.actor.features_extractor is shared.critic.features_extractor
    assert shared.critic_target.features_extractor is not shared.critic.features_extractor
    apart = make_model(policy, env(), policy_kwargs=dict(net_arch=[16], share_features_extractor=False))
    assert apart.actor.features_extractor is not apart.critic.features_extractor
    before = parameters(apart.actor.features_extractor), parameters(apart.critic.features_extractor)
    apart.learn(EPISODE + 2)
    after = parameters(apart.actor.features_extractor), parameters(apart.critic.features_extractor)
    assert not th.equal(before[0], after[0])
    assert not th.equal(before[1], after[1])


@pytest.mark.parametrize("share", [True, False])
@pytest.mark.parametrize("tau", [0.0, 1.0])
def test_the_target_encoder_stays_at_tau_0_and_is_a_copy_at_tau_1(tau: float, share: bool) -> None:
    model = with_data("CnnPolicy", images(), tau=tau, policy_kwargs=dict(net_arch=[16], share_features_extractor=share))
    first = parameters(model.critic)
    assert th.equal(parameters(model.critic_target), first)
    model.train(2, batch_size=8)
    assert not th.equal(parameters(model.critic), first)
    assert th.equal(parameters(model.critic_target), first if tau == 0 else parameters(model.critic))


def test_dict_observations_train_with_the_multi_input_policy() -> None:
    env = dicts()
    model = make_model("MultiInputPolicy", env).learn(EPISODE + 3)
    assert model._n_updates == 3
    obs, _ = env.reset()
    assert model.predict(obs)[0].shape == (4,)
    assert model.logger.name_to_value["rollout/intrinsic_reward"] > 0


def test_actions_of_any_shape_train() -> None:
    class Matrix(gym.Env):
        observation_space = spaces.Box(-1, 1, (2, 3))
        action_space = spaces.Box(-2, 5, (2, 2))

        def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
            super().reset(seed=seed)
            return np.zeros((2, 3), dtype=np.float32), {}

        def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
            return np.ones((2, 3), dtype=np.float32), 0.0, False, False, {}

    assert make_model(env=Matrix()).learn(EPISODE + 2).predict(np.zeros((2, 3)))[0].shape == (2, 2)


def test_hindsight_replay_trains_without_the_bonus() -> None:
    model = make_model(
        "MultiInputPolicy",
        BitFlippingEnv(n_bits=4, continuous=True),
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs=dict(n_sampled_goal=2),
        intrinsic_reward_scale=0.0,
    )
    assert model.learn(EPISODE + 5)._n_updates == 5


@pytest.mark.parametrize("bonus", [True, False])
def test_observations_may_be_normalised(bonus: bool) -> None:
    venv = DummyVecEnv([unpaid_pendulum])
    env: Any = VecNormalize(IntrinsicRewardVecEnv(venv) if bonus else venv, norm_reward=False)
    model = make_model(env=env, intrinsic_reward_scale=float(bonus)).learn(EPISODE + 5)
    assert model.get_env() is env
    assert env.obs_rms.count > EPISODE
    assert (model.replay_buffer.rewards[1 : EPISODE + 5] > 0).all() == bonus


def test_evaluation_under_vecnormalize_shares_its_statistics_and_sees_no_bonus() -> None:
    paid = partial(pendulum, reward=1.0)
    env: Any = VecNormalize(IntrinsicRewardVecEnv(DummyVecEnv([paid])), norm_reward=False)
    eval_env: Any = VecNormalize(IntrinsicRewardVecEnv(DummyVecEnv([paid])), norm_reward=False, training=False)
    callback = EvalCallback(eval_env, eval_freq=20, n_eval_episodes=2, verbose=0, warn=False)
    make_model(env=env).learn(20, callback)
    assert callback.last_mean_reward == EPISODE
    np.testing.assert_array_equal(eval_env.obs_rms.mean, env.obs_rms.mean)
    assert env.obs_rms.count > 20  # the statistics are not those of an empty environment


def test_sb3s_callbacks_save_checkpoints_and_stop_training(tmp_path: Path) -> None:
    env = VecNormalize(IntrinsicRewardVecEnv(DummyVecEnv([pendulum])), norm_reward=False)
    checkpoint = CheckpointCallback(8, str(tmp_path), save_replay_buffer=True, save_vecnormalize=True)
    model = make_model(env=env).learn(100, [checkpoint, StopTrainingOnMaxEpisodes(max_episodes=2)])
    assert model.num_timesteps == 2 * EPISODE
    kinds = ("rl_model_{}_steps.zip", "rl_model_replay_buffer_{}_steps.pkl", "rl_model_vecnormalize_{}_steps.pkl")
    assert {path.name for path in tmp_path.iterdir()} == {kind.format(step) for kind in kinds for step in (8, 16)}
    loaded: Any = BisimSAC.load(tmp_path / "rl_model_16_steps")
    loaded.load_replay_buffer(tmp_path / "rl_model_replay_buffer_16_steps.pkl")
    assert loaded.num_timesteps == 16
    assert loaded._n_updates == 5
    assert loaded.replay_buffer.size() == 15  # the callback runs before the transition is stored


class Counting(gym.Env):
    """Observes the number of the step, up to 10."""

    observation_space = spaces.Box(0, EPISODE, (1,))
    action_space = spaces.Box(-1, 1, (1,))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.step_number = 0
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.step_number += 1
        return np.full(1, self.step_number, dtype=np.float32), 0.0, self.step_number == EPISODE, False, {}


@pytest.mark.parametrize("error", [None, KeyboardInterrupt])
@pytest.mark.parametrize("step", [3, EPISODE])
def test_training_goes_on_in_a_new_episode_after_a_callback_has_stopped_it(step: int, error: Any) -> None:
    model = make_model(env=Counting())
    with nullcontext() if error is None else pytest.raises(error):
        model.learn(100, StopAt(step, error))
    model.learn(20, reset_num_timesteps=False)
    buffer = model.replay_buffer
    assert buffer.size() == step - 1 + 20  # the callback runs before the transition is stored
    np.testing.assert_array_equal(buffer.next_observations[: buffer.pos] - buffer.observations[: buffer.pos], 1)


def test_training_from_pixels_goes_on_after_a_callback_has_stopped_it() -> None:
    model = make_model("CnnPolicy", VecFrameStack(DummyVecEnv([images]), 3))
    model.learn(100, StopAt(13)).learn(7, reset_num_timesteps=False)
    assert model.replay_buffer.size() == 12 + 7


def test_hindsight_replay_ends_the_episode_that_a_callback_has_cut_off() -> None:
    env = BitFlippingEnv(n_bits=4, continuous=True, max_steps=5)
    model = make_model("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, intrinsic_reward_scale=0.0)
    with pytest.warns(UserWarning, match="will be truncated"):
        model.learn(100, StopAt(4))
    model.learn(20, reset_num_timesteps=False)
    buffer = model.replay_buffer
    assert buffer.dones[2]  # of the transitions 0 to 2, which were stored
    assert buffer.ep_start[2] + buffer.ep_length[2] == 3


@pytest.mark.parametrize("share", [True, False])
def test_batch_norm_and_dropout_act_only_in_training(share: bool) -> None:
    policy_kwargs = dict(net_arch=[16], features_extractor_class=NormDropout, share_features_extractor=share)
    model = with_data(policy_kwargs=policy_kwargs, tau=0.0, target_update_interval=2)
    nets = (model.critic, model.critic_target, model.actor)
    norm, target_norm, actor_norm = (net.features_extractor.norm for net in nets)
    assert norm.running_mean.eq(0).all()  # acting and the bonus do not change the statistics
    obs = np.ones((4, 3), dtype=np.float32)
    np.testing.assert_array_equal(model.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])

    model.train(1, batch_size=8)
    assert model.policy.training
    assert model.policy.representation.dynamics.training
    assert not model.critic_target.features_extractor.training
    assert norm.running_mean.ne(0).all()
    assert actor_norm.running_mean.ne(0).all()
    assert target_norm.running_mean.eq(0).all()
    model.train(1, batch_size=8)
    th.testing.assert_close(target_norm.running_mean, norm.running_mean)  # copied, not averaged by tau

    before = norm.running_mean.clone(), actor_norm.running_mean.clone()
    model.learn(EPISODE)
    model.predict(obs)
    assert not model.policy.training
    assert not model.policy.representation.dynamics.training
    th.testing.assert_close((norm.running_mean, actor_norm.running_mean), before, rtol=0, atol=0)


@pytest.mark.parametrize("dynamics", DYNAMICS)
def test_the_same_seed_gives_the_same_run(dynamics: Any) -> None:
    runs = [make_model(seed=seed, dynamics=dynamics, device="cpu").learn(2 * EPISODE) for seed in (1, 1, 2)]
    same, again, other = (parameters(model.policy) for model in runs)
    assert th.equal(same, again)
    assert not th.equal(same, other)
    np.testing.assert_array_equal(runs[0].replay_buffer.rewards, runs[1].replay_buffer.rewards)


def test_predict_gives_actions_of_the_space_for_one_observation_and_for_many() -> None:
    model = make_model(env=gym.wrappers.RescaleAction(pendulum(), np.float32(3), np.float32(5))).learn(EPISODE + 2)
    space, obs = model.action_space, np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    one, state = model.predict(obs[0], deterministic=True)
    many, _ = model.predict(obs, deterministic=True)
    assert one.shape == (1,)
    assert many.shape == (50, 1)
    assert one.dtype == many.dtype == space.dtype
    assert state is None
    np.testing.assert_allclose(many[0], one, rtol=1e-5)
    drawn = model.predict(obs)[0]
    assert not np.allclose(drawn, many)
    assert all(space.contains(action) for action in drawn)  # in [3, 5], not in the buffer's [-1, 1]


def test_net_arch_optimizer_and_the_users_dict_are_respected() -> None:
    policy_kwargs: dict[str, Any] = dict(
        net_arch=dict(pi=[5], qf=[7, 6]), optimizer_class=th.optim.AdamW, optimizer_kwargs=dict(weight_decay=0.3)
    )
    before = deepcopy(policy_kwargs)
    model = make_model(policy_kwargs=policy_kwargs).learn(EPISODE + 2)
    assert [layer.out_features for layer in model.actor.latent_pi if isinstance(layer, nn.Linear)] == [5]
    assert [layer.out_features for layer in model.critic.q_networks[0] if isinstance(layer, nn.Linear)] == [7, 6, 1]
    for optimizer in (model.actor.optimizer, model.critic.optimizer):
        assert isinstance(optimizer, th.optim.AdamW)
        assert optimizer.param_groups[0]["weight_decay"] == 0.3
    assert policy_kwargs == before


def test_optimizer_settings_unknown_to_adams_fused_kernel_are_accepted() -> None:
    policy_kwargs = dict(net_arch=[16], optimizer_kwargs=dict(differentiable=True))
    assert make_model(policy_kwargs=policy_kwargs).actor.optimizer.param_groups[0]["differentiable"]


@pytest.mark.parametrize("share", [True, False])
def test_training_does_not_change_a_frozen_encoder(share: bool) -> None:
    class Pretrained(MlpEncoder):
        def __init__(self, observation_space: gym.Space) -> None:
            super().__init__(observation_space)
            self.requires_grad_(False)

    policy_kwargs = dict(features_extractor_class=Pretrained, share_features_extractor=share, net_arch=[16])
    model = make_model(policy_kwargs=policy_kwargs)
    encoders = [model.critic.features_extractor, model.actor.features_extractor]
    before = [parameters(encoder) for encoder in encoders]
    mu = parameters(model.actor.mu)
    model.learn(EPISODE + 4)
    assert all(th.equal(old, parameters(encoder)) for old, encoder in zip(before, encoders, strict=True))
    assert not th.equal(mu, parameters(model.actor.mu))


def test_the_schedule_reaches_every_optimizer_except_that_of_the_inverse_dynamics() -> None:
    model = make_model(learning_rate=lambda remaining: 1e-3 * (1 + remaining))
    optimizers = model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer
    assert [learning_rate_of(optimizer) for optimizer in optimizers] == [2e-3] * 3
    model.learn(2 * EPISODE)
    assert [learning_rate_of(optimizer) for optimizer in optimizers] == [1e-3] * 3
    assert learning_rate_of(model.policy.representation.inverse_dynamics.optimizer) == 1e-4


def test_delays_count_all_updates_even_with_one_gradient_step_per_call() -> None:
    model = with_data(policy_delay=2, target_update_interval=3, tau=1.0)
    actor_moved, entropy_moved, target_moved = [], [], []
    for update in range(1, 7):
        actor, target, log_ent_coef = parameters(model.actor.mu), parameters(model.critic_target), model.log_ent_coef.item()
        model.train(1, batch_size=8)
        actor_moved += [update] * (not th.equal(actor, parameters(model.actor.mu)))
        entropy_moved += [update] * (log_ent_coef != model.log_ent_coef.item())
        target_moved += [update] * (not th.equal(target, parameters(model.critic_target)))
    assert actor_moved == entropy_moved == [2, 4, 6]
    assert target_moved == [3, 6]


def test_the_initial_gradient_steps_happen_once() -> None:
    model = make_model(initial_gradient_steps=7)
    counts = [model.learn(1, reset_num_timesteps=False)._n_updates for _ in range(EPISODE + 3)]
    assert counts == [0] * EPISODE + [7, 8, 9]


def test_images_of_floats_are_encoded_without_division_by_255() -> None:
    class FloatImages(gym.ObservationWrapper):
        def __init__(self, env: gym.Env) -> None:
            super().__init__(env)
            self.observation_space = spaces.Box(0, 1, (1, 12, 12), np.float32)

        def observation(self, observation: np.ndarray) -> np.ndarray:
            return observation.reshape(1, 12, 12).astype(np.float32) / 255

    policy_kwargs = dict(normalize_images=False, net_arch=[16])
    model = make_model("CnnPolicy", FloatImages(images()), policy_kwargs=policy_kwargs).learn(EPISODE + 4)
    encoder, seen = model.critic.features_extractor, []
    encoder.extractor.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    obs = th.rand(2, 1, 12, 12)
    encoder.encode(obs)
    assert th.equal(seen[0], obs)  # not divided by 255


def test_one_setting_of_the_inverse_dynamics_optimizer_keeps_the_other_defaults() -> None:
    policy_kwargs = dict(inverse_dynamics_optimizer_kwargs=dict(weight_decay=0.0, foreach=True), net_arch=[16])
    policy = make_model(policy_kwargs=policy_kwargs).policy
    group = policy.representation.inverse_dynamics.optimizer.param_groups[0]
    assert (group["lr"], group["weight_decay"], group["foreach"]) == (1e-4, 0.0, True)
