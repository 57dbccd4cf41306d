import io
import pathlib
from collections.abc import Iterable
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import check_for_correct_spaces, polyak_update
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_wrapper
from stable_baselines3.sac.sac import SAC
from torch.nn import functional as F

from sb3_robust_bisim import losses
from sb3_robust_bisim.checks import check_arguments, check_names
from sb3_robust_bisim.fast_paths import unchecked_distributions
from sb3_robust_bisim.intrinsic_reward import IntrinsicRewardVecEnv, with_intrinsic_reward
from sb3_robust_bisim.last_embedding import LastEmbedding
from sb3_robust_bisim.latent_models import Dynamics
from sb3_robust_bisim.losses import Distance
from sb3_robust_bisim.policies import BisimActor, BisimCritic, BisimPolicy, CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_robust_bisim.runs.atomic import atomic_save
from sb3_robust_bisim.update_log import UpdateLog, embedding_statistics

SelfBisimSAC = TypeVar("SelfBisimSAC", bound="BisimSAC")


class BisimSAC(SAC):
    """
    Soft Actor-Critic whose encoder is shaped by a robust on-policy bisimulation metric.

    Paper: Towards Robust Bisimulation Metric Learning (Kemertas and Aumentado-Armstrong, NeurIPS 2021).

    One encoder z = phi(s), owned by the critic, is trained by critic, metric, dynamics, reward and inverse-dynamics
    loss in one backward pass, and never by the actor loss. Each batch is encoded once.

    The paper's methods are settings: SAC is ``bisim_coef=0, norm_constraint=False``; DBC ``norm_constraint=False``;
    normed DBC the default; normed-IR adds ``intrinsic_reward_scale``, normed-ID ``inverse_dynamics_coef``.

    :param policy: "MlpPolicy", "CnnPolicy", "MultiInputPolicy" or a subclass of ``BisimPolicy``
    :param env: the environment, or its id
    :param bisim_coef: weight of the metric loss (eq:general-bisim-loss), >= 0; 0 turns it off
    :param c_r: c_R, weight of the reward gap in the metric, >= 0
    :param c_t: c_T, weight of the transition term, in [0, 1). None: ``gamma``
    :param reward_range: (R_min, R_max) of one agent step: action repeat sums rewards. It sets the radius of the norm
        constraint. The bonus is not counted, and the paper takes (0, 1) for all its tasks
    :param norm_constraint: hold embeddings and predictions in the L2 ball of eq:constraint, with radius
        c_R (R_max - R_min) / (2 (1 - c_T)). Between points of it only ``distance="l2"`` is at most the metric's diameter
    :param distance: "huber" (elementwise, the paper's experiments), "l1" or "l2" (norms of the whole embedding);
        see :func:`sb3_robust_bisim.losses.pairwise_distance`
    :param dynamics: "deterministic", "probabilistic" (Gaussian) or "ensemble" (5 Gaussians)
    :param model_coef: weight of dynamics and reward loss, >= 0. None: 1 where a model is needed, that is with
        ``bisim_coef`` or ``intrinsic_reward_scale`` above 0, else 0
    :param intrinsic_reward_scale: eta_r >= 0; 0 gives no bonus
    :param intrinsic_reward_max: R_max_I >= 0, the largest bonus, in units of reward; clamped after scaling
    :param inverse_dynamics_coef: eta_d >= 0, weight of the inverse-dynamics loss; 0 turns it off
    :param policy_delay: actor and entropy coefficient are updated every ``policy_delay``-th gradient step. The target
        nets follow SAC's ``target_update_interval``
    :param initial_gradient_steps: gradient steps to do at once when learning starts, on the random actions gathered until
        then (1000 in the published experiments)
    :param bf16: run the encoder under bfloat16 autocast, on CPU or GPU: faster from pixels, where the convolutions are the
        cost. Heads, models and losses stay in fp32: a Q value of 50 in bf16 is off by up to 0.1
    :param kwargs: the arguments of :class:`stable_baselines3.SAC`; ``n_steps`` must stay 1

    :raises ValueError: for a value outside its range, ``n_steps`` other than 1, image observations with MlpPolicy, a
        VecNormalize that normalises rewards, an IntrinsicRewardVecEnv outside of VecNormalize, HER with a bonus
    :raises TypeError: for an argument that does not exist

    Example::

        model = BisimSAC("MlpPolicy", "robust_bisim/SparseCartPole-v0", intrinsic_reward_scale=2.0, inverse_dynamics_coef=1.0)
        model.learn(10_000, progress_bar=True)
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy: BisimPolicy
    actor: BisimActor
    critic: BisimCritic
    critic_target: BisimCritic

    def __init__(
        self,
        policy: str | type[BisimPolicy],
        env: GymEnv | str,
        *,
        bisim_coef: float = 0.5,
        c_r: float = 1.0,
        c_t: float | None = None,
        reward_range: tuple[float, float] = (0.0, 1.0),
        norm_constraint: bool = True,
        distance: Distance = "huber",
        dynamics: Dynamics = "deterministic",
        model_coef: float | None = None,
        intrinsic_reward_scale: float = 0.0,
        intrinsic_reward_max: float = 0.1,
        inverse_dynamics_coef: float = 0.0,
        policy_delay: int = 2,
        initial_gradient_steps: int = 0,
        bf16: bool = False,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ) -> None:
        check_names(BisimSAC, kwargs)
        if kwargs.get("policy_kwargs") is not None:
            kwargs["policy_kwargs"] = dict(kwargs["policy_kwargs"])  # SB3 writes into it
        super().__init__(policy, env, _init_setup_model=False, **kwargs)
        self.bisim_coef = bisim_coef
        self.c_r = c_r
        self.c_t = c_t
        self.reward_range = reward_range
        self.norm_constraint = norm_constraint
        self.distance = distance
        self.dynamics = dynamics
        self.model_coef = model_coef
        self.intrinsic_reward_scale = intrinsic_reward_scale
        self.intrinsic_reward_max = intrinsic_reward_max
        self.inverse_dynamics_coef = inverse_dynamics_coef
        self.policy_delay = policy_delay
        self.initial_gradient_steps = initial_gradient_steps
        self.bf16 = bf16
        self._last_embedding = LastEmbedding()

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        check_arguments(self)
        if self.env is not None:
            self.env = self._bind_intrinsic_reward(self.env)
        policy_kwargs = self.policy_kwargs
        # The policy learns of our own arguments here and not in __init__, so that `load(..., c_t=0.5)` reaches it, and
        # the user's dict is saved as it was given
        self.policy_kwargs = {**policy_kwargs, "radius": self.radius, "dynamics": self.dynamics, "bf16": self.bf16}
        super()._setup_model()
        self.policy_kwargs = policy_kwargs

    @property
    def radius(self) -> float | None:
        """Radius of the ball that holds the embeddings (eq:constraint), None without ``norm_constraint``."""
        return losses.ball_radius(self.c_r, self._c_t, self.reward_range) if self.norm_constraint else None

    @property
    def _c_t(self) -> float:
        return self.gamma if self.c_t is None else self.c_t

    @property
    def _model_coef(self) -> float:
        if self.model_coef is None:
            return 1.0 if self.bisim_coef > 0 or self.intrinsic_reward_scale > 0 else 0.0
        return self.model_coef

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        with unchecked_distributions():
            self._train(gradient_steps, batch_size)

    def _train(self, gradient_steps: int, batch_size: int) -> None:
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        # Update optimizers learning rate; the inverse-dynamics model keeps its own
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers += [self.ent_coef_optimizer]
        self._update_learning_rate(optimizers)

        if self._n_updates == 0:
            gradient_steps = max(gradient_steps, self.initial_gradient_steps)
        inverse_dynamics = self.policy.inverse_dynamics
        actor_parameters = self.policy.actor_parameters()
        log = UpdateLog()

        for _ in range(gradient_steps):
            self._n_updates += 1
            # Sample replay buffer
            replay_data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)  # type: ignore[union-attr]
            obs = self.critic.preprocess(replay_data.observations)
            next_obs = self.critic.preprocess(replay_data.next_observations)

            # We need to sample because `log_std` may have changed between two gradient steps
            if self.use_sde:
                self.actor.reset_noise()

            # The only place where the batch is encoded, but for the target encoder and an encoder that the actor owns
            z = self.critic.embed(obs)
            with th.set_grad_enabled(self.inverse_dynamics_coef > 0):
                next_z = self.critic.embed(next_obs)

            ent_coef = self.ent_coef_tensor if self.log_ent_coef is None else th.exp(self.log_ent_coef.detach())
            with th.no_grad():
                # Select action according to policy
                next_actions, next_log_prob = self.actor.features_log_prob(self.actor.features(next_obs, next_z))
                # Compute the next Q values: min over all critics targets
                next_q_values = self.critic_target.q_values(self.critic_target.embed(next_obs), next_actions)
                next_q_value = th.cat(next_q_values, dim=1).min(dim=1, keepdim=True).values
                # add entropy term
                next_q_value = next_q_value - ent_coef * next_log_prob.reshape(-1, 1)
                # td error + entropy term
                target_q_value = replay_data.rewards + (1 - replay_data.dones) * self.gamma * next_q_value

            # Compute critic loss. No factor 0.5: it is one summand of the encoder's loss, weighted as published
            current_q_values = self.critic.q_values(z, replay_data.actions)
            critic_loss = th.stack([F.mse_loss(q, target_q_value) for q in current_q_values]).sum()
            representation_loss, values = self._representation_losses(z, next_z, replay_data.actions, replay_data.rewards)
            step = {"train/critic_loss": critic_loss, **values}

            # Optimize encoder, critic and models, in one backward pass
            self.critic.optimizer.zero_grad()
            inverse_dynamics.optimizer.zero_grad()
            (critic_loss + representation_loss).backward()
            self.critic.optimizer.step()
            inverse_dynamics.optimizer.step()

            if self._n_updates % self.policy_delay == 0:
                # Action by the current actor for the sampled state
                actions_pi, log_prob = self.actor.features_log_prob(self.actor.features(obs, z))
                log_prob = log_prob.reshape(-1, 1)
                # Min over all critic networks
                min_qf_pi = th.cat(self.critic.q_values(z.detach(), actions_pi), dim=1).min(dim=1, keepdim=True).values
                step["train/actor_loss"] = (ent_coef * log_prob - min_qf_pi).mean()

                # Optimize the actor, and compute no gradient of anything else
                self.actor.optimizer.zero_grad()
                step["train/actor_loss"].backward(inputs=actor_parameters)
                self.actor.optimizer.step()

                # Optimize entropy coefficient, also called
                # entropy temperature or alpha in the paper
                if self.ent_coef_optimizer is not None and self.log_ent_coef is not None:
                    assert isinstance(self.target_entropy, float)
                    ent_coef_loss = -(self.log_ent_coef * (log_prob + self.target_entropy).detach()).mean()
                    step["train/ent_coef_loss"] = ent_coef_loss
                    self.ent_coef_optimizer.zero_grad()
                    ent_coef_loss.backward()
                    self.ent_coef_optimizer.step()

            # Update target networks. SAC tests the loop index, which is always 0 at `gradient_steps=1`
            if self._n_updates % self.target_update_interval == 0:
                polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
                # Copy running stats, see GH issue #996
                polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)

            step["train/ent_coef"] = ent_coef
            log.add(self._n_updates, step)

        if gradient_steps > 0:
            log.add(self._n_updates, embedding_statistics(z.detach(), self.radius))
            self._record(log.means())

    def _representation_losses(
        self, z: th.Tensor, next_z: th.Tensor, actions: th.Tensor, rewards: th.Tensor
    ) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """
        What shapes the encoder beside the critic.

        :param z: (B, n) embeddings, with gradient
        :param next_z: (B, n) embeddings of the successors; only the inverse-dynamics loss sends gradient through them
        :param actions: (B, n_a) in [-1, 1]
        :param rewards: (B, 1)
        :return: the weighted sum of the losses, and by TensorBoard key each loss without its weight, and the metric's means
        """
        total, values = z.new_zeros(()), {}
        if self.bisim_coef > 0 or self._model_coef > 0:
            prediction = self.policy.dynamics(z, actions)
        if self._model_coef > 0:
            predicted_rewards = self.policy.reward_model(self.policy.dynamics.sample(prediction))
            values["train/dynamics_loss"] = losses.dynamics_loss(prediction.mean, prediction.std, next_z)
            values["train/reward_loss"] = F.mse_loss(predicted_rewards, rewards)
            total = total + self._model_coef * (values["train/dynamics_loss"] + values["train/reward_loss"])
        if self.bisim_coef > 0:
            mean, std = prediction.moments()
            pairs = th.randperm(len(z), device=z.device)
            values["train/bisim_loss"], values["bisim/mu_bd"], values["bisim/mu_rd"] = losses.bisim_loss(
                z, rewards, mean, std, pairs, self.c_r, self._c_t, self.distance
            )
            total = total + self.bisim_coef * values["train/bisim_loss"]
        if self.inverse_dynamics_coef > 0:
            predicted_actions = self.policy.inverse_dynamics(z, next_z)
            values["train/inverse_dynamics_loss"] = losses.inverse_dynamics_loss(predicted_actions, actions)
            total = total + self.inverse_dynamics_coef * values["train/inverse_dynamics_loss"]
        return total, values

    def _record(self, means: dict[str, float]) -> None:
        """:param means: by TensorBoard key, over the updates of one call"""
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, mean in means.items():
            self.logger.record(name, mean)
        if self.bisim_coef > 0:
            self.logger.record("bisim/mu_ratio_target", self.c_r / (1 - self._c_t))
            if means["bisim/mu_rd"] > 0:  # all rewards equal: no ratio
                self.logger.record("bisim/mu_ratio", means["bisim/mu_bd"] / means["bisim/mu_rd"])

    @th.no_grad()
    def _intrinsic_reward(self, obs: Any, actions: np.ndarray, next_obs: Any) -> np.ndarray:
        """
        The bonus of transitions as the environment sees them (sec:intrinsic).

        :param obs: unnormalised observations, n_envs rows
        :param actions: (n_envs, n_a) in the scale of the action space
        :param next_obs: true successors
        :return: (n_envs,)
        """
        if self._vec_normalize_env is not None:
            obs, next_obs = self._vec_normalize_env.normalize_obs(obs), self._vec_normalize_env.normalize_obs(next_obs)
        z, next_z = self._embed(obs), self._embed(next_obs, known=False)
        scaled_actions = th.as_tensor(self.policy.scale_action(actions), dtype=th.float32, device=self.device).flatten(1)
        mean, _ = self.policy.dynamics(z, scaled_actions).moments()
        return losses.intrinsic_reward(mean, next_z, self.intrinsic_reward_scale, self.intrinsic_reward_max).cpu().numpy()

    def _embed(self, obs: Any, known: bool = True) -> th.Tensor:
        """
        Embed what is observed while collecting: once under the same weights, though policy and bonus both ask for it.

        :param obs: n_envs rows, as the policy sees them
        :param known: whether ``obs`` may have been embedded before
        :return: (n_envs, n)
        """
        z = self._last_embedding.find(obs, self._n_updates) if known else None
        if z is None:
            z = self.critic.encode(self.policy.obs_to_tensor(obs)[0])
            self._last_embedding.keep(obs, z, self._n_updates)
        return z

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        warmup = self.num_timesteps < learning_starts
        if warmup or self.intrinsic_reward_scale == 0 or action_noise is not None or not self.policy.share_features_extractor:
            return super()._sample_action(learning_starts, action_noise, n_envs)
        # The same action, bit by bit, on an embedding that the bonus has computed already or can use afterwards
        with th.no_grad():
            squashed = self.actor.sample(self._embed(self._last_obs)).cpu().numpy()
        squashed = squashed.reshape(n_envs, *self.action_space.shape)  # type: ignore[misc]
        buffer_action = self.policy.scale_action(self.policy.unscale_action(squashed))
        return self.policy.unscale_action(buffer_action), buffer_action

    def _bind_intrinsic_reward(self, env: VecEnv) -> VecEnv:
        """Bind the bonus to the wrapper in the chain; without a bonus, unbind it, for another model may have been there."""
        env, wrapper = with_intrinsic_reward(env, self.observation_space, self.intrinsic_reward_scale)
        if wrapper is not None:
            wrapper.bind(self._intrinsic_reward if self.intrinsic_reward_scale > 0 else None)
        return env

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        env = self._wrap_env(env, self.verbose)
        check_for_correct_spaces(env, self.observation_space, self.action_space)
        before = self.env
        if env.num_envs == self.n_envs:  # SB3 refuses any other number, and then nothing shall be bound
            env = self._bind_intrinsic_reward(env)
        super().set_env(env, force_reset)
        if before is not None and before is not self.env:  # nobody learns from the old one's bonus any more
            old = unwrap_vec_wrapper(before, IntrinsicRewardVecEnv)
            if old is not None and old is not unwrap_vec_wrapper(self.env, IntrinsicRewardVecEnv):  # type: ignore[arg-type]
                old.bind(None)

    @classmethod
    def load(
        cls: type[SelfBisimSAC],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfBisimSAC:
        """Like SB3's ``load``; ``kwargs`` replace what the model was saved with, and must be arguments that exist."""
        check_names(cls, kwargs)
        return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)

    def _store_transition(
        self, replay_buffer: ReplayBuffer, buffer_action: np.ndarray, new_obs: Any, reward: np.ndarray, *args: Any
    ) -> None:
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, *args)
        infos = args[-1]
        if "intrinsic_reward" in infos[0]:
            self.logger.record_mean("rollout/intrinsic_reward", float(np.mean([info["intrinsic_reward"] for info in infos])))

    def learn(
        self: SelfBisimSAC,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "BisimSAC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfBisimSAC:
        self._last_embedding.forget()  # weights or environment may have been replaced since
        if self.env is not None:  # another model on the same environments may have bound its own bonus
            self.env = self._bind_intrinsic_reward(self.env)
        return super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Like SB3's ``save``; a file that existed before stays whole until the new one is."""
        with atomic_save(path, ".zip") as whole:
            super().save(whole, exclude, include)

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """Like SB3's ``save_replay_buffer``; a file that existed before stays whole until the new one is."""
        with atomic_save(path, ".pkl") as whole:
            super().save_replay_buffer(whole)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_last_embedding"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, tensors = super()._get_torch_save_params()
        return [*state_dicts, "policy.inverse_dynamics.optimizer"], tensors
