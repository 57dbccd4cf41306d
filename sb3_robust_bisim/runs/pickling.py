"""
Pickles of objects that are in use: environments in the middle of an episode, in this process or in others.

An environment is pickled by its attributes, also if it is an ``EzPickle``: as the arguments of its constructor it would begin
anew. That covers Gymnasium's MuJoCo tasks. Their whole ``MjData`` is kept, because Ant and Humanoid compute rewards from body
positions of the step before, which are not part of MuJoCo's state. An environment with attributes that cannot be pickled, or
with a state outside of its attributes, needs ``__getstate__`` and ``__setstate__``.
"""

import inspect
import io
import pickle
import random
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np
import torch as th
from gymnasium.utils import EzPickle
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn


class NotSaveable(ValueError):
    """An environment cannot be saved. The message names it and the remedy."""


class WorkerEnded(RuntimeError):
    """The process of an environment has ended, such as one that was killed for its memory."""


class Pickler(cloudpickle.Pickler):
    """Keeps the state of environments, and leaves out what belongs to a process and is created again afterwards."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, Logger):  # it has open files; learn() creates another
            return type(None), ()
        if isinstance(obj, ProgressBarCallback):  # a bar on the screen
            return ProgressBarCallback, ()
        if isinstance(obj, BaseCallback):  # except the local and global variables of learn()
            return _bare, (type(obj), {"locals": {}, "globals": {}}), _without(obj, "locals", "globals"), None, None, _fill
        if isinstance(obj, VecEnvWrapper):
            # except the members of its class, and what learn() sets again; VecNormalize would drop its environment
            state = _without(obj, "class_attributes")
            state |= dict.fromkeys(getattr(type(obj), "only_while_learning", ()))
            return _bare_wrapper, (type(obj),), state, None, None, _fill
        if isinstance(obj, SubprocVecEnv) and not isinstance(obj, ResumableSubprocVecEnv):
            raise NotSaveable(
                "SubprocVecEnv keeps its environments in other processes: replace it with "
                "sb3_robust_bisim.runs.ResumableSubprocVecEnv, which takes the same arguments, or with DummyVecEnv."
            )
        if isinstance(obj, EzPickle) and _begins_anew(type(obj)):
            return _bare, (type(obj), {}), _without(obj), None, None, _fill
        if isinstance(obj, _mujoco_renderer()):  # its windows and OpenGL contexts; render() creates others
            return _bare, (type(obj), {"_viewers": {}, "viewer": None}), _without(obj, "_viewers", "viewer"), None, None, _fill
        if isinstance(obj, ResultsWriter):
            return _ContinuedResults, _continuation(obj)
        return super().reducer_override(obj)


def dumps(obj: Any) -> bytes:
    """The pickle of an object, see :class:`Pickler`."""
    file = io.BytesIO()
    Pickler(file).dump(obj)
    return file.getvalue()


def check_environments(env: VecEnv | gym.Env) -> None:
    """
    :param env: an environment with all its wrappers
    :raises NotSaveable: if it cannot be pickled
    :raises WorkerEnded: if one of its processes has ended
    """
    try:
        dumps(env)
    except (NotSaveable, WorkerEnded):
        raise
    except Exception as error:  # pickling arbitrary objects can raise anything
        raise NotSaveable(_refusal(env, error)) from error


def _refusal(env: VecEnv | gym.Env, error: Exception) -> str:
    """What pickling raised, with the environment or wrapper that is to blame, and the remedy."""
    return (
        f"{type(_culprit(env)).__name__} cannot be saved in the middle of an episode ({error}). Give it __getstate__() "
        "and __setstate__(state), as pickle uses them, which return and restore everything that later steps depend on. "
        "Otherwise, train without checkpoints."
    )


def generator_states(device: th.device) -> tuple[Any, ...]:
    """The states of the process' random generators; if the device is a GPU also of all GPUs, and the settings of cuDNN."""
    cudnn = th.backends.cudnn
    cuda = (th.cuda.get_rng_state_all(), cudnn.deterministic, cudnn.benchmark) if device.type == "cuda" else ()
    return random.getstate(), np.random.get_state(), th.get_rng_state(), cuda  # noqa: NPY002 (SB3 samples with it)


def restore_generators(states: tuple[Any, ...]) -> None:
    """Put back what :func:`generator_states` returned."""
    python, numpy, torch, cuda = states
    random.setstate(python)
    np.random.set_state(numpy)  # noqa: NPY002
    th.set_rng_state(torch)
    if cuda:
        gpus, th.backends.cudnn.deterministic, th.backends.cudnn.benchmark = cuda
        th.cuda.set_rng_state_all(gpus)


class ResumableSubprocVecEnv(SubprocVecEnv):
    """
    A ``SubprocVecEnv`` that checkpoints can save. Each worker pickles its environment and its random generators. When the
    checkpoint is loaded, new workers start with them. A worker that has ended is an error that says so (``WorkerEnded``).

    :param env_fns: functions that create the environments, called in the workers
    :param start_method: how the workers start, as in ``SubprocVecEnv``
    """

    def __init__(self, env_fns: list[Callable[[], gym.Env]], start_method: str | None = None) -> None:
        super().__init__([partial(_resumable, env_fn) for env_fn in env_fns], start_method)
        self.start_method = start_method

    def reset(self) -> VecEnvObs:
        with self._ended_workers_named():
            return super().reset()

    def step_async(self, actions: np.ndarray) -> None:
        with self._ended_workers_named():
            super().step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        with self._ended_workers_named():
            return super().step_wait()

    def env_method(self, *args: Any, **kwargs: Any) -> list[Any]:
        with self._ended_workers_named():
            return super().env_method(*args, **kwargs)

    @contextmanager
    def _ended_workers_named(self) -> Iterator[None]:
        try:
            yield
        except (EOFError, ConnectionError) as error:
            ended = wait([process.sentinel for process in self.processes], timeout=5)
            for process in self.processes:
                process.join(5 if process.sentinel in ended else 0)  # the exit code follows a little later
            codes = [process.exitcode for process in self.processes]
            raise WorkerEnded(
                f"An environment's process has ended (exit codes {codes}; None: still running). Training cannot go on. If the "
                "run has a checkpoint, it continues from there."
            ) from error

    def close(self) -> None:
        """End the workers. Those that have ended already, as after Ctrl-C, are left out."""
        for remote in () if self.closed else self.remotes:
            with suppress(EOFError, OSError):
                if self.waiting:
                    remote.recv()
                remote.send(("close", None))
        for process in self.processes:
            process.join()
        self.closed = True

    def __reduce__(self) -> tuple[Any, ...]:
        workers = self.env_method("pickled")
        if refused := [worker for worker in workers if isinstance(worker, str)]:
            raise NotSaveable(refused[0])
        rest = _without(self, "remotes", "work_remotes", "processes", "waiting", "closed")
        return _restarted, (type(self), workers, self.start_method), rest


class _Resumable(gym.Wrapper):
    """The outermost wrapper in a worker."""

    def pickled(self) -> bytes | str:
        """
        :return: pickle of the environment and the random generators, or why there is none; an exception would end the worker
        """
        try:
            return dumps((self, generator_states(th.device("cpu"))))
        except NotSaveable as error:
            return str(error)
        except Exception as error:  # as in check_environments
            return _refusal(self.env, error)


def _resumable(env_fn: Callable[[], gym.Env]) -> gym.Env:
    env = env_fn()
    return env if isinstance(env, _Resumable) else _Resumable(env)


def _restarted(cls: type[ResumableSubprocVecEnv], workers: list[bytes], start_method: str | None) -> Any:
    return cls([partial(_unpickled, worker) for worker in workers], start_method)


def _unpickled(worker: bytes) -> gym.Env:
    env, generators = pickle.loads(worker)
    restore_generators(generators)
    return env


class _ContinuedResults(ResultsWriter):
    """
    A Monitor's file. It is opened when the first new episode ends. The episodes that ended after the checkpoint are then
    removed, because they are repeated.

    :param name: path of the file
    :param size: its size at the checkpoint in bytes
    :param extra_keys: its columns after the first three
    """

    def __init__(self, name: str, size: int, extra_keys: tuple[str, ...]) -> None:
        self.place: tuple[str, int, tuple[str, ...]] | None = (name, size, extra_keys)  # None once the file is open

    def write_row(self, epinfo: dict[str, float]) -> None:
        if self.place is not None:
            name, size, extra_keys = self.place
            super().__init__(name, extra_keys=extra_keys, override_existing=False)
            self.file_handler.truncate(min(size, Path(name).stat().st_size))
            self.place = None
        super().write_row(epinfo)

    def close(self) -> None:
        if self.place is None:
            super().close()


def _continuation(writer: ResultsWriter) -> tuple[str, int, tuple[str, ...]]:
    """The arguments of :class:`_ContinuedResults`."""
    if isinstance(writer, _ContinuedResults) and writer.place is not None:
        return writer.place
    writer.file_handler.flush()
    return writer.file_handler.name, writer.file_handler.tell(), tuple(writer.logger.fieldnames)[3:]


def _culprit(env: Any) -> Any:
    """The innermost environment or wrapper that cannot be pickled."""
    inner = [*vars(env).get("envs", []), *(vars(env)[name] for name in ("venv", "env") if name in vars(env))]
    return next((_culprit(part) for part in inner if not _can_be_pickled(part)), env)


def _can_be_pickled(obj: Any) -> bool:
    try:
        dumps(obj)
    except Exception:  # as in check_environments
        return False
    return True


def _begins_anew(cls: type) -> bool:
    return cls.__getstate__ is EzPickle.__getstate__ and cls.__reduce__ is object.__reduce__


def _mujoco_renderer() -> Any:
    """Gymnasium's renderer class if it has been imported; MuJoCo is optional."""
    return getattr(sys.modules.get("gymnasium.envs.mujoco.mujoco_rendering"), "MujocoRenderer", ())


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
