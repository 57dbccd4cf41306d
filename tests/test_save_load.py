"""Saving and loading restores nets, optimizers, counters, bonus and replay buffer, even in another process."""

import io
import json
import subprocess
import sys
import threading
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from small_models import layers, make_model, pendulum
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_robust_bisim import BisimSAC, IntrinsicRewardVecEnv
from sb3_robust_bisim.policies import MlpPolicy

OBSERVATIONS = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
STATE_DICTS = {
    "policy",
    "actor.optimizer",
    "critic.optimizer",
    "ent_coef_optimizer",
    "policy.representation.inverse_dynamics.optimizer",
}


@pytest.fixture(scope="module")
def trained() -> Any:
    """A model after 10 random steps and 3 + 4 updates. Tests must not change it."""
    return make_model(initial_gradient_steps=3).learn(15)


@pytest.fixture
def saved(trained: Any, tmp_path: Path) -> Path:
    trained.save(tmp_path / "model")
    return tmp_path / "model.zip"


def actions_of(model: Any) -> np.ndarray:
    return model.predict(OBSERVATIONS, deterministic=True)[0]


def bonus_layers(model: Any) -> list[IntrinsicRewardVecEnv]:
    return [layer for layer in layers(model.get_env()) if isinstance(layer, IntrinsicRewardVecEnv)]


def bonuses(model: Any, steps: int = 3) -> list[float | None]:
    """The bonus of each step while the model learns. None stands for a step without a bonus."""
    paid: list[float | None] = []

    def note(found: dict[str, Any], _: dict[str, Any]) -> bool:
        paid.append(found["infos"][0].get("intrinsic_reward"))
        return True

    model.learn(steps, reset_num_timesteps=False, callback=note)
    return paid


def assert_same(left: Any, right: Any) -> None:
    th.testing.assert_close(left, right, rtol=0, atol=0)


def without_text(state: Any) -> Any:
    """A state dict as nested dicts and lists of numbers and tensors, because torch can compare those."""
    if isinstance(state, dict):
        return {str(key): without_text(value) for key, value in state.items() if value is not None}
    return [without_text(value) for value in state] if isinstance(state, (list, tuple)) else state


def test_load_restores_all_nets_optimizers_and_counters(trained: Any, saved: Path) -> None:
    assert set(trained.get_parameters()) == STATE_DICTS
    for optimizer in STATE_DICTS - {"policy"}:
        assert trained.get_parameters()[optimizer]["state"]  # there is a state that could be lost
    loaded: Any = BisimSAC.load(saved)
    assert_same(without_text(loaded.get_parameters()), without_text(trained.get_parameters()))
    assert_same(loaded.log_ent_coef, trained.log_ent_coef)
    np.testing.assert_array_equal(actions_of(loaded), actions_of(trained))
    assert (loaded._n_updates, loaded.num_timesteps) == (trained._n_updates, trained.num_timesteps) == (7, 15)
    assert loaded.policy_kwargs == trained.policy_kwargs


@pytest.mark.parametrize("how", ["load(env)", "set_env", "load(bound env)"])
def test_a_loaded_model_continues_with_one_bonus_and_no_initial_gradient_steps(trained: Any, saved: Path, how: str) -> None:
    env = make_model().get_env() if how == "load(bound env)" else pendulum()
    loaded: Any = BisimSAC.load(saved, env=None if how == "set_env" else env)
    if how == "set_env":
        loaded.set_env(env)
    assert len(bonus_layers(loaded)) == 1
    loaded.learn(12, reset_num_timesteps=False)  # the loaded model starts with an empty buffer
    assert loaded._n_updates == 7 + 12
    assert not np.array_equal(actions_of(loaded), actions_of(trained))
    assert all(value is not None for value in bonuses(loaded))


def test_set_env_uses_an_existing_wrapper_and_each_model_learns_from_its_own_bonus() -> None:
    first, env = make_model(), IntrinsicRewardVecEnv(DummyVecEnv([pendulum]))
    for _ in range(2):
        first.set_env(env)
        assert bonus_layers(first) == [env]
    clamped, without = make_model(env=env, intrinsic_reward_max=0.0), make_model(env=env, intrinsic_reward_scale=0.0)
    assert bonuses(clamped) == [0.0] * 3
    assert bonuses(without) == [None] * 3
    assert all(bonuses(first))


def test_set_env_accepts_a_vecnormalize_with_the_bonus_inside() -> None:
    model = make_model()
    env = VecNormalize(IntrinsicRewardVecEnv(DummyVecEnv([pendulum])), norm_reward=False)
    model.set_env(env)
    assert bonus_layers(model) == [env.venv]
    assert model.get_vec_normalize_env() is env
    assert all(bonuses(model))
    model.learn(12)


SCRIPT = """
import sys
from pathlib import Path
import gymnasium as gym, numpy as np, torch as th
from sb3_robust_bisim import BisimSAC
folder = Path(sys.argv[1])
model = BisimSAC.load(folder / "model", env=gym.make("Pendulum-v1", max_episode_steps=7))
model.load_replay_buffer(folder / "buffer")
np.save(folder / "actions.npy", model.predict(np.load(folder / "observations.npy"), deterministic=True)[0])
th.save(model.get_parameters(), folder / "parameters.pt")
model.learn(8, reset_num_timesteps=False)
assert all(th.isfinite(parameter).all() for parameter in model.policy.parameters())
model.save(folder / "later")
"""


def test_a_fresh_process_continues_where_training_stopped(trained: Any, saved: Path) -> None:
    folder = saved.parent
    trained.save_replay_buffer(folder / "buffer")
    np.save(folder / "observations.npy", OBSERVATIONS)
    subprocess.run([sys.executable, "-c", SCRIPT, str(folder)], check=True, timeout=300)
    np.testing.assert_allclose(np.load(folder / "actions.npy"), actions_of(trained), rtol=1e-5)
    parameters = th.load(folder / "parameters.pt", map_location=trained.device, weights_only=False)
    assert_same(without_text(parameters), without_text(trained.get_parameters()))
    later: Any = BisimSAC.load(folder / "later")
    assert (later.num_timesteps, later._n_updates) == (15 + 8, 7 + 8)


@pytest.mark.parametrize(
    ("argument", "value", "radius"), [("c_t", 0.5, 1.0), ("norm_constraint", False, None), ("reward_range", (0, 4), 200.0)]
)
def test_a_changed_argument_at_load_reaches_every_net(saved: Path, argument: str, value: Any, radius: float | None) -> None:
    loaded: Any = BisimSAC.load(saved, env=pendulum(), **{argument: value})
    encoders = (net.features_extractor for net in (loaded.actor, loaded.critic, loaded.critic_target))
    for holder in (loaded, *encoders, loaded.policy.representation.dynamics):
        assert holder.radius == (None if radius is None else pytest.approx(radius))
    loaded.learn(2, reset_num_timesteps=False)
    if radius == 1.0:
        far = th.as_tensor(1e4 * OBSERVATIONS, device=loaded.device)
        assert loaded.critic.features_extractor.encode(far).norm(dim=1).max().item() == pytest.approx(1.0)


def test_extras_can_be_switched_at_load(saved: Path) -> None:
    off: Any = BisimSAC.load(saved, env=pendulum(), intrinsic_reward_scale=0.0, inverse_dynamics_coef=0.0)
    before = off.policy.representation.inverse_dynamics.net[0].weight.detach().clone()
    assert bonuses(off) == [None] * 3
    assert_same(off.policy.representation.inverse_dynamics.net[0].weight, before)
    off.save(saved)
    on: Any = BisimSAC.load(saved, env=pendulum(), intrinsic_reward_scale=1.0, inverse_dynamics_coef=1.0)
    assert all(bonuses(on))
    on.learn(3, reset_num_timesteps=False)
    assert not th.equal(on.policy.representation.inverse_dynamics.net[0].weight, before)


@pytest.mark.parametrize("dynamics", ["probabilistic", "ensemble"])
def test_load_restores_each_kind_of_dynamics_model(tmp_path: Path, dynamics: Any) -> None:
    model = make_model(dynamics=dynamics).learn(12)
    model.save(tmp_path / "model")
    loaded: Any = BisimSAC.load(tmp_path / "model", env=pendulum())
    assert_same(loaded.policy.state_dict(), model.policy.state_dict())
    assert all(bonuses(loaded))


def test_a_loaded_replay_buffer_keeps_the_bonus_in_its_rewards(trained: Any, tmp_path: Path) -> None:
    trained.save_replay_buffer(tmp_path / "buffer")
    other = make_model()
    other.load_replay_buffer(tmp_path / "buffer")
    assert other.replay_buffer.size() == 15
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        np.testing.assert_array_equal(getattr(other.replay_buffer, name), getattr(trained.replay_buffer, name))
    other.learn(3, reset_num_timesteps=False)
    assert other.replay_buffer.size() == 18


def test_a_policy_can_be_saved_and_loaded_without_its_model(trained: Any, tmp_path: Path) -> None:
    trained.policy.save(tmp_path / "policy.pkl")
    policy = MlpPolicy.load(str(tmp_path / "policy.pkl"), device=trained.device)
    np.testing.assert_array_equal(actions_of(policy), actions_of(trained))
    assert_same(policy.state_dict(), trained.policy.state_dict())
    assert policy.critic.features_extractor.radius == trained.radius


def test_parameters_can_be_copied_between_models_and_must_be_complete(trained: Any) -> None:
    other = make_model(seed=1)
    assert not np.allclose(actions_of(other), actions_of(trained))
    other.set_parameters(trained.get_parameters())
    np.testing.assert_array_equal(actions_of(other), actions_of(trained))
    assert_same(without_text(other.get_parameters()), without_text(trained.get_parameters()))
    incomplete = {name: state for name, state in trained.get_parameters().items() if "inverse_dynamics" not in name}
    with pytest.raises(ValueError, match=r"inverse_dynamics\.optimizer"):
        other.set_parameters(incomplete)
    other.set_parameters(incomplete, exact_match=False)


def test_streams_work_like_files(trained: Any) -> None:
    stream = io.BytesIO()
    trained.save(stream)
    stream.seek(0)
    np.testing.assert_array_equal(actions_of(BisimSAC.load(stream)), actions_of(trained))


def test_no_net_is_pickled_beside_the_state_dicts(saved: Path) -> None:
    with zipfile.ZipFile(saved) as archive:
        data = json.loads(archive.read("data"))
        names = {name.removesuffix(".pth") for name in archive.namelist()}
    assert names == {"data", "pytorch_variables", "_stable_baselines3_version", "system_info.txt"} | STATE_DICTS
    assert not {"policy", "actor", "critic", "critic_target", "replay_buffer", "env"} & data.keys()
    assert data["policy_kwargs"].keys() >= {"net_arch"}
    assert "objective" not in data["policy_kwargs"]
    assert len(json.dumps(data)) < 60_000  # spaces and pickled small classes, no weights


@pytest.mark.parametrize(("method", "suffix"), [("save", "zip"), ("save_replay_buffer", "pkl")])
def test_a_failing_save_leaves_the_old_file_and_nothing_else(tmp_path: Path, method: str, suffix: str) -> None:
    path = tmp_path / "sub" / f"model.{suffix}"
    model = make_model()
    getattr(model, method)(path.with_suffix(""))
    before = path.read_bytes()
    # a lock cannot be pickled, and SB3 notices only after it has opened the file
    model.lock = model.replay_buffer.lock = threading.Lock()
    for target in (path, str(path.with_suffix(""))):
        with pytest.raises(TypeError, match="lock"):
            getattr(model, method)(target)
        assert path.read_bytes() == before
        assert list(path.parent.iterdir()) == [path]
