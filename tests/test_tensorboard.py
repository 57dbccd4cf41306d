"""BisimSAC writes every key for TensorBoard. The values are finite and match their names."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_models import EPISODE, SMALL, events, pendulum
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_robust_bisim import BisimSAC

BATCH_SIZE = SMALL["batch_size"]
SB3_KEYS = {"train/learning_rate", "rollout/ep_rew_mean", "rollout/ep_len_mean", "time/fps"}
SAC_KEYS = {"train/critic_loss", "train/actor_loss", "train/ent_coef", "train/ent_coef_loss", "train/parameter_norm"}
EMBEDDING_KEYS = {"bisim/embedding_norm_mean", "bisim/embedding_norm_max", "bisim/embedding_std"}
MODEL_KEYS = {"train/dynamics_loss", "train/reward_loss"}
METRIC_KEYS = {"train/bisim_loss", "bisim/mu_bd", "bisim/mu_rd", "bisim/mu_ratio", "bisim/mu_ratio_target"}
RATIO_FREE = METRIC_KEYS - {"bisim/mu_ratio"}  # no ratio exists for equal rewards
CLAMP_KEY, INVERSE_KEY, BONUS_KEY = "bisim/clamp_fraction", "train/inverse_dynamics_loss", "rollout/intrinsic_reward"


class Bonuses(BaseCallback):
    """Keeps the bonuses in the infos of each step, one number per environment."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[list[float]] = []

    def _on_step(self) -> bool:
        self.seen.append([info["intrinsic_reward"] for info in self.locals["infos"]])
        return True


def run(folder: Path, callback: BaseCallback | None = None, **kwargs: Any) -> dict[str, np.ndarray]:
    """The values written by three episodes in each of two environments, by key. There is one per pair of episodes."""
    env = make_vec_env(partial(pendulum, reward=0.5), n_envs=2)
    model = BisimSAC("MlpPolicy", env, tensorboard_log=str(folder), train_freq=2, gradient_steps=3, **SMALL, **kwargs)
    model.learn(2 * 3 * EPISODE, callback, log_interval=2)
    model.logger.close()
    found = events(folder)
    return {key: np.array([event.value for event in found.Scalars(key)]) for key in found.Tags()["scalars"]}


@pytest.fixture(scope="module")
def full_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """A run of the full method and its (30, 2) bonuses. The ball is so small that some embeddings reach its surface."""
    callback = Bonuses()
    method = dict(intrinsic_reward_scale=0.3, inverse_dynamics_coef=1.0, c_r=0.5, c_t=0.8)
    return run(tmp_path_factory.mktemp("full"), callback, **method), np.array(callback.seen)


def test_every_key_has_finite_values_when_everything_is_on(full_run: Any) -> None:
    found, _ = full_run
    wanted = SB3_KEYS | SAC_KEYS | EMBEDDING_KEYS | MODEL_KEYS | METRIC_KEYS | {CLAMP_KEY, INVERSE_KEY, BONUS_KEY}
    assert found.keys() >= wanted
    for key in wanted:
        assert len(found[key]) == 3, key
        assert np.isfinite(found[key]).all(), key


def test_losses_are_positive(full_run: Any) -> None:
    found, _ = full_run
    for key in ("critic_loss", "bisim_loss", "dynamics_loss", "reward_loss", "inverse_dynamics_loss", "ent_coef"):
        assert (found[f"train/{key}"] > 0).all(), key
    assert found[INVERSE_KEY].max() < 2  # mean distance to actions in [-1, 1]


def test_the_ratio_of_distances_is_written_with_its_target(full_run: Any) -> None:
    found, _ = full_run
    assert (found["bisim/mu_bd"] > 0).all()
    np.testing.assert_allclose(found["bisim/mu_ratio"], found["bisim/mu_bd"] / found["bisim/mu_rd"], rtol=1e-5)
    np.testing.assert_allclose(found["bisim/mu_ratio_target"], 0.5 / (1 - 0.8), rtol=1e-6)


def test_embedding_norms_respect_the_radius_and_the_clamp_counts_what_touches_it(full_run: Any) -> None:
    found, _ = full_run
    mean, largest, fraction = found["bisim/embedding_norm_mean"], found["bisim/embedding_norm_max"], found[CLAMP_KEY]
    radius = 0.5 / (2 * (1 - 0.8))
    assert (mean > 0).all()
    assert (mean < largest).all()
    assert (largest <= radius * (1 + 1e-6)).all()
    assert (found["bisim/embedding_std"] > 0).all()
    assert 0 < fraction.max() <= 1
    np.testing.assert_array_equal(fraction * BATCH_SIZE, np.round(fraction * BATCH_SIZE))
    np.testing.assert_array_equal(fraction > 0, largest > radius * (1 - 2e-6))


def test_a_wide_ball_clamps_nothing_and_equal_rewards_have_no_ratio(tmp_path: Path) -> None:
    found = run(tmp_path, reward_range=(-1000.0, 1000.0))
    assert (found[CLAMP_KEY] == 0).all()
    assert (found["bisim/mu_rd"] == 0).all()
    assert "bisim/mu_ratio" not in found  # the ratio does not exist


def test_the_bonus_is_the_mean_of_the_infos_since_the_last_row(full_run: Any) -> None:
    found, bonuses = full_run
    assert bonuses.std() > 0
    np.testing.assert_allclose(found[BONUS_KEY], bonuses.reshape(3, -1).mean(axis=1), rtol=1e-5)


def test_the_return_is_the_extrinsic_one(full_run: Any) -> None:
    found, bonuses = full_run
    assert (bonuses > 0).all()
    np.testing.assert_array_equal(found["rollout/ep_rew_mean"], 0.5 * EPISODE)


@pytest.mark.parametrize(
    ("settings", "written", "left_out"),
    [
        (dict(bisim_coef=0.0, norm_constraint=False), set(), MODEL_KEYS | METRIC_KEYS | {CLAMP_KEY, INVERSE_KEY, BONUS_KEY}),
        (dict(norm_constraint=False), MODEL_KEYS | RATIO_FREE, {CLAMP_KEY, INVERSE_KEY, BONUS_KEY}),
        (dict(), MODEL_KEYS | RATIO_FREE | {CLAMP_KEY}, {INVERSE_KEY, BONUS_KEY}),
        (dict(bisim_coef=0.0, intrinsic_reward_scale=1.0), MODEL_KEYS | {CLAMP_KEY, BONUS_KEY}, METRIC_KEYS | {INVERSE_KEY}),
        (dict(inverse_dynamics_coef=1.0), {INVERSE_KEY}, {BONUS_KEY}),
    ],
)
def test_parts_that_are_switched_off_write_nothing(
    settings: dict[str, Any], written: set[str], left_out: set[str], tmp_path: Path
) -> None:
    found = run(tmp_path, **settings)
    assert found.keys() >= SAC_KEYS | EMBEDDING_KEYS | written
    assert not found.keys() & left_out
