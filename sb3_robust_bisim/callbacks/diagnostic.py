"""Base classes of the diagnostics: when they measure, how they leave the run unchanged, and their separate environment."""

import dataclasses
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from matplotlib.axes import Axes
from matplotlib.figure import Figure as MatplotlibFigure
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Figure
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack

from sb3_robust_bisim.bisim_sac import BisimSAC
from sb3_robust_bisim.encoders import Encoded
from sb3_robust_bisim.frame_buffer import frames_per_observation
from sb3_robust_bisim.values import is_whole

LONGEST_WALK = 100_000  # steps of one measurement, far more than it needs if episodes end
NOT_FOR_FIGURES = ("stdout", "log", "json", "csv")


class DiagnosticCallback(BaseCallback):
    """
    Measures the model at regular intervals and at the end of training, without changing the run.

    :param every: environment steps between two measurements, summed over all environments, >= 1
    :param n_states: number of states to measure with, >= 2
    :param verbose: as in SB3
    :raises ValueError: for an argument outside its range; at the start of training if the model is not a BisimSAC
    """

    model: BisimSAC

    def __init__(self, every: int = 5000, n_states: int = 500, verbose: int = 0) -> None:
        super().__init__(verbose)
        for name, value, lowest in (("every", every, 1), ("n_states", n_states, 2)):
            if not is_whole(value, lowest):
                raise ValueError(f"{name}={value!r}: {type(self).__name__} needs an integer >= {lowest}.")
        self.every = every
        self.n_states = n_states
        self._last_look: int | None = None

    def _on_training_start(self) -> None:
        if not isinstance(self.model, BisimSAC):
            raise ValueError(f"{type(self).__name__} measures embeddings: it works with BisimSAC, not {type(self.model)}.")
        if self._last_look is None or self._last_look > self.num_timesteps:  # else a run continues, maybe from a checkpoint
            self._last_look = self.num_timesteps
        with undisturbed(self.model):
            self._prepare()

    def _on_step(self) -> bool:
        if self._steps_since >= self.every:
            self._look()
        return True

    def _on_training_end(self) -> None:
        # RL Zoo calls this also if training has failed or not begun; a second error would hide the reason
        if self._steps_since > 0 and all(param.isfinite().all() for param in self.model.policy.parameters()):
            self._look()

    @property
    def _steps_since(self) -> int:
        return 0 if self._last_look is None else self.num_timesteps - self._last_look

    def _look(self) -> None:
        self._last_look = self.num_timesteps
        with undisturbed(self.model), th.no_grad():
            self._measure()
        # as in SB3's EvalCallback, so that the numbers are logged at the step to which they belong
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)

    def _prepare(self) -> None:
        """Raise an error before training starts for what would fail later."""

    @abstractmethod
    def _measure(self) -> None:
        """Measure and record to the logger."""

    def _record_figure(self, name: str, figure: MatplotlibFigure) -> None:
        self.logger.record(name, Figure(figure, close=False), exclude=NOT_FOR_FIGURES)


class EnvironmentCallback(DiagnosticCallback):
    """
    A diagnostic with a separate environment. It is made from the id of the training environment, with the same VecFrameStack
    and the current statistics of VecNormalize. Other wrappers around the training environment are not copied.

    :param every: environment steps of the training between two measurements, >= 1
    :param n_states: number of states to measure with, >= 2
    :param env_id: id of the environment to measure in; None: that of the training
    :param env_kwargs: merged into the arguments of the environment
    :param seed: seed of the environment; every measurement begins with the same start states
    :param verbose: as in SB3
    :raises ValueError: for an argument outside its range; at the start of training if the observation spaces differ
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
        self._venv: VecEnv | None = None

    @property
    def venv(self) -> VecEnv:
        assert self._venv is not None  # created when training starts
        return self._venv

    def _prepare(self) -> None:
        self._venv = self._make_env()
        if self.venv.observation_space != self.model.observation_space:
            raise ValueError(
                f"env_id={self.env_id!r}, env_kwargs={self.env_kwargs}: {type(self).__name__} would observe "
                f"{self.venv.observation_space}, the agent observes {self.model.observation_space}. Pass env_kwargs that make "
                "them equal."
            )

    def _on_training_end(self) -> None:
        super()._on_training_end()
        self._close()

    def _close(self) -> None:
        if self._venv is not None:
            self._venv.close()
            self._venv = None

    def _make_env(self) -> VecEnv:
        training = self.model.get_env()
        assert training is not None
        spec = training.get_attr("spec")[0] if self.env_id is None else gym.spec(self.env_id)
        if spec is None:
            raise ValueError(
                f"env_id=None: the training environment was not made from an id, so {type(self).__name__} cannot make "
                "another one. Register it with gymnasium, and pass env_id and env_kwargs."
            )
        # The entry point of the id adds its own wrappers again, and Monitor cannot be made from its spec
        kwargs = {key: value for key, value in spec.kwargs.items() if key != "render_mode"}
        bare = dataclasses.replace(spec, additional_wrappers=(), kwargs={**kwargs, **self.env_kwargs})
        venv: VecEnv = DummyVecEnv([lambda: gym.make(bare)])
        if (n_stack := frames_per_observation(training)) > 1:
            venv = VecFrameStack(venv, n_stack)
        return self.model._wrap_env(venv, monitor_wrapper=False)

    def _walk(self) -> Iterator["Step"]:
        """Yield steps of the current (stochastic) policy; every walk starts from the same seed."""
        self.venv.seed(self.seed)
        obs = self.venv.reset()
        for _ in range(LONGEST_WALK):
            actions, _ = self.model.predict(self._normalize(obs))
            next_obs, rewards, dones, infos = self.venv.step(actions)
            yield Step(obs, float(rewards[0]), bool(dones[0]), infos[0], next_obs)
            obs = next_obs
        raise ValueError(
            f"n_states={self.n_states}: {type(self).__name__} found fewer states in {LONGEST_WALK} steps of "
            f"{self.venv.get_attr('spec')[0].id}. Its episodes must end (max_episode_steps), and be longer than a frame stack."
        )

    def _normalize(self, obs: Any) -> Any:
        normalize = self.model._vec_normalize_env
        return obs if normalize is None else normalize.normalize_obs(obs)

    def _tensor(self, obs: list[Any]) -> PyTorchObs:
        """Convert observations with a leading axis of one to the encoder's input."""
        rows: Any = {key: np.concatenate([o[key] for o in obs]) for key in obs[0]} if isinstance(obs[0], dict) else None
        return self.model.policy.obs_to_tensor(self._normalize(np.concatenate(obs) if rows is None else rows))[0]


class Step(NamedTuple):
    """One step. Observations have a leading axis of one. If ``done``, the next observation belongs to a new episode."""

    obs: Any
    reward: float
    done: bool
    info: dict[str, Any]
    next_obs: Any


def embed(model: BisimSAC, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
    """
    :param obs: B observations, as the networks expect them
    :return: (B, n) embeddings and (B, 1) values, min_k Q_k(s, mean action)
    """
    encoder = model.critic.features_extractor
    encoded = Encoded(encoder.preprocess(obs))
    actions = model.actor(encoded, deterministic=True)
    return encoded[encoder], th.cat(model.critic(encoded, actions), dim=1).min(dim=1, keepdim=True).values


@contextmanager
def undisturbed(model: BisimSAC) -> Iterator[None]:
    """Restore the global random generators, which SB3 uses, and the policy's training mode afterwards."""
    numpy_state, training = np.random.get_state(), model.policy.training  # noqa: NPY002
    with th.random.fork_rng([model.device] if model.device.type == "cuda" else []):
        model.policy.set_training_mode(False)
        try:
            yield
        finally:
            model.policy.set_training_mode(training)
            np.random.set_state(numpy_state)  # noqa: NPY002


def new_axes() -> tuple[MatplotlibFigure, Axes]:
    figure = MatplotlibFigure(figsize=(5.6, 4.4), layout="constrained")
    axes = figure.subplots()
    axes.grid(alpha=0.3)
    return figure, axes
