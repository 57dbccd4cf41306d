"""A replay buffer that stores each frame of stacked images once, and samples the same batches as SB3's buffer."""

import copyreg
import warnings
from functools import partial
from typing import Any, SupportsIndex, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize, unwrap_vec_wrapper

from sb3_robust_bisim.runs.packing import pack, unpack

try:
    import psutil
except ImportError:  # part of SB3's extras
    psutil = None

Images = TypeVar("Images", np.ndarray, th.Tensor)
BLANK = 0  # slot of the all-zero frame, which VecFrameStack uses to fill a stack after a reset
ROWS = ("actions", "rewards", "dones", "timeouts", "_slots")  # arrays with one row per step of the environments


class FrameStackReplayBuffer(ReplayBuffer):
    """
    Replay buffer for stacked images that stores every frame once.

    SB3's ``ReplayBuffer`` keeps ``2 * n_stack`` copies of each frame. Here all frames are in one pool. A transition stores the
    ``n_stack + 1`` slots of the frames in its two stacks: the first ``n_stack`` are the observation, the last ``n_stack`` the
    next observation. A slot is free again once no transition refers to it. Episodes can have any length, and a stack can be
    filled in any way after a reset: with the first frame repeated, with zeros, or with other frames. For the same transitions
    and the same state of NumPy's global random generator, batches equal those of SB3's ``ReplayBuffer`` bit by bit.

    :param buffer_size: Number of transitions, summed over all environments; rounded down to whole steps, at least one
    :param observation_space: ``Box`` of dtype uint8 and shape ``(n_stack * C, H, W)``, or ``(H, W, n_stack * C)``; the oldest
        frame comes first. The smallest axis holds the channels, as in SB3.
    :param action_space: Action space
    :param device: PyTorch device of the samples
    :param n_envs: Number of parallel environments
    :param optimize_memory_usage: Must be False, because SB3's variant overwrites the last frames of an episode
    :param handle_timeout_termination: Do not treat a time-out (``info["TimeLimit.truncated"]``) as terminal
    :param n_stack: Number of frames in an observation, at least 1
    :raises ValueError: if the space does not hold ``n_stack`` stacked uint8 images, or ``optimize_memory_usage`` is set

    Example::

        from stable_baselines3 import SAC
        from stable_baselines3.common.env_util import make_vec_env
        from stable_baselines3.common.envs import FakeImageEnv
        from stable_baselines3.common.vec_env import VecFrameStack

        env = make_vec_env(lambda: FakeImageEnv(n_channels=3, discrete=False), n_envs=2)
        model = SAC(
            "CnnPolicy",
            VecFrameStack(env, n_stack=3),
            buffer_size=1000,
            replay_buffer_class=FrameStackReplayBuffer,
            replay_buffer_kwargs={"n_stack": 3},
        )
        model.learn(200)
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        n_stack: int = 3,
    ) -> None:
        if optimize_memory_usage:
            raise ValueError(
                "optimize_memory_usage=True is SB3's way to save memory, and it is wrong with time-outs. "
                "FrameStackReplayBuffer needs less memory without it: pass optimize_memory_usage=False."
            )
        channels_first = _check_space(observation_space, n_stack)
        # ReplayBuffer.__init__ would allocate the full stacks
        super(ReplayBuffer, self).__init__(buffer_size, observation_space, action_space, device, n_envs=n_envs)
        self.buffer_size = max(buffer_size // n_envs, 1)
        self.optimize_memory_usage = False
        self.handle_timeout_termination = handle_timeout_termination
        self.n_stack = n_stack
        self._channels_first = channels_first
        channels, height, width = self.obs_shape if channels_first else (self.obs_shape[2], *self.obs_shape[:2])
        self._frame_shape = (channels // n_stack, height, width)
        self._allocate()
        self.reset()
        n_bytes = self.buffer_size * n_envs * self._frames[BLANK].nbytes
        if psutil is not None and n_bytes > (available := psutil.virtual_memory().available):
            # The system provides memory only when it is written to: without a warning, the run would fail late
            message = f"The full replay buffer needs {n_bytes / 1e9:.2f} GB, but {available / 1e9:.2f} GB are available"
            fits = int(0.9 * available / n_bytes * buffer_size)
            warnings.warn(f"{message}: lower buffer_size={buffer_size} to {fits}.", stacklevel=2)

    def _allocate(self, n_used: int = 0) -> None:
        """Allocate memory for at least ``n_used`` frames. The system provides it only when it is written to."""
        rows = (self.buffer_size, self.n_envs)
        # One new frame per transition and one per episode, which may be one step long. Slots that are free again are used
        # before new ones, so unused slots need no memory. The pool grows only if stacks start with more than one new frame.
        n_frames = max(2 * self.buffer_size * self.n_envs + self.n_envs * (self.n_stack + 1), n_used)
        self.actions = np.zeros((*rows, self.action_dim), dtype=self._maybe_cast_dtype(self.action_space.dtype))
        self.rewards = np.zeros(rows, dtype=np.float32)
        self.dones = np.zeros(rows, dtype=np.float32)
        self.timeouts = np.zeros(rows, dtype=np.float32)
        self._slots = np.zeros((*rows, self.n_stack + 1), dtype=np.int32)
        self._frames = np.zeros((n_frames, *self._frame_shape), dtype=np.uint8)
        self._references = np.zeros(n_frames, dtype=np.int32)

    def reset(self) -> None:
        """Remove all transitions. The memory stays allocated."""
        super().reset()
        self._slots[...] = BLANK
        self._references[...] = 0
        self._references[BLANK] = self._slots.size + 1  # more than there can be, so it is never free
        self._n_used = 1  # slots below this number have been used, the others never
        self._free: list[int] = []  # slots that have been used, and that no transition refers to any more

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Store one transition of every environment.

        :param obs: Observations, ``(n_envs, *obs_shape)``
        :param next_obs: Next observations of the same episodes, of the same shape; ``info["terminal_observation"]`` if the
            episode ended
        :param action: Actions, ``(n_envs, action_dim)``
        :param reward: Rewards, ``(n_envs,)``
        :param done: Whether the episode ended, ``(n_envs,)``
        :param infos: One info dictionary per environment
        :raises ValueError: if ``next_obs`` is not ``obs`` shifted by one frame; the buffer is then unchanged
        """
        stacks, next_stacks = self._as_stacks(obs), self._as_stacks(next_obs)
        starts = self._find_starts(stacks, next_stacks)
        slots = np.empty((self.n_envs, self.n_stack + 1), dtype=np.int32)
        slots[:, :-1] = self._slots[self.pos - 1, :, 1:]
        for env_idx in starts:
            slots[env_idx, :-1] = self._store_first_stack(stacks[env_idx])
        slots[:, -1] = self._store_frames(next_stacks[:, -1])
        self._replace_row(slots)

        self.actions[self.pos] = np.array(action).reshape(self.n_envs, self.action_dim)
        self.rewards[self.pos] = np.array(reward)
        self.dones[self.pos] = np.array(done)
        if self.handle_timeout_termination:
            self.timeouts[self.pos] = np.array([info.get("TimeLimit.truncated", False) for info in infos])
        self.pos += 1
        if self.pos == self.buffer_size:
            self.full = True
            self.pos = 0

    def _as_stacks(self, obs: np.ndarray) -> np.ndarray:
        """View observations ``(n_envs, *obs_shape)`` as ``(n_envs, n_stack, *frame_shape)``."""
        channels_first = obs if self._channels_first else np.moveaxis(obs, -1, 1)
        return channels_first.reshape(self.n_envs, self.n_stack, *self._frame_shape)

    def _find_starts(self, stacks: np.ndarray, next_stacks: np.ndarray) -> list[int]:
        """
        Find the environments whose observation is not the next observation of their last transition.

        These environments have started an episode. ``done`` is not always set before it: another call of ``learn`` resets the
        environments, and a buffer may come from a file. The storage relies only on this comparison and on the shift by one
        frame, so every transition is checked.

        :param stacks: Observations, ``(n_envs, n_stack, *frame_shape)``
        :param next_stacks: Next observations, of the same shape
        :return: Indices of those environments
        :raises ValueError: if ``next_stacks`` is not ``stacks`` shifted by one frame
        """
        starts = []
        for env_idx in range(self.n_envs):
            # Contiguous copies of one environment fit into the cache; VecTransposeImage returns transposed views
            stack, next_stack = (np.ascontiguousarray(x[env_idx], dtype=np.uint8) for x in (stacks, next_stacks))
            if not np.array_equal(stack[1:], next_stack[:-1]):
                raise ValueError(
                    f"The observations are not stacks of n_stack={self.n_stack} frames of shape {self._frame_shape}: the "
                    f"first {self.n_stack - 1} frames of next_obs differ from the last {self.n_stack - 1} frames of obs in "
                    f"environment {env_idx}. Wrap the environment in VecFrameStack(env, n_stack={self.n_stack}), with no "
                    "wrapper around it that changes single frames. Pass the n_stack of your environment "
                    '(replay_buffer_kwargs={"n_stack": ...}). In a VecEnv of your own, set info["terminal_observation"] '
                    "at the end of an episode. For other images use SB3's ReplayBuffer."
                )
            if not np.array_equal(stack, self._frames[self._slots[self.pos - 1, env_idx, 1:]]):
                starts.append(env_idx)
        return starts

    def _store_first_stack(self, stack: np.ndarray) -> list[int]:
        """Store the first observation of an episode and return its slots. Padding needs no new slots."""
        slots: list[int] = []
        for i, frame in enumerate(stack):
            if not frame.any():
                slots.append(BLANK)
            elif i > 0 and np.array_equal(frame, stack[i - 1]):
                slots.append(slots[-1])
            else:
                slots.extend(self._store_frames(frame[None]))
        return slots

    def _store_frames(self, frames: np.ndarray) -> list[int]:
        """Write frames ``(n, *frame_shape)`` to the pool and return their slots."""
        slots = [self._free.pop() for _ in range(min(len(frames), len(self._free)))]
        n_new = len(frames) - len(slots)
        slots.extend(range(self._n_used, self._n_used + n_new))
        self._n_used += n_new
        if self._n_used > len(self._frames):
            # There are no other references to these arrays, so they may move
            n_frames = max(self._n_used, len(self._frames) + len(self._frames) // 8)
            self._frames.resize((n_frames, *self._frame_shape), refcheck=False)
            self._references.resize(n_frames, refcheck=False)
        self._frames[slots] = frames
        return slots

    def _replace_row(self, slots: np.ndarray) -> None:
        """Assign new slots to the transitions at ``pos``, and free the slots that only the old transitions there used."""
        old = self._slots[self.pos].flatten()
        np.add.at(self._references, slots, 1)
        np.subtract.at(self._references, old, 1)
        self._free.extend(np.unique(old[self._references[old] == 0]).tolist())
        self._slots[self.pos] = slots

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """
        :param batch_inds: Rows of the transitions, ``(batch_size,)``
        :param env: Normalises observations and rewards, if given
        :return: The transitions; the environment of each one is random, as in SB3's ``ReplayBuffer``
        """
        env_indices = np.random.randint(0, high=self.n_envs, size=(len(batch_inds),))  # noqa: NPY002 (SB3's generator)
        slots = self._slots[batch_inds, env_indices]
        dones = self.dones[batch_inds, env_indices] * (1 - self.timeouts[batch_inds, env_indices])
        data = (
            self._normalize_obs(self._gather(slots[:, :-1]), env),
            self.actions[batch_inds, env_indices, :],
            self._normalize_obs(self._gather(slots[:, 1:]), env),
            dones.reshape(-1, 1),
            self._normalize_reward(self.rewards[batch_inds, env_indices].reshape(-1, 1), env),
        )
        # All arrays above are new, so the tensors may share their memory. Another copy would take as long as sampling
        return ReplayBufferSamples(*map(partial(self.to_torch, copy=False), data))

    def _gather(self, slots: np.ndarray) -> np.ndarray:
        """Stack the frames of slots ``(batch_size, n_stack)`` into a new array ``(batch_size, *obs_shape)``."""
        stacks = np.take(self._frames, slots, axis=0)
        channels_first = stacks.reshape(len(slots), -1, *self._frame_shape[1:])
        return channels_first if self._channels_first else np.ascontiguousarray(np.moveaxis(channels_first, 1, -1))

    def __reduce_ex__(self, protocol: SupportsIndex) -> tuple[Any, ...]:
        """Pickle only the filled part. With protocol 5, which SB3 uses, frames that do not compress are never copied."""
        state = self.__dict__.copy()
        for name in ROWS:
            state[name] = state[name][: self.size()]
        state["_references"] = self._references[: self._n_used]
        state["_frames"] = pack(self._frames[: self._n_used], in_place=int(protocol) >= 5)
        return copyreg.__newobj__, (type(self),), state  # type: ignore[attr-defined]

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the state that ``__reduce_ex__`` returned."""
        rows = {name: state.pop(name) for name in ROWS}
        references, blocks = state.pop("_references"), state.pop("_frames")
        self.__dict__.update(state)
        self._allocate(self._n_used)
        for name, filled in rows.items():
            getattr(self, name)[: len(filled)] = filled
        self._references[: self._n_used] = references
        unpack(blocks, self._frames)


def frames_per_observation(venv: VecEnv) -> int:
    """Number of frames that a chain of wrappers stacks; 1 without a VecFrameStack."""
    stack = unwrap_vec_wrapper(venv, VecFrameStack)
    return 1 if stack is None else stack.stacked_obs.n_stack


def newest_frames(stacks: Images, n_stack: int) -> Images:
    """
    :param stacks: (B, n_stack * C, H, W), in colour (C = 3) or grey
    :param n_stack: frames in a stack
    :return: (B, 3, H, W), the last frame of each
    """
    return stacks[:, [-3, -2, -1] if stacks.shape[1] == 3 * n_stack else [-1, -1, -1]]


def choose_buffer(model: OffPolicyAlgorithm) -> None:
    """
    Give an agent that observes byte images, and for which no buffer has been named, one that stores each frame once.

    :param model: algorithm whose environment is known, before its buffer is made
    """
    space = model.observation_space
    bytes_ = isinstance(space, spaces.Box) and space.dtype == np.uint8 and is_image_space(space)
    if model.replay_buffer_class is not None or model.env is None or not bytes_:
        return
    model.replay_buffer_class = FrameStackReplayBuffer
    model.replay_buffer_kwargs = {"n_stack": frames_per_observation(model.env), **model.replay_buffer_kwargs}
    if model.verbose > 0:
        n_stack = model.replay_buffer_kwargs["n_stack"]
        print(f"Using a FrameStackReplayBuffer with n_stack={n_stack}, which stores each frame once")


def _check_space(observation_space: spaces.Space, n_stack: int) -> bool:
    """Raise an error unless the space holds stacked images, and return whether the channels come first."""
    if n_stack < 1:
        raise ValueError(f"n_stack={n_stack} must be at least 1: pass the number of frames in an observation.")
    shape, dtype = observation_space.shape, observation_space.dtype
    if not isinstance(observation_space, spaces.Box) or shape is None or len(shape) != 3 or dtype != np.uint8:
        raise ValueError(
            f"observation_space={observation_space} is not a Box of uint8 images with three axes. This buffer stores nothing "
            "else: leave the scaling of images to the policy, or use SB3's ReplayBuffer or DictReplayBuffer."
        )
    channels_first = is_image_space_channels_first(observation_space)
    channels = shape[0 if channels_first else 2]
    if channels % n_stack != 0:
        raise ValueError(
            f"The {channels} channels of observation_space.shape={shape} are not divisible by n_stack={n_stack}: pass the "
            'number of frames that the environment stacks, replay_buffer_kwargs={"n_stack": ...}.'
        )
    return channels_first
