"""FrameStackReplayBuffer samples the same batches as SB3's ReplayBuffer and stores each frame once."""

import copy
import multiprocessing
import pickle
from collections import deque
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from small_models import dicts, images, make_model
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecNormalize, VecTransposeImage

from sb3_robust_bisim.frame_buffer import FrameStackReplayBuffer
from sb3_robust_bisim.runs import packing

ACTION_SPACE = spaces.Box(-1, 1, (2,), dtype=np.float64)
HEIGHT, WIDTH = 13, 14


def image_space(channels: int, channels_first: bool = True) -> spaces.Box:
    shape = (channels, HEIGHT, WIDTH) if channels_first else (HEIGHT, WIDTH, channels)
    return spaces.Box(0, 255, shape, dtype=np.uint8)


class Transitions:
    """Endless transitions of environments with frame stacking, in the form in which SB3 adds them to a buffer."""

    def __init__(self, seed: int, n_envs: int, n_stack: int, n_channels: int, padding: str, p_end: float) -> None:
        self.rng = np.random.default_rng(seed)
        self.n_envs, self.n_stack, self.n_channels, self.padding, self.p_end = n_envs, n_stack, n_channels, padding, p_end
        self.restart()

    def frame(self) -> np.ndarray:
        """Every third frame has a single colour, sometimes black. So different frames are sometimes equal."""
        shape = (self.n_channels, HEIGHT, WIDTH)
        if self.rng.random() < 1 / 3:
            return np.full(shape, self.rng.integers(2), dtype=np.uint8)
        return self.rng.integers(256, size=shape, dtype=np.uint8)

    def first_stack(self) -> np.ndarray:
        frames = [self.frame() for _ in range(self.n_stack)]
        if self.padding != "other frames":
            padding = np.zeros_like(frames[-1]) if self.padding == "zeros" else frames[-1]
            frames[:-1] = [padding] * (self.n_stack - 1)
        return np.concatenate(frames)

    def restart(self) -> None:
        self.obs = np.stack([self.first_stack() for _ in range(self.n_envs)])

    def step(self) -> dict[str, Any]:
        frames = np.stack([self.frame() for _ in range(self.n_envs)])
        next_obs = np.concatenate([self.obs[:, self.n_channels :], frames], axis=1)
        done = self.rng.random(self.n_envs) < self.p_end
        timeout = done & (self.rng.random(self.n_envs) < 0.5)
        transition = {
            "obs": self.obs,
            "next_obs": next_obs,
            "action": self.rng.uniform(-1, 1, (self.n_envs, 2)),
            "reward": self.rng.normal(size=self.n_envs),
            "done": done,
            "infos": [{"TimeLimit.truncated": bool(t)} if d else {} for d, t in zip(done, timeout, strict=True)],
        }
        starts = [self.first_stack() if d else stack for d, stack in zip(done, next_obs, strict=True)]
        self.obs = np.stack(starts)
        return transition


def channels_last(transition: dict[str, Any]) -> dict[str, Any]:
    return transition | {key: np.moveaxis(transition[key], 1, -1) for key in ("obs", "next_obs")}


def assert_same_batches(ours: ReplayBuffer, theirs: ReplayBuffer, seed: int = 0, env: VecNormalize | None = None) -> None:
    np.random.seed(seed)  # noqa: NPY002 (the generator that SB3 samples with)
    expected = theirs.sample(100, env=env)
    next_number = np.random.random()  # noqa: NPY002
    np.random.seed(seed)  # noqa: NPY002
    batch = ours.sample(100, env=env)
    assert np.random.random() == next_number  # noqa: NPY002
    for a, b in zip(batch[:5], expected[:5], strict=True):
        assert a.dtype == b.dtype
        assert a.is_contiguous()
        assert th.equal(a, b)


class Case(NamedTuple):
    """Everything that Hypothesis varies."""

    seed: int
    buffer_size: int
    n_envs: int
    n_stack: int
    n_channels: int
    padding: str
    p_end: float
    handle_timeout_termination: bool
    channels_first: bool
    events: list[str]


cases = st.builds(
    Case,
    seed=st.integers(0, 2**32 - 1),
    buffer_size=st.integers(1, 40),
    n_envs=st.integers(1, 3),
    n_stack=st.integers(1, 4),
    n_channels=st.integers(1, 3),
    padding=st.sampled_from(["first frame", "zeros", "other frames"]),
    p_end=st.sampled_from([0.0, 0.05, 0.5, 1.0]),
    handle_timeout_termination=st.booleans(),
    channels_first=st.booleans(),
    events=st.lists(
        st.sampled_from(["add"] * 30 + ["restart", "reset", "pickle 4", "pickle 5", "deepcopy"]), min_size=30, max_size=120
    ),
)


@settings(derandomize=True, deadline=None, max_examples=150)
@given(cases)
def test_batches_are_bit_identical_to_those_of_sb3_for_any_episodes(case: Case) -> None:
    space = image_space(case.n_stack * case.n_channels, case.channels_first)
    kwargs: dict[str, Any] = {
        "n_envs": case.n_envs,
        "device": "cpu",
        "handle_timeout_termination": case.handle_timeout_termination,
    }
    theirs = ReplayBuffer(case.buffer_size, space, ACTION_SPACE, **kwargs)
    ours = FrameStackReplayBuffer(case.buffer_size, space, ACTION_SPACE, n_stack=case.n_stack, **kwargs)
    source = Transitions(case.seed, case.n_envs, case.n_stack, case.n_channels, case.padding, case.p_end)
    for event in case.events:
        if event == "add":
            transition = source.step() if case.channels_first else channels_last(source.step())
            theirs.add(**transition)
            ours.add(**transition)
        elif event == "restart":  # the environments are reset within an episode, as by a second call of learn
            source.restart()
        elif event == "reset":
            theirs.reset()
            ours.reset()
        elif event == "deepcopy":
            ours = copy.deepcopy(ours)
        else:
            ours = pickle.loads(pickle.dumps(ours, protocol=int(event[-1])))
        assert (ours.size(), ours.pos, ours.full) == (theirs.size(), theirs.pos, theirs.full)
        if ours.size() > 0:
            assert_same_batches(ours, theirs, seed=case.seed)


def filled(buffer: ReplayBuffer, source: Transitions, n_steps: int) -> ReplayBuffer:
    for _ in range(n_steps):
        buffer.add(**source.step())
    return buffer


def test_samples_are_normalised_as_sb3_normalises_them() -> None:
    source = Transitions(0, n_envs=1, n_stack=3, n_channels=1, padding="zeros", p_end=0.1)
    ours = FrameStackReplayBuffer(20, image_space(3), ACTION_SPACE)
    theirs = ReplayBuffer(20, image_space(3), ACTION_SPACE)
    env = VecNormalize(DummyVecEnv([lambda: TinyPixels(HEIGHT, WIDTH)]), training=False)
    env.ret_rms.var = np.array(4.0)
    env.obs_rms = RunningMeanStd(shape=(3, HEIGHT, WIDTH))  # type: ignore[assignment]
    for _ in range(20):
        transition = source.step()
        ours.add(**transition)
        theirs.add(**transition)
    assert_same_batches(ours, theirs, env=env)


def test_a_later_add_does_not_change_earlier_batches() -> None:
    source = Transitions(0, n_envs=1, n_stack=3, n_channels=1, padding="zeros", p_end=0.1)
    buffer = filled(FrameStackReplayBuffer(8, image_space(3), ACTION_SPACE), source, 8)
    batch = buffer.sample(16)
    before = [tensor.clone() for tensor in batch[:5]]
    filled(buffer, source, 20)
    assert all(th.equal(a, b) for a, b in zip(batch[:5], before, strict=True))


@pytest.mark.parametrize("padding", ["first frame", "zeros"])
@pytest.mark.parametrize(("p_end", "n_frames"), [(0.0, 1.1), (0.1, 1.2), (1.0, 2.1)])
def test_memory_holds_each_frame_once_and_stays_bounded(padding: str, p_end: float, n_frames: float) -> None:
    """One frame per transition and one per episode, even after many wrap-arounds and a reset."""
    source = Transitions(0, n_envs=2, n_stack=3, n_channels=1, padding=padding, p_end=p_end)
    buffer = FrameStackReplayBuffer(200, image_space(3), ACTION_SPACE, n_envs=2)
    filled(buffer, source, 150).reset()
    filled(buffer, source, 700)
    assert buffer._n_used < n_frames * 200


def test_only_the_filled_part_is_saved_and_allocated() -> None:
    psutil = pytest.importorskip("psutil")
    process = psutil.Process()
    before = process.memory_info().rss
    space = spaces.Box(0, 255, (9, 84, 84), dtype=np.uint8)
    buffer = FrameStackReplayBuffer(10_000, space, ACTION_SPACE)
    for _ in range(50):
        obs = np.full((1, 9, 84, 84), 7, dtype=np.uint8)  # compresses well
        buffer.add(obs, obs, np.zeros((1, 2)), np.zeros(1), np.zeros(1), [{}])
    saved = pickle.dumps(buffer, protocol=5)
    loaded = pickle.loads(saved)
    assert len(saved) < 5e5
    assert loaded.size() == 50
    assert process.memory_info().rss - before < 50e6


def test_frames_survive_saving_in_several_blocks_compressed_or_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packing, "BLOCK_BYTES", 5 * HEIGHT * WIDTH)
    source = Transitions(0, n_envs=1, n_stack=3, n_channels=1, padding="zeros", p_end=0.1)
    buffer = FrameStackReplayBuffer(60, image_space(3), ACTION_SPACE)
    filled(buffer, source, 25)
    for _ in range(25):  # a still picture, which compresses well
        transition = source.step()
        transition["obs"][...] = transition["next_obs"][...] = 7
        buffer.add(**transition)
    assert_same_batches(pickle.loads(pickle.dumps(buffer, protocol=5)), buffer)


class TinyPixels(gym.Env):
    """Random pictures in episodes of random length. Every second episode is truncated, the others terminate."""

    action_space = spaces.Box(-1, 1, (2,), dtype=np.float32)

    def __init__(self, height: int = 36, width: int = 36) -> None:
        self.observation_space = spaces.Box(0, 255, (height, width, 3), dtype=np.uint8)
        self.episode = 0

    def _frame(self) -> np.ndarray:
        return self.np_random.integers(256, size=self.observation_space.shape, dtype=np.uint8)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.episode += 1
        return self._frame(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        end = self.np_random.random() < 0.2
        return self._frame(), float(action.sum()), bool(end and self.episode % 2), bool(end and not self.episode % 2), {}


class StackRepeatingTheFirstFrame(gym.Wrapper):
    """Frame stacking as in DBC and DrQ-v2."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        height, width, channels = env.observation_space.shape  # type: ignore[misc]
        self.observation_space = spaces.Box(0, 255, (height, width, 3 * channels), dtype=np.uint8)
        self.frames: deque[np.ndarray] = deque(maxlen=3)

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        frame, info = self.env.reset(**kwargs)
        self.frames.extend([frame] * 3)
        return np.concatenate(self.frames, axis=-1), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        frame, reward, terminated, truncated, info = self.env.step(action)
        self.frames.append(frame)
        return np.concatenate(self.frames, axis=-1), reward, terminated, truncated, info


def make_env(stacking: str = "VecFrameStack") -> VecEnv:
    if stacking == "VecFrameStack":
        return VecTransposeImage(VecFrameStack(DummyVecEnv([TinyPixels] * 2), n_stack=3))
    if stacking == "none":
        return VecTransposeImage(DummyVecEnv([TinyPixels] * 2))
    return VecTransposeImage(DummyVecEnv([lambda: StackRepeatingTheFirstFrame(TinyPixels())] * 2))


def make_sac(buffer_class: type[ReplayBuffer], stacking: str = "VecFrameStack", **kwargs: Any) -> SAC:
    return SAC(
        "CnnPolicy",
        make_env(stacking),
        buffer_size=50,
        learning_starts=20,
        batch_size=16,
        train_freq=4,
        policy_kwargs={"net_arch": [16], "features_extractor_kwargs": {"features_dim": 16}},
        replay_buffer_class=buffer_class,
        replay_buffer_kwargs=kwargs,
        seed=0,
        device="cpu",
    )


@pytest.mark.parametrize("stacking", ["VecFrameStack", "first frame repeated"])
def test_sac_learns_exactly_the_same_weights_as_with_sb3s_buffer(stacking: str) -> None:
    # the second call of learn resets the environments in the middle of an episode
    ours = make_sac(FrameStackReplayBuffer, stacking, n_stack=3).learn(100).learn(20)
    theirs = make_sac(ReplayBuffer, stacking).learn(100).learn(20)
    assert ours._n_updates > 0
    for name, weights in theirs.policy.state_dict().items():
        assert th.equal(ours.policy.state_dict()[name], weights), name


def continue_from_file(path: str) -> list[np.ndarray]:
    """Load the replay buffer, fill it past its end, and return a batch."""
    model = make_sac(FrameStackReplayBuffer, n_stack=3)
    model.load_replay_buffer(path)
    return continue_and_sample(model)


def continue_and_sample(model: SAC) -> list[np.ndarray]:
    buffer = model.replay_buffer
    assert buffer is not None
    source = Transitions(1, n_envs=2, n_stack=3, n_channels=3, padding="zeros", p_end=0.3)
    for _ in range(30):
        transition = source.step()
        for key in ("obs", "next_obs"):
            transition[key] = np.pad(transition[key], ((0, 0), (0, 0), (0, 36 - HEIGHT), (0, 36 - WIDTH)))
        buffer.add(**transition)
        np.random.seed(5)  # noqa: NPY002
        batch = buffer.sample(64)
    return [tensor.numpy() for tensor in batch[:5]]


def test_a_saved_buffer_continues_in_a_new_process_like_the_original(tmp_path: Path) -> None:
    model = make_sac(FrameStackReplayBuffer, n_stack=3).learn(30)
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        elsewhere = pool.submit(continue_from_file, str(tmp_path / "buffer.pkl")).result()
    for a, b in zip(elsewhere, continue_and_sample(model), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("space", "kwargs", "message"),
    [
        (spaces.Dict({"image": image_space(9)}), {}, "DictReplayBuffer"),
        (spaces.Box(0, 1, (9, 84, 84), dtype=np.float32), {}, "uint8"),
        (spaces.Box(0, 255, (9,), dtype=np.uint8), {}, "three axes"),
        (spaces.Discrete(3), {}, "ReplayBuffer"),
        (image_space(4), {}, r"4 channels .* n_stack=3.*replay_buffer_kwargs"),
        (image_space(9), {"n_stack": 0}, "n_stack=0"),
        (image_space(9), {"optimize_memory_usage": True}, "optimize_memory_usage=False"),
    ],
)
def test_unsupported_spaces_are_refused_at_construction(space: spaces.Space, kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FrameStackReplayBuffer(10, space, ACTION_SPACE, **kwargs)


def newest_frame_first(transition: dict[str, Any]) -> None:
    for key in ("obs", "next_obs"):
        transition[key] = transition[key][:, ::-1]


def shifted_by_two_frames(transition: dict[str, Any]) -> None:
    transition["next_obs"] = np.roll(transition["next_obs"], -1, axis=1)


def without_terminal_observation(transition: dict[str, Any]) -> None:
    transition["next_obs"] = np.array(transition["next_obs"])
    transition["next_obs"][1] = transition["next_obs"][0]


def one_pixel_of_an_old_frame_changed(transition: dict[str, Any]) -> None:
    transition["next_obs"][1, 0, 0, 0] ^= 1


@pytest.mark.parametrize(
    "spoil", [newest_frame_first, shifted_by_two_frames, without_terminal_observation, one_pixel_of_an_old_frame_changed]
)
def test_observations_that_are_not_frame_stacks_are_refused_and_change_nothing(spoil: Any) -> None:
    source = Transitions(0, n_envs=2, n_stack=3, n_channels=1, padding="first frame", p_end=0.1)
    buffer = filled(FrameStackReplayBuffer(20, image_space(3), ACTION_SPACE, n_envs=2), source, 15)
    untouched = copy.deepcopy(buffer)
    transition = source.step()
    spoil(transition)
    with pytest.raises(ValueError, match=r"not stacks of n_stack=3.*VecFrameStack.*terminal_observation.*ReplayBuffer"):
        buffer.add(**transition)
    source.restart()
    transition = source.step()
    buffer.add(**transition)
    untouched.add(**transition)
    assert_same_batches(buffer, untouched)


def test_the_error_for_an_environment_without_frame_stack_names_the_remedy() -> None:
    with pytest.raises(ValueError, match="Wrap the environment in VecFrameStack"):
        make_sac(FrameStackReplayBuffer, "none", n_stack=3).learn(10)


def test_a_buffer_larger_than_the_memory_causes_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    psutil = pytest.importorskip("psutil")
    n_bytes = 1000 * 3 * HEIGHT * WIDTH
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=n_bytes // 2))
    with pytest.warns(UserWarning, match="lower buffer_size=1000 to 4[45][0-9]"):  # nine tenths of half
        FrameStackReplayBuffer(1000, image_space(9), ACTION_SPACE)


@pytest.mark.parametrize("n_stack", [1, 3])
def test_bisim_sac_stores_each_frame_of_byte_images_once_and_says_so(n_stack: int, capsys: pytest.CaptureFixture) -> None:
    venv = make_vec_env(images)
    model = make_model("CnnPolicy", venv if n_stack == 1 else VecFrameStack(venv, n_stack), verbose=1)
    assert isinstance(model.replay_buffer, FrameStackReplayBuffer)
    assert model.replay_buffer.n_stack == n_stack
    assert capsys.readouterr().out.count(f"Using a FrameStackReplayBuffer with n_stack={n_stack}") == 1
    model.learn(30)


def test_another_buffer_is_kept_if_it_is_named_or_observations_are_no_byte_images() -> None:
    assert type(make_model("CnnPolicy", images(), replay_buffer_class=ReplayBuffer).replay_buffer) is ReplayBuffer
    assert type(make_model().replay_buffer) is ReplayBuffer
    assert type(make_model("MultiInputPolicy", dicts()).replay_buffer) is DictReplayBuffer
