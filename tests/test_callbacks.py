"""The callbacks write the right numbers and pictures to the event files. They do not change the run."""

import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from rl_zoo3.utils import get_callback_list
from small_models import SMALL, events, logged_steps
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_robust_bisim import BisimSAC
from sb3_robust_bisim.callbacks import DenoisingFactorCallback, EmbeddingCallback, ValueBoundCallback, diagnostic
from sb3_robust_bisim.callbacks.denoising import denoising_factor
from sb3_robust_bisim.callbacks.embedding import _pca_figure
from sb3_robust_bisim.cli import zoo, zoo_config
from sb3_robust_bisim.envs import NoiseObservation
from sb3_robust_bisim.runs.checkpoint import Checkpoint, load_checkpoint

SETTINGS: dict[str, Any] = {**SMALL, "learning_starts": 20, "batch_size": 16, "buffer_size": 200, "train_freq": 10}
NOISY = "robust_bisim/SparseCartPole-v0"


class Picture(gym.Env):
    """The state is the shade of an 8x8 frame, and noise is added to it. Steps 1 to 6 pay 0, 0, 0, 1, 1, 1."""

    observation_space = gym.spaces.Box(0, 255, (8, 8, 3), np.uint8)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, noise: int = 128, time_out: bool = False) -> None:
        self.noise = noise
        self.time_out = time_out

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.t = 0
        return self._observe()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.t += 1
        obs, info = self._observe()
        over = self.t == 6
        return obs, float(self.t > 3), over and not self.time_out, over and self.time_out, info

    def _observe(self) -> tuple[np.ndarray, dict]:
        clean = np.full((8, 8, 3), 20 * self.t, np.uint8)
        noise = self.np_random.integers(0, self.noise + 1, (8, 8, 3), dtype=np.uint8)
        return clean + noise, {}


class GreyEnv(Picture):
    observation_space = gym.spaces.Box(0, 255, (8, 8, 1), np.uint8)


def doubled() -> gym.Env:
    noisy = NoiseObservation(Wave(), 1)
    space = gym.spaces.Box(-2, 2, noisy.observation_space.shape, np.float32)
    return gym.wrappers.TransformObservation(noisy, lambda obs: 2 * obs, space)


gym.register("test/Picture-v0", Picture)  # type: ignore[arg-type]
gym.register("test/Doubled-v0", doubled)  # type: ignore[arg-type]


class Wave(gym.Env):
    """An environment without an id, which can only be reset."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        return np.zeros(2, np.float32), {}


class FlatEncoder(th.nn.Module):
    """z is one slice of the observation, for example its first two numbers or the noise at its end."""

    def __init__(self, where: slice) -> None:
        super().__init__()
        self.where = where

    def forward(self, obs: th.Tensor) -> th.Tensor:
        return th.nn.functional.pad(obs.flatten(1)[:, self.where], (0, 48))


def scalars(folder: Path, key: str) -> np.ndarray:
    return np.array([event.value for event in events(folder).Scalars(key)])


def learn(
    folder: Path | None, callback: Any, steps: int = 60, env: Any = None, policy: str = "MlpPolicy", **kwargs: Any
) -> BisimSAC:
    env = gym.make(NOISY, noise_multiplier=2) if env is None else env
    model = BisimSAC(policy, env, tensorboard_log=None if folder is None else str(folder), **{**SETTINGS, **kwargs})
    model.learn(steps, callback)
    model.logger.close()
    return model


def test_the_projector_holds_each_state_with_its_value_and_reward(tmp_path: Path) -> None:
    model = learn(tmp_path, EmbeddingCallback(every=25, n_states=40))
    folders = sorted(path.name for path in (tmp_path / "BisimSAC_1").iterdir() if path.is_dir())
    assert folders == ["00025", "00050", "00060"]  # the last one at the end of training
    last = tmp_path / "BisimSAC_1" / "00060" / "embedding"
    z = np.loadtxt(last / "tensors.tsv")
    header, *rows = (last / "metadata.tsv").read_text().splitlines()
    values = np.array([row.split("\t") for row in rows], dtype=float)
    assert header == "value\treward"
    assert z.shape == (40, 50)
    assert values.shape == (40, 2)
    assert values[:, 0].std() > 0
    # the rows are embeddings of states in the buffer, and the values those of the critic
    with th.no_grad():
        buffer = model.replay_buffer
        assert buffer is not None
        obs = th.as_tensor(buffer.observations[:60, 0])
        stored = model.critic.features_extractor.encode(obs)
        q = model.critic(obs, model.actor(obs, deterministic=True))
    rows_of_z = th.as_tensor(z).float()
    distance, nearest = (rows_of_z[:, None] - stored).norm(dim=-1).min(dim=1)
    assert distance.max() < 1e-5
    np.testing.assert_allclose(th.cat(q, dim=1).min(dim=1).values[nearest], values[:, 0], atol=1e-4)
    assert 'tensor_path: "00060/embedding/tensors.tsv"' in (tmp_path / "BisimSAC_1" / "projector_config.pbtxt").read_text()


def test_the_plane_of_the_principal_components_is_drawn(tmp_path: Path) -> None:
    learn(tmp_path, EmbeddingCallback(every=30, n_states=40))
    images = events(tmp_path).Images("embedding/pca")
    assert [image.step for image in images] == [30, 60]
    assert images[0].encoded_image_string.startswith(b"\x89PNG")
    assert images[0].encoded_image_string != images[1].encoded_image_string


def test_the_projector_shows_only_the_finished_episodes_of_hindsight_replay(tmp_path: Path) -> None:
    env = gym.wrappers.TimeLimit(BitFlippingEnv(n_bits=10, continuous=True, max_steps=100), 30)
    learn(
        tmp_path,
        EmbeddingCallback(every=20),
        50,
        env,
        "MultiInputPolicy",
        replay_buffer_class=HerReplayBuffer,
        learning_starts=35,
    )
    shown = [len(np.loadtxt(path)) for path in sorted(tmp_path.glob("BisimSAC_1/*/embedding/tensors.tsv"))]
    assert shown == [30, 30]  # at step 40 and at the end; at 20 no episode had ended


def test_frames_become_sprites(tmp_path: Path) -> None:
    from PIL import Image

    env = VecFrameStack(make_vec_env("test/Picture-v0", env_kwargs=dict(noise=0)), 2)
    learn(tmp_path, EmbeddingCallback(every=60, n_states=4), env=env, policy="CnnPolicy")
    folder = tmp_path / "BisimSAC_1" / "00060" / "embedding"
    sprite = np.asarray(Image.open(folder / "sprite.png"))
    assert sprite.shape[:2] == (16, 16)  # 2 x 2 frames of 8 x 8
    assert set(np.unique(sprite)) <= {20 * t for t in range(7)}
    assert len((folder / "metadata.tsv").read_text().splitlines()) == 5


def test_the_newest_of_three_grey_frames_becomes_a_grey_sprite() -> None:
    callback = EmbeddingCallback()
    callback.model = BisimSAC("CnnPolicy", VecFrameStack(DummyVecEnv([lambda: GreyEnv()]), 3), buffer_size=10)
    stack = th.tensor([0, 100, 200], dtype=th.uint8).reshape(1, 3, 1, 1).expand(1, 3, 8, 8)
    assert callback._sprites(stack).unique().tolist() == pytest.approx([200 / 255])


def slow_denoising_factor(anchors: np.ndarray, positives: np.ndarray) -> float:
    """The definition as loops over pairs of (N, n) anchors and (K, N, n) positives."""
    own, other = [], []
    for i, anchor in enumerate(anchors):
        for j in range(len(anchors)):
            for k in range(len(positives)):
                distance = math.sqrt(sum((a - p) ** 2 for a, p in zip(anchor, positives[k, j], strict=True)))
                (own if i == j else other).append(distance)
    d_pos, d_neg = sum(own) / len(own), sum(other) / len(other)
    return (d_neg - d_pos) / (d_neg + d_pos)


class Watching(th.nn.Module):
    """A small linear encoder. It keeps each batch of more than one observation once."""

    def __init__(self, n_inputs: int) -> None:
        super().__init__()
        self.weights = th.arange(50.0 * n_inputs).reshape(50, n_inputs).sin()
        self.batches: list[np.ndarray] = []

    def forward(self, obs: th.Tensor) -> th.Tensor:
        if len(obs) > 1 and not any(np.array_equal(obs, batch) for batch in self.batches):
            self.batches.append(obs.numpy())
        return obs @ self.weights.T


def test_the_denoising_factor_agrees_with_its_definition() -> None:
    rng = np.random.default_rng(0)
    states = rng.normal(size=(7, 3))
    anchors, positives = states + 0.5 * rng.normal(size=(7, 3)), states + 0.5 * rng.normal(size=(4, 7, 3))
    found = denoising_factor(th.as_tensor(anchors), th.as_tensor(positives))
    assert found == pytest.approx(slow_denoising_factor(anchors, positives), abs=1e-12)
    # a state at 3 and one at 0, seen at 1 and 0: own distances 2 and 0, others 3 and 1
    assert denoising_factor(th.tensor([[3.0], [0.0]]), th.tensor([[[1.0], [0.0]]])) == pytest.approx((2 - 1) / (2 + 1))
    # embeddings that ignore the noise have a distance of exactly 0, even far from the origin
    still = th.as_tensor(100 + rng.normal(size=(50, 50)), dtype=th.float32)
    assert denoising_factor(still, still[None].repeat(3, 1, 1)) == 1.0
    assert denoising_factor(th.ones(50, 5), th.ones(3, 50, 5)) == 0.0  # one point


@pytest.mark.parametrize("random_projection", [False, True])
def test_anchors_and_positives_show_the_same_states_under_independent_noise(random_projection: bool, tmp_path: Path) -> None:
    env = gym.make(NOISY, noise_multiplier=1, random_projection=random_projection)
    model = learn(None, None, steps=1, env=env, norm_constraint=False)
    encoder = Watching(8)
    model.critic.features_extractor.extractor.net = encoder
    model.tensorboard_log = str(tmp_path)
    callback = DenoisingFactorCallback(n_states=20, n_positives=5, eval_env_kwargs=dict(noise_mean=100.0))
    model.learn(1, callback)
    assert [len(batch) for batch in encoder.batches] == [20] * 12
    weights = encoder.weights.numpy()
    for key, batches in (("", encoder.batches[:6]), ("_heldout", encoder.batches[6:])):
        seen = np.stack(batches).astype(np.float64)
        found = scalars(tmp_path, f"bisim/denoising_factor{key}")
        assert found == pytest.approx(slow_denoising_factor(seen[0] @ weights.T, seen[1:] @ weights.T), abs=1e-4)
        if random_projection:
            seen = np.linalg.solve(env.get_wrapper_attr("projection"), seen[..., None])[..., 0]
        state, noise = seen[..., :4], seen[..., 4:]
        np.testing.assert_allclose(state, state[:1].repeat(6, axis=0), atol=1e-4)
        assert np.unique(state[0].round(3), axis=0).shape == (20, 4)
        assert abs(noise.mean() - (100 if key else 0)) < 0.2
        # the noise of each look differs from that of the others
        assert np.unique(noise.round(4)).size > 0.9 * noise.size
        assert noise.std() == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("n_stack", [1, 3])
@pytest.mark.parametrize(("where", "expected"), [(slice(0, 2), 1.0), (slice(-2, None), 0.0)])
def test_the_denoising_factor_separates_states_from_noise(where: slice, expected: float, n_stack: int, tmp_path: Path) -> None:
    env = VecFrameStack(make_vec_env(NOISY, env_kwargs=dict(noise_multiplier=2)), n_stack)
    model = learn(None, None, steps=1, env=env)
    model.critic.features_extractor.extractor.net = FlatEncoder(where)
    model.tensorboard_log = str(tmp_path)
    model.learn(1, DenoisingFactorCallback())
    assert scalars(tmp_path, "bisim/denoising_factor") == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize("n_stack", [1, 3])
def test_from_pixels_all_looks_show_the_same_robot_in_front_of_different_backgrounds(n_stack: int) -> None:
    pytest.importorskip("dm_control")
    from stable_baselines3.common.vec_env import DummyVecEnv

    def task() -> gym.Env:
        return gym.make("robust_bisim/cartpole-swingup-pixels-v0", size=24, distractor="color", action_repeat=50)

    model = BisimSAC("CnnPolicy", VecFrameStack(DummyVecEnv([task]), n_stack), **SETTINGS)
    looks = []
    embed = model.critic.features_extractor.forward
    model.critic.features_extractor.forward = lambda x: looks.append(x.numpy().copy()) or embed(x)  # type: ignore[method-assign]
    assert -1 <= DenoisingFactorCallback(n_states=6, n_positives=3).factor_of(model) <= 1
    frames = np.stack([look for look in looks if len(look) == 6])  # anchors, then positives
    assert frames.shape == (4, 6, 3 * n_stack, 24, 24)
    frames = frames.reshape(4, 6, n_stack, 3, 24, 24)
    backgrounds = frames[..., :1, :1]
    robot = (frames != backgrounds).any(axis=3)
    assert (robot == robot[:1]).mean() > 0.99  # the same state (edges are blended with the background)
    assert (backgrounds == backgrounds[:, :, :1]).all()  # a colour stays for a whole episode, and so for a stack
    assert len(np.unique(backgrounds[:, 0, 0, :, 0, 0], axis=0)) == 4
    assert len(np.unique(robot[0], axis=0)) > 1


def test_measuring_once_closes_both_environments() -> None:
    model = learn(None, None, steps=12)
    callback = DenoisingFactorCallback(n_states=6, n_positives=3, eval_env_kwargs=dict(noise_mean=1.0))
    callback.factor_of(model)
    assert callback._venv is None
    assert callback._held_out is not None
    assert callback._held_out._venv is None


def test_an_embedding_of_one_number_is_drawn() -> None:
    assert _pca_figure(th.randn(10, 1), th.randn(10, 1)).figure.axes


def test_no_held_out_number_is_recorded_unless_asked_for(tmp_path: Path) -> None:
    learn(tmp_path, DenoisingFactorCallback(30, 10))
    assert "bisim/denoising_factor_heldout" not in events(tmp_path).Tags()["scalars"]


@pytest.mark.parametrize(("time_out", "rest"), [(False, 0.0), (True, 2.0)])
def test_exact_distances_satisfy_the_bound_and_a_collapsed_embedding_violates_it(
    time_out: bool, rest: float, tmp_path: Path
) -> None:
    # steps 0 to 5 are followed by the rewards 0, 0, 0, 1, 1, 1 and, if time ran out, by what the critic expects
    rewards = [0, 0, 0, 1, 1, 1, rest]
    values = th.tensor([sum(0.9**k * reward for k, reward in enumerate(rewards[t:])) for t in range(7)])
    for scale in (0.0, 1.01):
        env = gym.make("test/Picture-v0", noise=0, time_out=time_out)
        model = BisimSAC("CnnPolicy", env, gamma=0.9, distance="l1", tensorboard_log=str(tmp_path / str(scale)), **SETTINGS)

        def encode(obs: th.Tensor, scale: float = scale) -> th.Tensor:
            return th.nn.functional.pad(scale * values[(255 * obs[:, 0, 0, :1] / 20).round().long()], (0, 49))

        model.critic.features_extractor.forward = encode  # type: ignore[method-assign,assignment]
        model.critic.forward = lambda obs, actions: (th.full((len(actions), 1), 2.0),)  # type: ignore[method-assign]
        model.learn(1, ValueBoundCallback(n_states=30))
        found = {key: scalars(tmp_path / str(scale), f"bisim/value_{key}")[0] for key in ("gap", "bound", "bound_violations")}
        assert found["gap"] > 0
        assert found["bound"] == pytest.approx(scale * found["gap"], rel=1e-4)
        assert found["bound_violations"] == (0 if scale > 1 else pytest.approx(5 / 6, abs=0.05))  # all but equal states


def test_callbacks_leave_the_trained_weights_the_same_bit_for_bit(tmp_path: Path) -> None:
    denoising = DenoisingFactorCallback(20, 10, eval_env_kwargs=dict(noise_mean=1.0))
    callbacks = [EmbeddingCallback(20, 10), denoising, ValueBoundCallback(20, 10)]
    watched, alone = (learn(tmp_path, callback) for callback in (callbacks, None))
    for name, value in watched.policy.state_dict().items():
        assert th.equal(value, alone.policy.state_dict()[name]), name


def test_a_resumed_run_is_measured_at_the_same_steps(tmp_path: Path) -> None:
    checkpoint = tmp_path / "checkpoint.pkl"
    callback = DenoisingFactorCallback(every=30, n_states=10, eval_env_kwargs=dict(noise_mean=1.0))
    learn(tmp_path, [callback, Checkpoint(checkpoint, 40, context=callback)], steps=50)
    model, callback = load_checkpoint(checkpoint)
    assert model.num_timesteps == 40
    model.learn(60, callback, reset_num_timesteps=False)
    for key in ("denoising_factor", "denoising_factor_heldout"):
        assert logged_steps(tmp_path, f"bisim/{key}") == [30, 50, 60, 90, 100]  # step 50 ended the lost part


def test_a_zoo_yaml_can_name_the_callbacks(tmp_path: Path) -> None:
    names = ["EmbeddingCallback", "DenoisingFactorCallback", "ValueBoundCallback"]
    first, *others = [f"sb3_robust_bisim.callbacks.{name}" for name in names]
    callbacks = get_callback_list({"callback": [first, *({name: {"every": 30, "n_states": 20}} for name in others)]})
    venv = VecNormalize(make_vec_env(NOISY, 2, env_kwargs=dict(noise_multiplier=1)), norm_reward=False)
    learn(tmp_path, callbacks, env=venv)
    found = events(tmp_path).Tags()
    keys = ("denoising_factor", "value_bound_violations", "value_gap", "value_bound")
    assert {f"bisim/{key}" for key in keys} <= set(found["scalars"])
    assert {"embedding/pca", "bisim/value_gap_against_bound"} <= set(found["images"])
    for key in keys:
        values = scalars(tmp_path, f"bisim/{key}")
        assert len(values) == 2
        assert np.isfinite(values).all()


@pytest.mark.parametrize(
    ("callback", "env", "message"),
    [
        (EmbeddingCallback(), None, "tensorboard_log=None"),
        (DenoisingFactorCallback(), gym.make(NOISY), "noise_multiplier > 0"),
        (
            DenoisingFactorCallback(env_kwargs=dict(noise_multiplier=1)),
            gym.make(NOISY),
            r"env_kwargs=\{'noise_multiplier': 1\}",
        ),
        (DenoisingFactorCallback(), gym.make(NOISY, random_projection=True), "noise_multiplier > 0"),
        (
            DenoisingFactorCallback(eval_env_kwargs=dict(noise_mean=math.nan)),
            gym.make(NOISY, noise_multiplier=1),
            "noise_mean must be a finite number",
        ),
        (DenoisingFactorCallback(), gym.make("test/Doubled-v0"), "outermost wrapper that changes observations"),
        (ValueBoundCallback(), DummyVecEnv([lambda: NoiseObservation(Wave(), 1)]), "pass env_id"),
        (
            ValueBoundCallback(env_id="Pendulum-v1"),
            None,
            r"(?s)env_id='Pendulum-v1', env_kwargs=\{\}: ValueBoundCallback would observe .*, the agent observes Box.* Pass",
        ),
    ],
)
def test_callbacks_that_cannot_work_are_refused_when_training_starts(callback: BaseCallback, env: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        learn(None, callback, steps=10**9, env=env)


def test_the_zoo_shows_why_training_did_not_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = yaml.safe_load(zoo_config.DEFAULT_CONFIG.read_text())
    content[NOISY] |= {"callback": "sb3_robust_bisim.callbacks.ValueBoundCallback", "c_r": 0.0, "norm_constraint": False}
    (tmp_path / "config.yml").write_text(yaml.dump(content))
    monkeypatch.setattr("sys.argv", ["sb3_robust_bisim"])
    with pytest.raises(ValueError, match="c_r > 0"):
        zoo.main(["train", "--env", NOISY, "-conf", str(tmp_path / "config.yml"), "-f", str(tmp_path), "--eval-freq", "-1"])


def test_an_agent_with_nan_weights_is_not_measured(tmp_path: Path) -> None:
    callback = EmbeddingCallback(every=10**6)
    model = learn(tmp_path, callback, steps=30)
    with th.no_grad():
        next(model.policy.parameters()).fill_(th.nan)
    callback.num_timesteps += 1
    callback.on_training_end()  # as the zoo does after "training has stopped"
    assert len(list(tmp_path.glob("BisimSAC_1/*/embedding/tensors.tsv"))) == 1


def test_a_value_bound_needs_rewards_in_the_metric() -> None:
    with pytest.raises(ValueError, match="c_r > 0"):
        learn(None, ValueBoundCallback(), steps=10**9, c_r=0.0, norm_constraint=False)


def test_endless_episodes_end_in_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnostic, "LONGEST_WALK", 5)
    with pytest.raises(ValueError, match=r"n_states=20: ValueBoundCallback .* in 5 steps of robust_bisim/SparseCartPole-v0"):
        learn(None, ValueBoundCallback(n_states=20), steps=1)


def test_another_algorithm_is_refused() -> None:
    with pytest.raises(ValueError, match="works with BisimSAC"):
        SAC("MlpPolicy", "Pendulum-v1").learn(10**9, EmbeddingCallback())


def test_the_value_bound_counts_the_reward_of_absorbing_states(tmp_path: Path) -> None:
    bounds = []
    for absorbing in (False, True):
        env = gym.make("test/Picture-v0", noise=0)
        folder, distance = tmp_path / str(absorbing), dict(distance="l1", metric_kwargs={"absorbing": absorbing})
        settings = {**SETTINGS, "reward_range": (-2.0, -1.0), "norm_constraint": False, "c_t": 0.5, "gamma": 0.9, **distance}
        BisimSAC("CnnPolicy", env, tensorboard_log=str(folder), **settings).learn(1, ValueBoundCallback(n_states=10))
        bounds.append(scalars(folder, "bisim/value_bound")[0])
    # the same distances; what c_T < gamma leaves out grows with the span of the rewards, 1 or 2
    assert bounds[1] > 1.5 * bounds[0]


@pytest.mark.parametrize("every", [np.int64(5), 5])
def test_integers_of_numpy_are_integers(every: Any) -> None:
    assert DenoisingFactorCallback(every=every).every == 5


@pytest.mark.parametrize(("name", "value"), [("every", 0), ("every", 2.5), ("every", True), ("n_states", 1)])
def test_callback_arguments_outside_their_range_are_refused(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{name}={value}"):
        EmbeddingCallback(**{name: value})


@pytest.mark.parametrize("value", [0, 1.5])
def test_an_invalid_number_of_positives_is_refused(value: Any) -> None:
    with pytest.raises(ValueError, match=f"n_positives={value}: DenoisingFactorCallback needs an integer >= 1"):
        DenoisingFactorCallback(n_positives=value)
