"""
Checkpoints from which training continues as if it had never stopped.

SB3's own ``save`` stores the agent. A checkpoint stores everything that influences later numbers in one file: agent and
optimizers, replay buffer, environments in the middle of their episodes, callbacks with their state (if they are part of
``context``), and the random generators of CPU and CUDA. A run that continues computes the same numbers, bit by bit, as a run
without interruption. Three things differ: wall-clock times; the first line of every output of SB3's logger, because its means
start again; and exploration with ``use_sde`` or action noise, because SB3 draws new noise in every call of ``learn``.
"""

import inspect
import pickle
import platform
import random
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO

import cloudpickle
import gymnasium as gym
import numpy as np
import torch as th
from gymnasium.utils import EzPickle
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnvWrapper

from sb3_robust_bisim.runs.atomic import atomic_path


class Checkpoint(BaseCallback):
    """
    Writes checkpoints at regular intervals, between two rollouts. Each one replaces the previous one.

    :param path: file to write; it is replaced completely or not at all
    :param every: environment steps between two checkpoints, summed over all environments, >= 1
    :param context: other objects to save in the same file. Objects that they share with the model stay shared
    :param about: plain values that :func:`read_about` returns without unpickling the rest
    :raises ValueError: for ``every`` < 1; at the start of training, for environments that cannot be saved (see
        :func:`save_checkpoint`)
    """

    def __init__(self, path: str | Path, every: int, context: Any = None, about: dict[str, Any] | None = None) -> None:
        super().__init__()
        if every < 1:
            raise ValueError(f"every={every}: must be at least 1.")
        self.path = Path(path)
        self.every = every
        self.context = context
        self.about = about or {}
        self._last = 0

    def _on_training_start(self) -> None:
        _check_environments(self.model)
        self._last = self.num_timesteps

    def _on_rollout_start(self) -> None:
        if self.num_timesteps - self._last >= self.every:
            self._last = self.num_timesteps
            save_checkpoint(self.path, self.model, self.context, self.about)

    def _on_step(self) -> bool:
        return True


def save_checkpoint(path: str | Path, model: BaseAlgorithm, context: Any = None, about: dict[str, Any] | None = None) -> None:
    """
    Save everything that influences later numbers.

    :param path: file to write. An existing file is kept until the new one is complete. No other process may write it
    :param model: the model, between two calls of ``collect_rollouts`` as in :class:`Checkpoint`
    :param context: other objects to save
    :param about: plain values for :func:`read_about`
    :raises ValueError: for environments in other processes, and for environments that are pickled as the arguments of their
        constructor (``EzPickle``: Gymnasium's MuJoCo and Box2D tasks, and Shimmy's), because they would start again
    """
    _check_environments(model)
    with atomic_path(path, alone=True) as temporary, temporary.open("wb") as file:
        gpus = th.cuda.device_count() if model.device.type == "cuda" else 0
        header = {"num_timesteps": model.num_timesteps, "versions": _versions(), "gpus": gpus}
        pickle.dump({**(about or {}), **header}, file)
        _Pickler(file).dump((model, context, _generator_states(model.device)))


def read_about(path: str | Path) -> dict[str, Any]:
    """The plain values that were saved with a checkpoint, its ``"num_timesteps"`` and the packages' ``"versions"``."""
    with Path(path).open("rb") as file:
        return _read_header(file)


def load_checkpoint(path: str | Path) -> tuple[Any, Any]:
    """
    Load a model, and restore the global random generators.

    Only load files that you trust: unpickling runs code. Continue with ``learn(..., reset_num_timesteps=False)``. Set a custom
    logger again, because loggers are not saved.

    Loading changes no file. Once training continues, the first finished episode removes the episodes after the checkpoint from
    the Monitor file.

    :param path: file that :func:`save_checkpoint` wrote
    :return: the model with its environments and its replay buffer, and the context
    :raises ValueError: if the file is not a checkpoint, or if it was written with other package versions or with more GPUs
    """
    with Path(path).open("rb") as file:
        about = _read_header(file)
        if differing := differences(about["versions"], _versions()):
            raise ValueError(f"{path}: a checkpoint needs the versions that it was written with: {differing}.")
        if about["gpus"] > th.cuda.device_count():
            raise ValueError(f"{path}: written with {about['gpus']} GPUs, here are {th.cuda.device_count()}; continue there.")
        model, context, (python, numpy, torch, cuda) = cloudpickle.load(file)
    model._custom_logger = False  # so that learn() creates a logger
    if isinstance(model.replay_buffer, HerReplayBuffer):  # it does not pickle its environment
        model.replay_buffer.set_env(model.env)
    random.setstate(python)
    np.random.set_state(numpy)  # noqa: NPY002 (SB3 samples with it)
    th.set_rng_state(torch)
    if cuda:
        th.cuda.set_rng_state_all(cuda)
    return model, context


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


def _check_environments(model: BaseAlgorithm) -> None:
    assert model.env is not None
    venv = model.env.unwrapped
    if isinstance(venv, SubprocVecEnv):
        raise ValueError("SubprocVecEnv keeps its environments in other processes: use DummyVecEnv (--vec-env dummy).")
    for env in getattr(venv, "envs", []):
        layer = env
        while isinstance(layer, gym.Wrapper) and not _begins_anew(layer):
            layer = layer.env
        if _begins_anew(layer):
            raise ValueError(
                f"{type(layer).__name__} is pickled as the arguments of its constructor (EzPickle): after a checkpoint it "
                "would begin anew in the middle of an episode. Train without checkpoints, or define a __getstate__ that "
                "keeps its state."
            )


def _begins_anew(env: gym.Env) -> bool:
    return type(env).__getstate__ is EzPickle.__getstate__


def _read_header(file: BinaryIO) -> dict[str, Any]:
    try:
        about = pickle.load(file)
    except Exception as error:  # unpickling an arbitrary file can raise anything
        raise ValueError(f"{file.name}: this is no checkpoint. Name another file.") from error
    if not isinstance(about, dict) or not about.keys() >= {"num_timesteps", "versions", "gpus"}:
        raise ValueError(f"{file.name}: this is no checkpoint, but some other pickle. Name another file.")
    return about


def _versions() -> dict[str, str]:
    packages = ("torch", "numpy", "stable_baselines3", "gymnasium", "sb3_robust_bisim")
    return {"python": platform.python_version(), **{package: version(package) for package in packages}}


def _generator_states(device: th.device) -> tuple[Any, ...]:
    cuda = th.cuda.get_rng_state_all() if device.type == "cuda" else []
    return random.getstate(), np.random.get_state(), th.get_rng_state(), cuda  # noqa: NPY002


class _Pickler(cloudpickle.Pickler):
    """Leaves out objects that belong to a process and are created again when training continues."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, Logger):  # it has open files; learn() creates another
            return type(None), ()
        if isinstance(obj, ProgressBarCallback):  # a bar on the screen
            return ProgressBarCallback, ()
        if isinstance(obj, BaseCallback):  # except the local and global variables of learn()
            return _bare, (type(obj), {"locals": {}, "globals": {}}), _without(obj, "locals", "globals"), None, None, _fill
        if isinstance(obj, VecEnvWrapper):  # except the members of its class; VecNormalize would drop its environment
            return _bare_wrapper, (type(obj),), _without(obj, "class_attributes"), None, None, _fill
        if isinstance(obj, ResultsWriter):
            obj.file_handler.flush()
            size = getattr(obj, "size", None)
            size = obj.file_handler.tell() if size is None else size
            return _ContinuedResults, (obj.file_handler.name, size, tuple(obj.logger.fieldnames)[3:])
        return super().reducer_override(obj)


def _without(obj: Any, *names: str) -> dict[str, Any]:
    return {name: value for name, value in vars(obj).items() if name not in names}


def _fill(obj: Any, state: dict[str, Any]) -> None:
    vars(obj).update(state)


def _bare(cls: type, state: dict[str, Any]) -> Any:
    obj: Any = object.__new__(cls)
    _fill(obj, state)
    return obj


def _bare_wrapper(cls: type) -> Any:
    return _bare(cls, {"class_attributes": dict(inspect.getmembers(cls))})


class _ContinuedResults(ResultsWriter):
    """A Monitor's file. The first new episode removes the episodes that ended after the checkpoint; they will be repeated."""

    def __init__(self, name: str, size: int, extra_keys: tuple[str, ...]) -> None:
        super().__init__(name, extra_keys=extra_keys, override_existing=False)
        self.size: int | None = size  # size of the file at the checkpoint; None once it has been restored

    def write_row(self, epinfo: dict[str, float]) -> None:
        if self.size is not None:
            self.file_handler.truncate(min(self.size, Path(self.file_handler.name).stat().st_size))
            self.size = None
        super().write_row(epinfo)
