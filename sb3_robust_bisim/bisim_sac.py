import inspect
from typing import Any, Self

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import check_for_correct_spaces, polyak_update
from stable_baselines3.sac.sac import SAC
from torch.nn import functional as F

from sb3_robust_bisim.checks import check_arguments, check_names, checked_env
from sb3_robust_bisim.data_checks import checked
from sb3_robust_bisim.frame_buffer import choose_buffer
from sb3_robust_bisim.heads import BisimActor, BisimCritic
from sb3_robust_bisim.intrinsic_reward import bound, with_intrinsic_reward
from sb3_robust_bisim.objective import Objective
from sb3_robust_bisim.policies import POLICIES, BisimPolicy
from sb3_robust_bisim.runs.atomic import PathOrStream
from sb3_robust_bisim.runs.interruptible import Interruptible
from sb3_robust_bisim.update_log import UpdateLog, unchecked_distributions


class BisimSAC(Interruptible, SAC):
    """
    Soft Actor-Critic whose encoder is shaped by a robust on-policy bisimulation metric (Kemertas and Aumentado-Armstrong,
    2021). One encoder z = phi(s), owned by the critic, is trained by critic, metric, dynamics, reward and inverse-dynamics
    loss in one backward pass, and never by the actor loss. zoo_configs/bisim_sac.yml names the settings of each method.

    :param policy: "MlpPolicy", "CnnPolicy", "MultiInputPolicy" or a subclass of ``BisimPolicy``
    :param env: the environment, or its id
    :param bisim_coef: weight of the metric loss (eq:general-bisim-loss), >= 0; 0 turns it off
    :param c_r: c_R, weight of the reward gap in the metric, >= 0
    :param c_t: c_T, weight of the transition term, in [0, 1). None: ``gamma``
    :param reward_range: (R_min, R_max) of one agent step: action repeat sums rewards. It sets the radius of the norm
        constraint. The bonus is not counted; the paper takes (0, 1) for all its tasks. ``learn()`` warns if it is too narrow
    :param norm_constraint: hold embeddings and predictions in the L2 ball of eq:constraint, with radius
        c_R (R_max - R_min) / (2 (1 - c_T)). Of all distances, it limits only ``distance="l2"`` to the metric's largest
        value. "sphere": scale embeddings to length 1 (SimSR)
    :param distance: "huber" (elementwise, the paper's), "l1", "l2", "mico", "cosine" or "rap"; :mod:`sb3_robust_bisim.losses`
    :param metric_kwargs: other settings of the metric, such as ``dict(successors="sample", absorbing=True)``; see
        :class:`sb3_robust_bisim.metrics.Metric`
    :param dynamics: "deterministic", "probabilistic" (Gaussian) or "ensemble" (5 Gaussians)
    :param nll_beta: in [0, 1], for Gaussian dynamics: 0 is the likelihood, above 0 beta-NLL; see ``losses.dynamics_loss``
    :param model_coef: weight of dynamics and reward loss, >= 0. None: 1 where a model is needed, that is with
        ``bisim_coef`` or ``intrinsic_reward_scale`` above 0, else 0
    :param reward_coef: weight of the reward loss where it differs from ``model_coef``, >= 0
    :param intrinsic_reward_scale: eta_r >= 0; 0 gives no bonus
    :param intrinsic_reward_max: R_max_I >= 0, the largest bonus, in units of reward
    :param inverse_dynamics_coef: eta_d >= 0, weight of the inverse-dynamics loss; 0 turns it off
    :param policy_delay: gradient steps from one update of actor and entropy coefficient to the next. The target nets follow
        SAC's ``target_update_interval``
    :param initial_gradient_steps: gradient steps done at once when learning starts (1000 in the published experiments)
    :param random_shift: shift the images of each batch by up to this many pixels (DrQ), s and s' by different amounts; 0: off
    :param bf16: run the encoder under bfloat16 autocast: meant for pixels on a GPU, or on a CPU that has it (see
        docs/performance.md). Heads, models and losses stay in fp32
    :param kwargs: the arguments of :class:`stable_baselines3.SAC`; ``n_steps`` must stay 1. Byte images go to a
        :class:`~sb3_robust_bisim.FrameStackReplayBuffer` unless another ``replay_buffer_class`` is named
    :raises ValueError: for a value outside its range, arguments that contradict each other, and wrappers in a wrong order or
        that normalise rewards; from ``learn()`` for an observation, a reward, an action or a loss that is not finite
    :raises TypeError: for an argument that does not exist

    Example::

        model = BisimSAC("MlpPolicy", "robust_bisim/SparseCartPole-v0", intrinsic_reward_scale=2.0, inverse_dynamics_coef=1.0)
        model.learn(10_000, progress_bar=True)
    """

    policy_aliases = POLICIES
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
        norm_constraint: bool | str = True,
        distance: str = "huber",
        metric_kwargs: dict[str, Any] | None = None,
        dynamics: str = "deterministic",
        nll_beta: float = 1.0,
        model_coef: float | None = None,
        reward_coef: float | None = None,
        intrinsic_reward_scale: float = 0.0,
        intrinsic_reward_max: float = 0.1,
        inverse_dynamics_coef: float = 0.0,
        policy_delay: int = 2,
        initial_gradient_steps: int = 0,
        random_shift: int = 0,
        bf16: bool = False,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ) -> None:
        check_names(BisimSAC, kwargs)
        if kwargs.get("policy_kwargs") is not None:
            kwargs["policy_kwargs"] = dict(kwargs["policy_kwargs"])  # SB3 writes into it
        super().__init__(policy, checked_env(env, kwargs.get("verbose", 0)), _init_setup_model=False, **kwargs)
        self.bisim_coef = bisim_coef
        self.c_r = c_r
        self.c_t = c_t
        self.reward_range = reward_range
        self.norm_constraint = norm_constraint
        self.distance = distance
        self.metric_kwargs = metric_kwargs
        self.dynamics = dynamics
        self.nll_beta = nll_beta
        self.model_coef = model_coef
        self.reward_coef = reward_coef
        self.intrinsic_reward_scale = intrinsic_reward_scale
        self.intrinsic_reward_max = intrinsic_reward_max
        self.inverse_dynamics_coef = inverse_dynamics_coef
        self.policy_delay = policy_delay
        self.initial_gradient_steps = initial_gradient_steps
        self.random_shift = random_shift
        self.bf16 = bf16

        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        objective = Objective.of(self)
        check_arguments(self)
        if self.env is not None:
            self.env = with_intrinsic_reward(self.env, self.observation_space, self.intrinsic_reward_scale)
        choose_buffer(self)
        # here and not in __init__: `load(..., c_t=0.5)` reaches the policy, and the user's dict is saved as it was given
        policy_kwargs = self.policy_kwargs
        self.policy_kwargs = {**policy_kwargs, "objective": objective, "bf16": self.bf16, "random_shift": self.random_shift}
        super()._setup_model()
        self.policy_kwargs = policy_kwargs
        if self.use_sde and self.device.type != "cpu":  # SB3 draws the first noise before it moves the policy
            self.policy.reset_noise()

    @property
    def radius(self) -> float | None:
        """Radius of the ball that holds the embeddings (eq:constraint), None without ``norm_constraint``."""
        return self.policy.objective.radius

    @unchecked_distributions()
    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        # Update optimizers learning rate
        optimizers = [self.actor.optimizer, self.critic.optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers += [self.ent_coef_optimizer]

        # Update learning rate according to lr schedule
        self._update_learning_rate(optimizers)

        representation, actor_parameters = self.policy.representation, self.policy.actor_parameters()
        online, targets = ([param.detach() for param in net.parameters()] for net in (self.critic, self.critic_target))
        inverse_dynamics_optimizer = representation.inverse_dynamics.optimizer
        log = UpdateLog()
        if self._n_updates == 0:
            gradient_steps = max(gradient_steps, self.initial_gradient_steps)

        for _ in range(gradient_steps):
            self._n_updates += 1
            # Sample replay buffer
            replay_data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)  # type: ignore[union-attr]
            # From here on observations are encoded, each one once
            replay_data, batch = self.policy.encode(replay_data)

            # We need to sample because `log_std` may have changed between two gradient steps
            if self.use_sde:
                self.actor.reset_noise()

            update_actor = self._n_updates % self.policy_delay == 0
            if update_actor:
                # Action by the current actor for the sampled state
                actions_pi, log_prob = self.actor.action_log_prob(replay_data.observations)
                log_prob = log_prob.reshape(-1, 1)

            ent_coef_loss = None
            if self.ent_coef_optimizer is not None and self.log_ent_coef is not None:
                # Important: detach the variable from the graph
                # so we don't change it with other losses
                # see https://github.com/rail-berkeley/softlearning/issues/60
                ent_coef = th.exp(self.log_ent_coef.detach())
                if update_actor:
                    assert isinstance(self.target_entropy, float)
                    ent_coef_loss = -(self.log_ent_coef * (log_prob + self.target_entropy).detach()).mean()
            else:
                ent_coef = self.ent_coef_tensor

            # Optimize entropy coefficient, also called
            # entropy temperature or alpha in the paper
            if ent_coef_loss is not None and self.ent_coef_optimizer is not None:
                self.ent_coef_optimizer.zero_grad()
                ent_coef_loss.backward()
                self.ent_coef_optimizer.step()

            with th.no_grad():
                # Select action according to policy
                next_actions, next_log_prob = self.actor.action_log_prob(replay_data.next_observations)
                # Compute the next Q values: min over all critics targets
                next_q_values = th.cat(self.critic_target(replay_data.next_observations, next_actions), dim=1)
                next_q_values, _ = th.min(next_q_values, dim=1, keepdim=True)
                # add entropy term
                next_q_values = next_q_values - ent_coef * next_log_prob.reshape(-1, 1)
                # td error + entropy term
                target_q_values = replay_data.rewards + (1 - replay_data.dones) * self.gamma * next_q_values

            # Get current Q-values estimates for each critic network
            # using action from the replay buffer
            current_q_values = self.critic(replay_data.observations, replay_data.actions)

            # Compute critic loss. No factor 0.5: it is one summand of the encoder's loss, weighted as published
            critic_loss = th.stack([F.mse_loss(current_q, target_q_values) for current_q in current_q_values]).sum()
            representation_loss, logged = representation.losses(batch)

            # Optimize the critic, and with it encoder and models
            self.critic.optimizer.zero_grad()
            inverse_dynamics_optimizer.zero_grad()
            (critic_loss + representation_loss).backward()
            self.critic.optimizer.step()
            inverse_dynamics_optimizer.step()
            logged = {"train/critic_loss": critic_loss, "train/ent_coef": ent_coef, **logged}

            if update_actor:
                # Compute actor loss
                # Alternative: actor_loss = th.mean(log_prob - qf1_pi)
                # Min over all critic networks
                q_values_pi = th.cat(self.critic(replay_data.observations, actions_pi), dim=1)
                min_qf_pi, _ = th.min(q_values_pi, dim=1, keepdim=True)
                actor_loss = (ent_coef * log_prob - min_qf_pi).mean()
                logged["train/actor_loss"] = actor_loss

                # Optimize the actor, and compute no gradient of anything else
                self.actor.optimizer.zero_grad()
                actor_loss.backward(inputs=actor_parameters)
                self.actor.optimizer.step()
            if ent_coef_loss is not None:
                logged["train/ent_coef_loss"] = ent_coef_loss

            # Update target networks. SAC tests the loop index, which is always 0 at `gradient_steps=1`
            if self._n_updates % self.target_update_interval == 0:
                # As polyak_update, which starts two operations for each parameter
                th._foreach_mul_(targets, 1 - self.tau)
                th._foreach_add_(targets, online, alpha=self.tau)
                # Copy running stats, see GH issue #996
                polyak_update(self.batch_norm_stats, self.batch_norm_stats_target, 1.0)

            log.add(self._n_updates, logged)

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if representation.objective.bisim_coef > 0:
            self.logger.record("bisim/mu_ratio_target", representation.objective.ratio_target)
        if gradient_steps > 0:
            norm = th.nn.utils.get_total_norm([param.detach() for param in self.policy.parameters()])
            log.add(self._n_updates, {**representation.statistics(batch.z.detach()), "train/parameter_norm": norm})
            log.record(self.logger)

    def _intrinsic_reward(self, obs: Any, actions: np.ndarray, next_obs: Any) -> np.ndarray:
        """The bonus, (n_envs,), of transitions as the environment sees them: not normalised."""
        if self._vec_normalize_env is not None:
            obs, next_obs = self._vec_normalize_env.normalize_obs(obs), self._vec_normalize_env.normalize_obs(next_obs)
        bonus = self.policy.bonus(obs, actions, next_obs)
        self.logger.record_mean("rollout/intrinsic_reward", bonus.mean(dtype=np.float64))
        return bonus

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        env = self._wrap_env(env, self.verbose)
        check_for_correct_spaces(env, self.observation_space, self.action_space)
        super().set_env(with_intrinsic_reward(env, self.observation_space, self.intrinsic_reward_scale), force_reset)

    @classmethod
    def load(cls, path: PathOrStream, *args: Any, **kwargs: Any) -> Self:
        """Like SB3's ``load``; arguments of BisimSAC replace what the model was saved with, and must exist."""
        check_names(cls, kwargs, inspect.signature(SAC.load).parameters)
        return super().load(path, *args, **kwargs)

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "BisimSAC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        with bound(self.env, self._intrinsic_reward if self.intrinsic_reward_scale > 0 else None):
            return super().learn(
                total_timesteps, checked(callback), log_interval, tb_log_name, reset_num_timesteps, progress_bar
            )

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, tensors = super()._get_torch_save_params()
        return [*state_dicts, "policy.representation.inverse_dynamics.optimizer"], tensors
