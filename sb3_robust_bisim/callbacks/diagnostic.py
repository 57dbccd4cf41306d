"""What the diagnostics share: when they look, that they disturb nothing, and an environment of their own."""

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

LONGEST_WALK = 100_000  # steps of one look, far more than it takes where episodes end
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
        self._last_look: int | None = None

    def _on_training_start(self) -> None:
        if not isinstance(self.model, BisimSAC):
            raise ValueError(f"{type(self).__name__} looks at embeddings: it works with BisimSAC, not {type(self.model)}.")
        if self._last_look is None or self._last_look > self.num_timesteps:  # else a run goes on, from a checkpoint perhaps
            self._last_look = self.num_timesteps
        with _undisturbed(self.model):
            self._prepare()

    def _on_step(self) -> bool:
        if self._steps_since >= self.every:
            self._look()
        return True

    def _on_training_end(self) -> None:
        # The zoo calls this also when training has failed or not begun, and then nothing may hide the reason
        if self._steps_since > 0 and all(param.isfinite().all() for param in self.model.policy.parameters()):
            self._look()

    @property
    def _steps_since(self) -> int:
        return 0 if self._last_look is None else self.num_timesteps - self._last_look

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
        self._venv: VecEnv | None = None

    @property
    def venv(self) -> VecEnv:
        assert self._venv is not None  # made when training starts
        return self._venv

    def _prepare(self) -> None:
        self._venv = self._make_env()
        if self.venv.observation_space != self.model.observation_space:
            raise ValueError(
                f"env_id={self.env_id!r}, env_kwargs={self.env_kwargs}: {type(self).__name__} would see "
                f"{self.venv.observation_space}, the agent sees {self.model.observation_space}. Give env_kwargs that make "
                "both the same."
            )

    def _on_training_end(self) -> None:
        super()._on_training_end()
        if self._venv is not None:
            self._venv.close()
            self._venv = None

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
        if (n_stack := frames_per_observation(training)) > 1:
            venv = VecFrameStack(venv, n_stack)
        return self.model._wrap_env(venv, monitor_wrapper=False)

    def _walk(self) -> Iterator["Step"]:
        """Run the present (stochastic) policy from the same seed on, for as long as somebody asks."""
        self.venv.seed(self.seed)
        obs = self.venv.reset()
        for _ in range(LONGEST_WALK):
            actions, _ = self.model.predict(self._normalize(obs))
            next_obs, rewards, dones, infos = self.venv.step(actions)
            yield Step(obs, float(rewards[0]), bool(dones[0]), infos[0], next_obs)
            obs = next_obs
        raise ValueError(
            f"n_states={self.n_states}: {type(self).__name__} found fewer states to look at in {LONGEST_WALK} steps of "
            f"{self.venv.get_attr('spec')[0].id}. Its episodes must end (max_episode_steps), and be longer than a frame stack."
        )

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


def embed(model: BisimSAC, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
    """
    :param obs: B observations as the networks take them
    :return: (B, n) embeddings and (B, 1) values, min_k Q_k(s, mean action)
    """
    encoder = model.critic.features_extractor
    encoded = Encoded(encoder.preprocess(obs))
    actions = model.actor(encoded, deterministic=True)
    return encoded[encoder], th.cat(model.critic(encoded, actions), dim=1).min(dim=1, keepdim=True).values


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


def new_axes() -> tuple[MatplotlibFigure, Axes]:
    figure = MatplotlibFigure(figsize=(5.6, 4.4), layout="constrained")
    axes = figure.subplots()
    axes.grid(alpha=0.3)
    return figure, axes
