"""
Diagnostics of a running :class:`~sb3_robust_bisim.BisimSAC`, for TensorBoard and every other output of SB3's logger.

Their arguments are plain values, so that a zoo YAML can name them::

    callback:
      - sb3_robust_bisim.callbacks.EmbeddingCallback
      - sb3_robust_bisim.callbacks.DenoisingFactorCallback: {every: 2000}
      - sb3_robust_bisim.callbacks.ValueBoundCallback: {n_states: 500}

None of them changes the run that it watches: evaluation states come from an environment of their own or from the replay
buffer, and the global random generators are put back.
"""

import dataclasses
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from matplotlib.axes import Axes
from matplotlib.figure import Figure as MatplotlibFigure
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Figure, TensorBoardOutputFormat
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecFrameStack

from sb3_robust_bisim.bisim_sac import BisimSAC
from sb3_robust_bisim.envs.noise import NoiseObservation
from sb3_robust_bisim.losses import pairwise_distance

NOT_FOR_FIGURES = ("stdout", "log", "json", "csv")


class DiagnosticCallback(BaseCallback):
    """
    Looks at the model every so often, and at the end of training, without changing the run.

    :param every: environment steps between two looks, all environments together, >= 1
    :param n_states: states to look at, >= 2
    :param verbose: as in SB3
    :raises ValueError: for an argument outside its range; at the start of training for a model that is no BisimSAC
    """

    model: BisimSAC

    def __init__(self, every: int = 5000, n_states: int = 500, verbose: int = 0) -> None:
        super().__init__(verbose)
        for name, value, lowest in (("every", every, 1), ("n_states", n_states, 2)):
            if not isinstance(value, int) or value < lowest:
                raise ValueError(f"{name}={value!r}: {type(self).__name__} needs an integer >= {lowest}.")
        self.every = every
        self.n_states = n_states
        self._last_look = 0

    def _on_training_start(self) -> None:
        if not isinstance(self.model, BisimSAC):
            raise ValueError(f"{type(self).__name__} looks at embeddings: it works with BisimSAC, not {type(self.model)}.")
        self._last_look = self.num_timesteps
        with _undisturbed(self.model):
            self._prepare()

    def _on_step(self) -> bool:
        if self.num_timesteps - self._last_look >= self.every:
            self._look()
        return True

    def _on_training_end(self) -> None:
        if self.num_timesteps > self._last_look:
            self._look()

    def _look(self) -> None:
        self._last_look = self.num_timesteps
        with _undisturbed(self.model), th.no_grad():
            self._measure()
        # as SB3's EvalCallback does it, so that the numbers stand at the step they belong to
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)

    def _prepare(self) -> None:
        """Refuse, before training starts, what would fail later."""

    @abstractmethod
    def _measure(self) -> None:
        """Record to the logger."""

    def _record_figure(self, name: str, figure: MatplotlibFigure) -> None:
        self.logger.record(name, Figure(figure, close=False), exclude=NOT_FOR_FIGURES)


class EmbeddingCallback(DiagnosticCallback):
    """
    Shows the embedding: TensorBoard's projector with value and reward of each state, and the frames if the agent sees any;
    and, under ``embedding/pca``, the plane of the two largest principal components coloured by value.

    The states are drawn from the replay buffer. Their value is min_k Q_k(s, mean action).

    The arguments are those of :class:`DiagnosticCallback`. A buffer that holds fewer than ``n_states`` shows what it has.

    :raises ValueError: also at the start of training, without a TensorBoard log

    Example::

        model = BisimSAC("MlpPolicy", "robust_bisim/SparseCartPole-v0", tensorboard_log="runs")
        model.learn(10_000, callback=EmbeddingCallback(every=2000))
    """

    def _prepare(self) -> None:
        if self._tensorboard() is None:
            raise ValueError(
                f"tensorboard_log={self.model.tensorboard_log!r}: EmbeddingCallback writes to TensorBoard. Give the model a "
                "tensorboard_log (on the command line: --tensorboard-log), and install tensorboard."
            )

    def _tensorboard(self) -> TensorBoardOutputFormat | None:
        formats = self.logger.output_formats
        return next((output for output in formats if isinstance(output, TensorBoardOutputFormat)), None)

    def _measure(self) -> None:
        buffer = self.model.replay_buffer
        assert buffer is not None
        n_stored = buffer.size() * buffer.n_envs
        if n_stored < 2:
            return
        batch = buffer.sample(min(self.n_states, n_stored), env=self.model._vec_normalize_env)
        z, values = _embed(self.model, batch.observations)
        output = self._tensorboard()
        assert output is not None
        output.writer.add_embedding(
            z,
            metadata=th.cat([values, batch.rewards], dim=1).tolist(),
            metadata_header=["value", "reward"],
            label_img=self._sprites(batch.observations),
            global_step=self.num_timesteps,
            tag="embedding",
        )
        self._record_figure("embedding/pca", _pca_figure(z, values))

    def _sprites(self, obs: PyTorchObs) -> th.Tensor | None:
        """The newest frame of each stack, (B, 3, H, W) in [0, 1]; None where there are no images."""
        if isinstance(obs, dict) or not is_image_space(self.model.observation_space):
            return None
        newest = obs[:, -3:] if obs.shape[1] % 3 == 0 else obs[:, -1:].repeat(1, 3, 1, 1)
        return (newest.float() / 255).clamp(0, 1)


class EnvironmentCallback(DiagnosticCallback):
    """
    A diagnostic with an environment of its own: that of the training once more, made from its id, with its VecFrameStack and
    the present statistics of its VecNormalize, and without any other wrapper that was put around it.

    :param every: environment steps of the training between two looks, >= 1
    :param n_states: states to look at, >= 2
    :param env_id: another environment; None: that of the training
    :param env_kwargs: laid over the arguments of the environment
    :param seed: of the environment; every look begins with the same start states
    :param verbose: as in SB3
    :raises ValueError: for an argument outside its range; at the start of training if the observations differ
    """

    def __init__(
        self,
        every: int = 5000,
        n_states: int = 500,
        env_id: str | None = None,
        env_kwargs: dict[str, Any] | None = None,
        seed: int = 0,
        verbose: int = 0,
    ) -> None:
        super().__init__(every, n_states, verbose)
        self.env_id = env_id
        self.env_kwargs = env_kwargs or {}
        self.seed = seed

    def _prepare(self) -> None:
        self.venv = self._make_env()
        if self.venv.observation_space != self.model.observation_space:
            raise ValueError(
                f"env_id={self.env_id!r}, env_kwargs={self.env_kwargs}: {type(self).__name__} would see "
                f"{self.venv.observation_space}, the agent sees {self.model.observation_space}. Give env_kwargs that make "
                "both the same."
            )

    def _on_training_end(self) -> None:
        super()._on_training_end()
        self.venv.close()

    def _make_env(self) -> VecEnv:
        training = self.model.get_env()
        assert training is not None
        spec = training.get_attr("spec")[0] if self.env_id is None else gym.spec(self.env_id)
        if spec is None:
            raise ValueError(
                f"env_id=None: the environment of the training was not made from an id, so {type(self).__name__} cannot make "
                "another one. Register it with gymnasium and pass env_id and env_kwargs."
            )
        # what the entry point of the id wraps around comes back by itself, and Monitor cannot be made from its spec
        kwargs = {key: value for key, value in spec.kwargs.items() if key != "render_mode"}
        bare = dataclasses.replace(spec, additional_wrappers=(), kwargs={**kwargs, **self.env_kwargs})
        venv: VecEnv = DummyVecEnv([lambda: gym.make(bare)])
        layer: VecEnv = training
        while isinstance(layer, VecEnvWrapper):
            if isinstance(layer, VecFrameStack):
                venv = VecFrameStack(venv, layer.stacked_obs.n_stack)
            layer = layer.venv
        return self.model._wrap_env(venv, monitor_wrapper=False)

    def _walk(self) -> Iterator["Step"]:
        """Run the present (stochastic) policy from the same seed on, for as long as somebody asks."""
        self.venv.seed(self.seed)
        obs = self.venv.reset()
        while True:
            actions, _ = self.model.predict(self._normalize(obs))
            next_obs, rewards, dones, infos = self.venv.step(actions)
            yield Step(obs, float(rewards[0]), bool(dones[0]), infos[0], next_obs)
            obs = next_obs

    def _normalize(self, obs: Any) -> Any:
        normalize = self.model._vec_normalize_env
        return obs if normalize is None else normalize.normalize_obs(obs)

    def _tensor(self, obs: list[Any]) -> PyTorchObs:
        """Observations with a leading axis of one, as the encoder takes them."""
        rows: Any = {key: np.concatenate([o[key] for o in obs]) for key in obs[0]} if isinstance(obs[0], dict) else None
        return self.model.policy.obs_to_tensor(self._normalize(np.concatenate(obs) if rows is None else rows))[0]


class Step(NamedTuple):
    """One step; observations have a leading axis of one, and at ``done`` the next one belongs to a new episode."""

    obs: Any
    reward: float
    done: bool
    info: dict[str, Any]
    next_obs: Any


class DenoisingFactorCallback(EnvironmentCallback):
    """
    Does the embedding tell states apart, or distractors?

    Records ``bisim/denoising_factor``, (d_neg - d_pos) / (d_neg + d_pos) in [-1, 1]: d_pos is the mean distance between two
    looks at the same state with other noise, d_neg that between different states. 1: the noise is gone; 0: it matters as
    much as the state. The distances are those that the metric loss trains, ``huber`` averaged over coordinates.

    The second look at a state has its noise drawn again by
    :class:`~sb3_robust_bisim.envs.NoiseObservation`, or is ``info["clean_obs"]``, the frame without a distractor: pixel tasks
    write it if asked to, ``env_kwargs={"clean_obs": True}``.

    The arguments are those of :class:`EnvironmentCallback`.

    :raises ValueError: also at the start of training, for an environment without noise or clean frames

    Example::

        model = BisimSAC("MlpPolicy", gym.make("robust_bisim/SparseCartPole-v0", noise_multiplier=2))
        model.learn(10_000, callback=DenoisingFactorCallback(every=2000))
    """

    def _prepare(self) -> None:
        super()._prepare()
        layer: Any = self.venv.unwrapped.envs[0]  # type: ignore[attr-defined]
        while not isinstance(layer, NoiseObservation) and hasattr(layer, "env"):
            layer = layer.env
        self.noise = layer if isinstance(layer, NoiseObservation) else None
        if self.noise is None and "clean_obs" not in next(self._walk()).info:
            raise ValueError(
                f'env_kwargs={self.env_kwargs}: no NoiseObservation and no info["clean_obs"], so no state can be seen with '
                "other noise. Noisy tasks need noise_multiplier > 0, pixel tasks env_kwargs={'clean_obs': True}."
            )

    def _measure(self) -> None:
        pairs = list(islice(self._pairs(), self.n_states))
        seen, other = (_embed(self.model, self._tensor(list(obs)))[0] for obs in zip(*pairs, strict=True))
        first, second = np.triu_indices(len(pairs), 1)
        positive = pairwise_distance(seen, other, self.model.distance).mean().item()
        negative = pairwise_distance(seen[first], other[second], self.model.distance).mean().item()
        total = positive + negative
        self.logger.record("bisim/denoising_factor", (negative - positive) / total if total > 0 else 0.0)

    def _pairs(self) -> Iterator[tuple[Any, Any]]:
        """Two looks at each state of a walk."""
        if self.noise is not None:
            n_state = len(self.model.observation_space.low) - self.noise.noise_shape[0]  # type: ignore[attr-defined]
            for step in self._walk():
                yield step.obs, self.noise.observation(step.obs[0, :n_state])[None]
        frames: list[np.ndarray] = []
        for step in self._walk():
            frames = [] if step.done else [*frames, step.info["clean_obs"]]
            n_stack = step.next_obs.size // step.info["clean_obs"].size
            if len(frames) >= n_stack:
                stack = np.concatenate(frames[-n_stack:], axis=-1)
                yield step.next_obs, (stack if stack.shape == step.next_obs.shape[1:] else stack.transpose(2, 0, 1))[None]


class ValueBoundCallback(EnvironmentCallback):
    """
    Do learned distances bound differences of value, as thm:generalized-ct says that the exact metric does?

    Runs episodes of the present policy, takes the discounted return of what is left of the episode as the value of a state
    (after a time-out the critic's value of the last state stands for the rest), and compares the gap of every pair of states
    with their distance d / c_R + 2 (R_max - R_min) (gamma - c_T) / ((1 - gamma) (1 - c_T)), the second term for c_T < gamma
    only. Records ``bisim/value_bound_violations``, the fraction of pairs whose gap is larger; the means
    ``bisim/value_gap`` and ``bisim/value_bound``; and the scatter ``bisim/value_gap_against_bound``.

    The theorem is about expected returns; a single return of a random task scatters around its own. The distance is what the
    metric loss trains; ``huber`` is averaged over coordinates and no metric, so it may break the bound at any time.

    The arguments are those of :class:`EnvironmentCallback`; whole episodes are run until there are ``n_states`` states.
    Another environment should pay the reward that the agent was trained on.

    :raises ValueError: also at the start of training, for ``c_r=0`` or ``gamma=1``, for which there is no bound
    :raises ImportError: without the extra ``theory``

    Example::

        model = BisimSAC("MlpPolicy", "robust_bisim/SparseCartPole-v0", distance="l1")
        model.learn(10_000, callback=ValueBoundCallback(every=2000))
    """

    def _prepare(self) -> None:
        try:
            from sb3_robust_bisim.bounds import value_difference_bound
        except ImportError as error:
            raise ImportError('ValueBoundCallback needs pip install "sb3_robust_bisim[theory]".') from error
        self._bound = value_difference_bound
        if self.model.c_r == 0 or self.model.gamma == 1:
            raise ValueError(f"c_r={self.model.c_r}, gamma={self.model.gamma}: a bound on values needs c_r > 0 and gamma < 1.")
        super()._prepare()

    def _measure(self) -> None:
        obs, returns = self._returns()
        keep = np.linspace(0, len(obs) - 1, self.n_states).astype(int)  # of all the episodes, the last one too
        z, _ = _embed(self.model, self._tensor([obs[i] for i in keep]))
        first, second = np.triu_indices(len(keep), 1)
        distance = pairwise_distance(z[first], z[second], self.model.distance).mean(dim=1).double().cpu().numpy()
        gap = np.abs(returns[keep][first] - returns[keep][second])
        r_min, r_max = self.model.reward_range
        bound = self._bound(distance, self.model.c_r, self.model._c_t, self.model.gamma, r_max - r_min)
        self.logger.record("bisim/value_bound_violations", float((gap > bound).mean()))
        self.logger.record("bisim/value_gap", float(gap.mean()))
        self.logger.record("bisim/value_bound", float(bound.mean()))
        self._record_figure("bisim/value_gap_against_bound", _bound_figure(bound, gap))

    def _returns(self) -> tuple[list[Any], np.ndarray]:
        """Observations of whole episodes and the discounted returns that followed them."""
        observations: list[Any] = []
        returns: list[float] = []
        rewards: list[float] = []
        for step in self._walk():
            observations.append(step.obs)
            rewards.append(step.reward)
            if step.done:
                value = self._value(step.info["terminal_observation"]) if step.info["TimeLimit.truncated"] else 0.0
                episode = []
                for reward in reversed(rewards):
                    value = reward + self.model.gamma * value
                    episode.append(value)
                returns += reversed(episode)
                rewards = []
                if len(returns) >= self.n_states:
                    break
        return observations, np.array(returns)

    def _value(self, obs: Any) -> float:
        row = {key: value[None] for key, value in obs.items()} if isinstance(obs, dict) else obs[None]
        return _embed(self.model, self._tensor([row]))[1].item()


def _embed(model: BisimSAC, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
    """
    :param obs: B observations as the networks take them
    :return: (B, n) embeddings and (B, 1) values, min_k Q_k(s, mean action)
    """
    z = model.critic.encode(obs)
    actions = model.actor(obs, deterministic=True)
    return z, th.cat(model.critic.q_values(z, actions), dim=1).min(dim=1, keepdim=True).values


@contextmanager
def _undisturbed(model: BisimSAC) -> Iterator[None]:
    """Put the global random generators, which SB3 draws from, and the policy's training mode back afterwards."""
    numpy_state, training = np.random.get_state(), model.policy.training  # noqa: NPY002
    with th.random.fork_rng([model.device] if model.device.type == "cuda" else []):
        model.policy.set_training_mode(False)
        try:
            yield
        finally:
            model.policy.set_training_mode(training)
            np.random.set_state(numpy_state)  # noqa: NPY002


def _axes() -> tuple[MatplotlibFigure, Axes]:
    figure = MatplotlibFigure(figsize=(5.6, 4.4), layout="constrained")
    axes = figure.subplots()
    axes.grid(alpha=0.3)
    return figure, axes


def _pca_figure(z: th.Tensor, values: th.Tensor) -> MatplotlibFigure:
    """
    :param z: (B, n) embeddings
    :param values: (B, 1)
    """
    centred = (z - z.mean(dim=0)).double().cpu()
    _, singular, directions = th.linalg.svd(centred, full_matrices=False)
    plane = centred @ directions[:2].T
    share = singular.square() / singular.square().sum().clamp(min=1e-30)
    figure, axes = _axes()
    points = axes.scatter(plane[:, 0].numpy(), plane[:, 1].numpy(), c=values[:, 0].cpu().numpy(), s=9, cmap="viridis")
    figure.colorbar(points, ax=axes, label="value")
    axes.set(xlabel=f"1st component ({share[0]:.0%} of variance)", ylabel=f"2nd component ({share[1]:.0%})")
    return figure


def _bound_figure(bound: np.ndarray, gap: np.ndarray) -> MatplotlibFigure:
    """
    :param bound: one entry per pair of states, likewise ``gap``
    """
    figure, axes = _axes()
    shown = np.linspace(0, len(gap) - 1, min(len(gap), 5000)).astype(int)
    axes.scatter(bound[shown], gap[shown], s=4, alpha=0.3)
    largest = float(max(bound.max(), gap.max()))
    axes.plot([0, largest], [0, largest], color="black", linewidth=1, label="bound (above: broken)")
    axes.set(xlabel="bound from the learned distance", ylabel="observed gap of values")
    axes.legend()
    return figure
