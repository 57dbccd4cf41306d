"""Any combination of settings is refused when the model is built, or it trains, stays finite, and survives saving.

The suite tries few combinations, always the same ones. WHOLE_RUNS=300 tries so many, drawn anew.
"""

import os
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import HealthCheck, Phase, event, given, settings
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecNormalize

from sb3_robust_bisim import BisimSAC, FrameStackReplayBuffer, IntrinsicRewardVecEnv

UPDATES = 20
MANY = os.environ.get("WHOLE_RUNS")
WRAPPERS = ("VecNormalize", "IntrinsicRewardVecEnv", "FrameStackReplayBuffer")
VECTOR = spaces.Box(-2, 2, (3,), np.float32)
SPACES: dict[str, tuple[str, spaces.Space]] = {
    "vector": ("MlpPolicy", VECTOR),
    "channels first": ("CnnPolicy", spaces.Box(0, 255, (1, 12, 12), np.uint8)),
    "channels last": ("CnnPolicy", spaces.Box(0, 255, (12, 12, 1), np.uint8)),
    # SB3's CombinedExtractor needs 36 pixels
    "dict": ("MultiInputPolicy", spaces.Dict(vector=VECTOR, image=spaces.Box(0, 255, (1, 36, 36), np.uint8))),
}


class RandomEnv(gym.Env[Any, np.ndarray]):
    """Random observations and rewards in [-1, 1]; episodes end by termination or after 7 steps."""

    def __init__(self, space: spaces.Space, n_actions: int) -> None:
        self.observation_space, self.action_space = space, spaces.Box(-2, 3, (n_actions,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        self.count = 0
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.count += 1
        ended = bool(self.np_random.random() < 0.1)
        return self.observation_space.sample(), self.np_random.uniform(-1, 1), ended, self.count == 7, {}


def some(**choices: Any) -> st.SearchStrategy[dict[str, Any]]:
    """Arguments of which each is left out or has one of the values."""
    return st.fixed_dictionaries({}, optional={name: st.sampled_from(values) for name, values in choices.items()})


POLICY = some(share_features_extractor=(True, False), n_critics=(1, 2), ortho_init=(True, False))
# What goes with every metric and every observation
GENERAL = some(
    dynamics=("deterministic", "probabilistic", "ensemble"),
    nll_beta=(0.0, 0.5, 1.0),
    bisim_coef=(0.0, 0.5),
    c_t=(0.0, 0.5),
    inverse_dynamics_coef=(0.0, 1.0),
    policy_delay=(1, 3),
    initial_gradient_steps=(0, 5),
    ent_coef=("auto", "auto_0.1", 0.1),
    use_sde=(True, False),
    train_freq=(1, 4, (3, "step")),
    gradient_steps=(-1, 1, 2),
    target_update_interval=(1, 2),
)
# What contradicts other settings
RISKY = some(
    model_coef=(0.0, 1.0),
    reward_coef=(0.0, 1.0),
    intrinsic_reward_scale=(0.0, 1.0),
    random_shift=(0, 2, 40),
    train_freq=(1, (1, "episode")),
    gamma=(0.9, 1.0),
)
METRIC = dict(
    successors=("model", "sample"),
    target_encoder=("none", "successors", "both"),
    loss=("squared", "huber", "variance_corrected"),
    pairs=("permutation", "all"),
    absorbing=(True, False),
)
FROM_SAMPLES = some(**{**METRIC, "loss": ("squared", "huber")}).map(lambda chosen: {**chosen, "successors": "sample"})
FAMILIES: list[st.SearchStrategy[tuple[dict[str, Any], dict[str, Any]]]] = [
    st.tuples(some(distance=("huber", "l1", "l2"), norm_constraint=(True, False, "sphere")), some(absorbing=(True, False))),
    st.tuples(st.sampled_from(("l1", "l2", "mico", "rap")).map(lambda name: {"distance": name}), FROM_SAMPLES),
    st.tuples(st.just(dict(distance="cosine", norm_constraint="sphere")), FROM_SAMPLES),
    st.tuples(st.just(dict(distance="rap")), some(absorbing=(True, False)).map(lambda c: {**c, "loss": "variance_corrected"})),
    st.tuples(some(distance=("huber", "l2", "cosine"), norm_constraint=(True, "sphere")), some(**METRIC)),
]
NOTHING: st.SearchStrategy[dict[str, Any]] = st.just({})
CHAINS = st.sampled_from(
    [
        *((), ("intrinsic",), ("stack",), ("normalize",), ("stack", "normalize"), ("intrinsic", "normalize")),
        *(("stack", "intrinsic", "normalize"), ("normalize", "stack"), ("intrinsic", "stack"), ("normalize", "intrinsic")),
    ]
)


def build(kind: str, n_envs: int, n_actions: int, chain: tuple[str, ...], frames: bool, kwargs: dict[str, Any]) -> Any:
    """:param chain: wrappers from the inside out"""
    policy, space = SPACES[kind]
    env: VecEnv = DummyVecEnv([partial(RandomEnv, space, n_actions)] * n_envs)
    for wrapper in chain:
        if wrapper == "intrinsic":
            env = IntrinsicRewardVecEnv(env)
        elif wrapper == "stack":
            env = VecFrameStack(env, 2)
        else:
            keys = ["vector"] if kind == "dict" else None
            env = VecNormalize(env, norm_obs=kind in ("vector", "dict"), norm_reward=False, norm_obs_keys=keys)
    if frames:  # only bytes
        buffer = dict(n_stack=2 if "stack" in chain else 1)
        kwargs = {**kwargs, "replay_buffer_class": FrameStackReplayBuffer, "replay_buffer_kwargs": buffer}
    return BisimSAC(policy, env, learning_starts=10, batch_size=8, buffer_size=300, seed=0, **kwargs)


def learn(model: Any) -> None:
    """At least ``UPDATES`` updates."""
    while model._n_updates < UPDATES:
        model.learn(20, reset_num_timesteps=False)


def tensors(model: Any) -> dict[str, th.Tensor]:
    return {name: value for name, value in model.policy.state_dict().items() if value.is_floating_point()}


@settings(
    max_examples=int(MANY or 24),
    derandomize=MANY is None,
    deadline=None,
    suppress_health_check=list(HealthCheck),
    phases=(Phase.explicit, Phase.generate),  # to shrink an example takes minutes
)
@given(
    kind=st.sampled_from(list(SPACES)),
    n_envs=st.integers(1, 3),
    n_actions=st.integers(1, 2),
    chain=CHAINS,
    frames=st.booleans(),
    kwargs=GENERAL,
    risky=st.one_of(NOTHING, NOTHING, RISKY),
    family=st.one_of(FAMILIES),
    policy=POLICY,
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_run_is_refused_at_once_or_works_to_the_end(
    kind: str,
    n_envs: int,
    n_actions: int,
    chain: tuple[str, ...],
    frames: bool,
    kwargs: dict[str, Any],
    risky: dict[str, Any],
    family: tuple[dict[str, Any], dict[str, Any]],
    policy: dict[str, Any],
) -> None:
    metric, metric_kwargs = family
    own = {"metric_kwargs": metric_kwargs, "policy_kwargs": dict(net_arch=[16], **policy)}
    built = {**kwargs, **risky, **metric, **own}
    refusal = None
    try:
        model = build(kind, n_envs, n_actions, chain, frames and "channels" in kind, built)
    except ValueError as error:
        refusal = str(error)
    if refusal is not None:
        event(f"refused: {refusal[:60]}")
        names = [f"{name}=" for name in (*built, *metric_kwargs, *policy)]
        assert any(name in refusal for name in (*names, *WRAPPERS)), refusal  # it names what is wrong
        return
    event("trained")
    learn(model)
    before = tensors(model)
    assert all(value.isfinite().all() for value in before.values())
    obs = model.get_env().reset()
    with tempfile.TemporaryDirectory() as folder:
        model.save(Path(folder) / "model")
        for env in (None, model.get_env()):
            loaded = BisimSAC.load(Path(folder) / "model", env=env)
            after = tensors(loaded)
            assert all(th.equal(value, after[name]) for name, value in before.items())
            np.testing.assert_array_equal(
                loaded.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0]
            )
