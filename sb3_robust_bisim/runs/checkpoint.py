"""
Checkpoints from which training continues as if it had never stopped.

SB3's own ``save`` stores the agent. A checkpoint stores everything that influences later numbers in one file: agent and
optimizers, replay buffer, environments in the middle of their episodes, exploration noise, random generators of CPU and CUDA,
and callbacks with their state if they are part of ``context``. A run that continues computes the same numbers, bit by bit, as
a run without interruption. Two things differ: wall-clock times, and the first line of every output of SB3's logger, because
its means start again.
"""

import io
import pickle
import platform
import warnings
from collections.abc import Mapping
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import get_parameters_by_name
from stable_baselines3.common.vec_env import VecEnv

from sb3_robust_bisim.runs.hashed_file import damage, opened, previous, replaced
from sb3_robust_bisim.runs.pickling import Pickler, check_environments, generator_states, restore_generators
from sb3_robust_bisim.values import is_whole


class Checkpoint(BaseCallback):
    """
    Writes checkpoints at regular intervals, between two rollouts. The last two are kept.

    :param path: file to write; it is replaced completely or not at all
    :param every: environment steps between two checkpoints, summed over all environments, >= 1
    :param context: other objects to save in the same file. Objects that they share with the model stay shared
    :param about: plain values that :func:`read_about` returns without unpickling the rest
    :raises ValueError: unless ``every`` is an integer >= 1; for values of ``about`` that cannot be pickled; at the start of
        training, for environments that cannot be saved (see :func:`save_checkpoint`)
    """

    def __init__(self, path: str | Path, every: int, context: Any = None, about: dict[str, Any] | None = None) -> None:
        super().__init__()
        if not is_whole(every, 1):
            raise ValueError(f"every={every!r}: it must be an integer >= 1, the environment steps between two checkpoints.")
        self.path = Path(path)
        self.every = every
        self.context = context
        self.about = about or {}
        _check_plain(self.about)
        self._last = 0

    def _on_training_start(self) -> None:
        check_environments(self.training_env)
        self._last = self.num_timesteps

    def _on_rollout_start(self) -> None:
        if self.num_timesteps - self._last >= self.every:
            self._last = self.num_timesteps
            save_checkpoint(self.path, self.model, self.context, self.about, rollout_begun=True)

    def _on_step(self) -> bool:
        return True


def save_checkpoint(
    path: str | Path,
    model: BaseAlgorithm,
    context: Any = None,
    about: dict[str, Any] | None = None,
    rollout_begun: bool = False,
) -> None:
    """
    Save everything that influences later numbers.

    :param path: file to write. An existing file is kept until the new one is complete, and then as the previous one if there
        is space on the disk and the file system has hard links. No other process may write it
    :param model: the model, between two calls of ``collect_rollouts`` as in :class:`Checkpoint`
    :param context: other objects to save
    :param about: plain values for :func:`read_about`
    :param rollout_begun: True in the ``_on_rollout_start`` of a callback, False outside of ``learn``. At that point, SB3 has
        drawn the exploration noise of the rollout, and does not draw it again when training continues
    :raises ValueError: for environments that cannot be pickled; the message names the environment and the remedy
    """
    gpus = th.cuda.device_count() if model.device.type == "cuda" else 0
    header = {"num_timesteps": model.num_timesteps, "versions": _versions(), "gpus": gpus}
    with replaced(Path(path)) as file:
        pickle.dump({**(about or {}), **header}, file)
        pickler = Pickler(file)  # it writes an object once that both dumps contain
        try:
            pickler.dump(_without_environment(model))
            pickler.dump((model, context, generator_states(model.device), rollout_begun))
        except Exception:
            check_environments(model.env)  # type: ignore[arg-type]
            raise


def read_about(path: str | Path) -> dict[str, Any]:
    """
    The plain values that were saved with a checkpoint, its ``"num_timesteps"`` and the packages' ``"versions"``.

    :param path: as for :func:`load_checkpoint`, also if the file is damaged
    """
    with opened(_intact(Path(path))) as file:
        return pickle.load(file)


def obstacle(about: Mapping[str, Any]) -> str:
    """
    :param about: what :func:`read_about` returned
    :return: why a run cannot continue exactly here; empty if it can
    """
    if differing := differences(about["versions"], _versions()):
        return f"it was written with other versions: {differing}"
    if about["gpus"] > th.cuda.device_count():
        return f"it was written with {about['gpus']} GPUs, here are {th.cuda.device_count()}"
    return ""


def load_checkpoint(path: str | Path, env: VecEnv | None = None, device: th.device | str = "auto") -> tuple[Any, Any]:
    """
    Load a model, and restore the global random generators.

    Only load files that you trust: unpickling runs code. Continue with ``learn(..., reset_num_timesteps=False)``. BisimSAC
    goes on in the run's folder of ``tensorboard_log``. Set a custom logger again, because loggers are not saved.

    Loading changes no file. Once training continues, the first finished episode removes the episodes after the checkpoint from
    the Monitor file.

    :param path: file that :func:`save_checkpoint` wrote. If it is damaged and the previous one is not, a warning is given, and
        the run continues from the previous one
    :param env: new environments, to continue without exactness: the agent, its optimizers, replay buffer, counters and the
        statistics of ``VecNormalize`` are loaded, and new episodes begin. The context and the random generators are not loaded
    :param device: of the agent in new environments; without ``env``, it is the one that the agent had
    :return: the model with its environments and its replay buffer, and the context (None with ``env``)
    :raises ValueError: if the file is not a checkpoint or damaged; without ``env``, if it was written with other package
        versions or with more GPUs; with an ``env`` of another number of environments
    """
    path = _intact(Path(path))
    with opened(path) as file:
        if (reason := obstacle(pickle.load(file))) and env is None:
            raise ValueError(
                f"{path}: an exact continuation is not possible, because {reason}. Continue where it was written, or pass env "
                "(on the command line --new-episodes), to continue with its agent, replay buffer and counters in new episodes."
            )
        unpickler = pickle.Unpickler(file)
        parts = unpickler.load()
        if env is not None:
            return _with_new_episodes(parts, env, device), None
        model, context, generators, rollout_begun = unpickler.load()
    model._custom_logger = False  # so that learn() creates a logger
    _link_batch_norm(model)
    if isinstance(getattr(model, "replay_buffer", None), HerReplayBuffer):  # it does not pickle its environment
        model.replay_buffer.set_env(model.env)
    if rollout_begun and model.use_sde:
        _skip_next(getattr(model, "actor", model.policy), "reset_noise")
    if rollout_begun and getattr(model, "action_noise", None) is not None:
        _skip_next(model.action_noise, "reset")
    restore_generators(generators)
    return model, context


def delete_checkpoint(path: str | Path) -> None:
    """Delete a checkpoint and the previous one, if they exist."""
    Path(path).unlink(missing_ok=True)
    previous(Path(path)).unlink(missing_ok=True)


def differences(there: Mapping[str, Any], here: Mapping[str, Any], place: str = "here") -> str:
    """
    Describe where two sets of settings differ, for a message.

    :param there: settings of a saved run; a missing key counts as None
    :param here: settings to compare with
    :param place: what the message calls ``here``
    :return: the keys with both values; empty if there is no difference
    """
    keys = sorted(key for key in {*there, *here} if there.get(key) != here.get(key))
    return ", ".join(f"{key} is {there.get(key)} there and {here.get(key)} {place}" for key in keys)


def _check_plain(values: Mapping[str, Any], place: str = "about") -> None:
    """Name the value that pickle refuses, for example a function that a Python config file defines."""
    for key, value in values.items():
        try:
            pickle.dumps(value)
        except Exception as error:  # pickle has no class of its own for all of them
            if isinstance(value, Mapping):
                _check_plain(value, f"{place}[{key!r}]")
            raise ValueError(
                f"{place}[{key!r}]={value!r} cannot be saved in a checkpoint ({error}): use a plain value, or train without "
                "checkpoints."
            ) from error


def _intact(path: Path) -> Path:
    """The file itself, or the previous one if only that is whole."""
    if not (problem := damage(path)):
        return path
    older = previous(path)
    if not older.exists() or damage(older):
        raise ValueError(f"{path}: {problem}. Name another file, or delete it to start again.")
    with opened(older) as file:
        step = pickle.load(file)["num_timesteps"]
    warnings.warn(f"{path}: {problem}. The run continues from the checkpoint before, {older}, at step {step}.", stacklevel=3)
    return older


def _versions() -> dict[str, str]:
    packages = ["torch", "numpy", "stable_baselines3", "gymnasium", "sb3_robust_bisim"]
    packages += ["mujoco"] if find_spec("mujoco") else []  # it is optional
    return {"python": platform.python_version(), **{package: version(package) for package in packages}}


def _without_environment(model: BaseAlgorithm) -> tuple[Any, ...]:
    """What :func:`_with_new_episodes` needs. The agent is in SB3's format, which other versions can read."""
    agent = io.BytesIO()
    model.save(agent)
    normalize = model.get_vec_normalize_env()
    statistics = None if normalize is None else (normalize.obs_rms, normalize.ret_rms)
    return type(model), agent.getvalue(), getattr(model, "replay_buffer", None), statistics


def _with_new_episodes(parts: tuple[Any, ...], env: VecEnv, device: th.device | str) -> BaseAlgorithm:
    algorithm, agent, *_, replay_buffer, statistics = parts  # earlier versions had the device in between
    if replay_buffer is not None and replay_buffer.n_envs != env.num_envs:
        raise ValueError(
            f"env with num_envs={env.num_envs}: the checkpoint has a replay buffer for {replay_buffer.n_envs} environments. "
            "Pass as many."
        )
    model = algorithm.load(io.BytesIO(agent), env=env, device=device)
    if replay_buffer is not None:
        model.replay_buffer, replay_buffer.device = replay_buffer, model.device
    if isinstance(replay_buffer, HerReplayBuffer):
        replay_buffer.set_env(model.env)
        replay_buffer.truncate_last_trajectory()
    if statistics is not None and (normalize := model.get_vec_normalize_env()) is not None:
        normalize.obs_rms, normalize.ret_rms = statistics
    return model


def _link_batch_norm(model: BaseAlgorithm) -> None:
    """Let SB3's lists of BatchNorm statistics be those of the nets again: pickle makes copies of tensors that share memory."""
    for name in [name for name in vars(model) if name.removesuffix("_target").endswith("batch_norm_stats")]:
        target = "_target" if name.endswith("_target") else ""
        owner = name.removesuffix("_target").removesuffix("batch_norm_stats").rstrip("_")  # TD3 has those of its actor, too
        nets = [owner] if owner else ["critic", "q_net", "quantile_net"]  # of SAC, DQN and QRDQN
        for net in (getattr(model, net + target) for net in nets if hasattr(model, net + target)):
            setattr(model, name, get_parameters_by_name(net, ["running_"]))


def _skip_next(obj: Any, method: str) -> None:
    """Make the next call of a method do nothing, because its effect is part of the checkpoint."""
    setattr(obj, method, partial(_skipped, obj, method))


def _skipped(obj: Any, method: str, *_: Any, **__: Any) -> None:
    delattr(obj, method)
