"""Each behavioural metric against its equation, written as loops in NumPy."""

from typing import Any

import numpy as np
import pytest
import torch as th
from small_models import make_model, pendulum

from sb3_robust_bisim import BisimSAC
from sb3_robust_bisim.losses import DISTANCES, pairwise_distance
from sb3_robust_bisim.metrics import METRIC_LOSSES, Metric
from sb3_robust_bisim.representation import Batch

ENV = "robust_bisim/SparseCartPole-v0"
B, N = 6, 4


def normal(*shape: int, seed: int = 0) -> th.Tensor:
    return th.as_tensor(np.random.default_rng(seed).normal(size=shape))


def unit(x: th.Tensor) -> th.Tensor:
    return x / x.norm(dim=-1, keepdim=True)


def huber(x: float) -> float:
    return 0.5 * x**2 if abs(x) < 1 else abs(x) - 0.5


def distance_of(name: str, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """One pair, from the definitions; all coordinates for huber."""
    if name == "huber":
        return np.array([huber(v) for v in x - y])
    if name in ("l1", "l2"):
        return np.array([np.linalg.norm(x - y, 1 if name == "l1" else 2)])
    cosine = x @ y / (np.linalg.norm(x) * np.linalg.norm(y))
    norms, angle = x @ x + y @ y, np.arctan2(np.sqrt(max(1 - cosine**2, 0.0)), cosine)
    return np.array([{"mico": norms / 2 + 0.1 * angle, "rap": norms + 1e-6 * angle, "cosine": 1 - x @ y}[name]])


@pytest.mark.parametrize("name", DISTANCES)
def test_each_distance_is_its_definition_for_matching_rows_and_for_all_pairs(name: str) -> None:
    x, y = normal(2, B, N)
    rows = pairwise_distance(x, y, name)
    matrix = pairwise_distance(x[:, None], y[None], name)
    for i in range(B):
        np.testing.assert_allclose(rows[i], distance_of(name, x[i].numpy(), y[i].numpy()), rtol=1e-6)
        for j in range(B):
            np.testing.assert_allclose(matrix[i, j], distance_of(name, x[i].numpy(), y[j].numpy()), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("name", ["mico", "rap", "cosine"])
def test_the_gradient_of_an_angle_is_finite_everywhere(name: str) -> None:
    for x in (th.zeros(1, N), th.ones(1, N), -th.ones(1, N)):
        x.requires_grad_()
        pairwise_distance(x, th.ones(1, N), name).sum().backward()
        assert x.grad is not None
        assert x.grad.isfinite().all()


def expected_loss(settings: dict[str, Any], arrays: list[Any], pairs: list[tuple[int, int]]) -> list[float]:
    """The loss of each pair from the equations of the papers."""
    z, other, rewards, mean, std, variance = arrays
    distance, c_r, c_t = settings["distance"], settings["c_r"], settings["c_t"]
    terms = []
    for i, j in pairs:
        gap = rewards[i, 0] - rewards[j, 0]
        reward_gap = huber(gap) if distance == "huber" else abs(gap)
        if std is not None and distance in ("huber", "l1", "l2", "rap"):
            each = np.sqrt((mean[i] - mean[j]) ** 2 + (std[i] - std[j]) ** 2)
            successor = {"huber": each, "l1": each.sum(keepdims=True)}.get(distance, np.array([np.sqrt((each**2).sum())]))
        else:
            successor = distance_of("l2" if distance == "rap" else distance, mean[i], mean[j])
        u = distance_of(distance, z[i], other[j])
        if settings["loss"] == "variance_corrected":
            error = (u - c_t * successor) ** 2 - c_r**2 * (gap**2 - variance[i] - variance[j])
            terms += [huber(e) for e in error]
        else:
            error = u - c_r * reward_gap - c_t * successor
            terms += [huber(e) if settings["loss"] == "huber" else e**2 for e in error]
    return terms


FAMILIES: dict[str, dict[str, Any]] = {
    "paper, huber": dict(distance="huber"),
    "paper, l1": dict(distance="l1"),
    "paper, l2": dict(distance="l2", c_r=0.7),
    "MICo": dict(distance="mico", successors="sample", target_encoder="both", loss="huber", pairs="all"),
    "SimSR": dict(distance="cosine", successors="sample", target_encoder="successors", loss="huber", pairs="all"),
    "RAP": dict(distance="rap", loss="variance_corrected"),
    "l2, all pairs": dict(distance="l2", pairs="all"),
}


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("gaussian", [False, True])
def test_the_loss_of_a_family_is_its_equation(family: str, gaussian: bool) -> None:
    settings = {"c_r": 1.0, "c_t": 0.9, "loss": "squared", **FAMILIES[family]}
    metric = Metric(**settings)
    z, other, mean, raw = normal(4, B, N)
    if settings["distance"] == "cosine":
        z, other, mean = unit(z), unit(other), unit(mean)
    rewards, variance, std = normal(B, 1, seed=1), normal(B, 1, seed=2).square(), raw.exp() if gaussian else None
    th.manual_seed(3)
    gaps, (i, j) = metric.gaps(z, other, rewards, (mean, std), variance)
    loss = METRIC_LOSSES[metric.loss](gaps, metric.c_r, metric.c_t).mean()
    i, j = th.broadcast_tensors(i, j)
    pairs = list(zip(i.flatten().tolist(), j.flatten().tolist(), strict=True))
    assert len(pairs) == (B * B if settings.get("pairs") == "all" else B)
    arrays = [x if x is None else x.numpy() for x in (z, other, rewards, mean, std, variance[:, 0])]
    assert loss.item() == pytest.approx(np.mean(expected_loss(settings, arrays, pairs)), rel=1e-6)


@pytest.mark.parametrize("family", FAMILIES)
def test_gradient_flows_through_the_embeddings_alone(family: str) -> None:
    metric = Metric(**FAMILIES[family])
    z, other, mean, std, rewards = (normal(8, n, seed=n).requires_grad_() for n in (4, 4, 4, 4, 1))
    gaps, _ = metric.gaps(z, other, rewards, (mean, std.exp()), rewards.square())
    METRIC_LOSSES[metric.loss](gaps, 1.0, 0.9).mean().backward()
    assert z.grad is not None
    assert z.grad.abs().sum() > 0
    assert [x.grad for x in (mean, std, rewards)] == [None] * 3


VARIANTS: dict[str, dict[str, Any]] = {
    "MICo": dict(distance="mico", norm_constraint=False, metric_kwargs=FAMILIES["MICo"]),
    "SimSR": dict(
        distance="cosine", norm_constraint="sphere", model_coef=1.0, reward_coef=0.0, metric_kwargs=FAMILIES["SimSR"]
    ),
    "RAP": dict(distance="rap", norm_constraint=False, dynamics="probabilistic", metric_kwargs=FAMILIES["RAP"]),
    "absorbing": dict(distance="l2", metric_kwargs=dict(absorbing=True)),
    "absorbing MICo": dict(distance="mico", norm_constraint=False, metric_kwargs={**FAMILIES["MICo"], "absorbing": True}),
}


def model_of(name: str, **kwargs: Any) -> Any:
    settings = dict(VARIANTS[name])
    settings["metric_kwargs"] = {k: v for k, v in settings["metric_kwargs"].items() if k != "distance"}
    return make_model(**{"env": ENV, "intrinsic_reward_scale": 0.0, "inverse_dynamics_coef": 0.0, **settings, **kwargs})


@pytest.mark.parametrize("name", VARIANTS)
def test_each_family_trains_saves_and_loads(name: str, tmp_path: Any) -> None:
    model = model_of(name).learn(40)
    assert np.isfinite(model.logger.name_to_value["train/bisim_loss"])
    model.save(tmp_path / "model")
    loaded = BisimSAC.load(tmp_path / "model", env=model.get_env())
    assert loaded.policy.objective.metric == model.policy.objective.metric
    if name == "SimSR":
        obs = th.as_tensor(model.replay_buffer.observations[:8, 0])
        np.testing.assert_allclose(loaded.critic.features_extractor.encode(obs).norm(dim=1).detach(), 1, rtol=1e-5)
        assert "train/reward_loss" not in model.logger.name_to_value
    if name == "MICo":
        assert "train/dynamics_loss" not in model.logger.name_to_value  # it has no models


def test_mico_takes_state_j_and_the_successors_from_the_target_encoder() -> None:
    model = model_of("MICo")
    z, target_z, target_next_z, next_z = normal(4, B, 50).float()
    rewards = th.zeros(B, 1)
    z.requires_grad_()
    batch = Batch(z, th.zeros(B, 1), rewards, rewards, next_z, target_next_z, target_z)
    loss, logged = model.policy.representation.losses(batch)
    settings = {"c_r": 1.0, "c_t": model.gamma, **FAMILIES["MICo"]}
    arrays = [x.detach().double().numpy() for x in (z, target_z, rewards, target_next_z)]
    pairs = [(i, j) for i in range(B) for j in range(B)]
    expected = np.mean(expected_loss(settings, [*arrays, None, None], pairs))
    assert logged["train/bisim_loss"].item() == pytest.approx(expected, rel=1e-4)
    assert loss.item() == pytest.approx(model.bisim_coef * expected, rel=1e-4)


def test_an_end_of_an_episode_is_an_absorbing_state_without_reward() -> None:
    model = model_of("absorbing", c_t=0.5)
    z, next_z = normal(2, B, 50).float()
    rewards, dones = normal(B, 1, seed=1).float(), th.tensor([[0.0], [1.0]] * (B // 2))
    actions = th.zeros(B, 1)
    batch = Batch(z, actions, rewards, dones, next_z, next_z)
    mean = model.policy.representation.dynamics(z, actions).mean[0].detach()
    ended = dones[:, 0] == 1
    th.manual_seed(0)
    _, logged = model.policy.representation.losses(batch)
    th.manual_seed(0)
    # transitions and ends alike are paired with transitions; a successor that is no end must not count
    pairs = [(i, int(j)) for i, j in enumerate(th.cat([th.randperm(B), th.randperm(B)]))]
    counts = [True] * B + ended.tolist()
    rows, following = th.cat([z, next_z]), th.cat([mean, next_z])
    paid = th.cat([rewards, th.zeros_like(rewards)])[:, 0]
    terms = [
        ((rows[i] - rows[j]).norm() - (paid[i] - paid[j]).abs() - 0.5 * (following[i] - following[j]).norm()).item() ** 2
        for i, j in pairs
        if counts[i] and counts[j]
    ]
    assert logged["train/bisim_loss"].item() == pytest.approx(np.mean(terms), rel=1e-4)


def test_a_time_out_is_no_end() -> None:
    model = model_of("absorbing", env=pendulum()).learn(40)  # four episodes, each of which ran out of time
    assert model.replay_buffer.dones[:40].sum() == 4
    _, batch = model.policy.encode(model.replay_buffer.sample(500))
    assert batch.dones.sum() == 0


def test_few_ends_leave_every_transition_a_partner() -> None:
    model = model_of("absorbing")
    z, next_z = normal(2, 2, 50).float()
    batch = Batch(z, th.zeros(2, 1), th.zeros(2, 1), th.zeros(2, 1), next_z, next_z)
    for _ in range(10):
        assert model.policy.representation.losses(batch)[0].isfinite()


def test_the_ball_has_room_for_an_end_without_reward() -> None:
    radius = {
        absorbing: model_of("absorbing", metric_kwargs=dict(absorbing=absorbing), reward_range=(9, 10), c_t=0.9).radius
        for absorbing in (False, True)
    }
    assert radius == {False: pytest.approx(5.0), True: pytest.approx(50.0)}


def test_a_reward_loss_alone_is_trained_too() -> None:
    model = make_model(env=ENV, bisim_coef=0.0, intrinsic_reward_scale=0.0, reward_coef=1.0).learn(40)
    assert model.logger.name_to_value["train/reward_loss"] > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(metric_kwargs=dict(successors="next")), "metric_kwargs with successors='next': it must be one of model, sample"),
        (dict(metric_kwargs=dict(pairs="some")), "metric_kwargs with pairs='some': it must be one of permutation, all"),
        (dict(metric_kwargs=dict(loss="l1")), "metric_kwargs with loss='l1': it must be one of squared, huber, variance_corr"),
        (dict(metric_kwargs=dict(absorbing=1)), "metric_kwargs with absorbing=1: it must be True or False"),
        (dict(metric_kwargs=dict(sucessors="model")), "metric_kwargs with sucessors='model': it may hold successors, "),
        (dict(metric_kwargs=dict(c_t=0.5)), r"metric_kwargs with c_t=0\.5: it may hold successors, "),
        (dict(metric_kwargs=dict(pairs="all")), "distance='huber' with pairs='all': .*another distance"),
        (dict(metric_kwargs=dict(target_encoder="both")), "target_encoder='both' with successors='model': .*sample"),
        (dict(metric_kwargs=dict(loss="variance_corrected")), "loss='variance_corrected' with distance='huber': .*rap"),
        (dict(distance="cosine", norm_constraint="sphere"), "distance='cosine' with successors='model': .*sample"),
        (dict(metric_kwargs="all"), "metric_kwargs='all': it must be None or a dict"),
        (dict(distance=["l1"]), r"distance=\['l1'\]: it must be one of huber"),
        (
            dict(distance="rap", reward_coef=0.0, metric_kwargs=dict(loss="variance_corrected")),
            r"reward_coef=0\.0: it must be above 0 with loss='variance_corrected'",
        ),
        (dict(optimize_memory_usage=True), "optimize_memory_usage=True: .*FrameStackReplayBuffer"),
        (
            dict(metric_kwargs=dict(absorbing=True), replay_buffer_kwargs=dict(handle_timeout_termination=False)),
            "absorbing=True with handle_timeout_termination=False: ",
        ),
        (dict(policy_delay=True), "policy_delay=True: it must be an integer >= 1"),
        (dict(distance="cosine"), "distance='cosine': it must be another one, or norm_constraint=\"sphere\""),
        (dict(norm_constraint="cube"), "norm_constraint='cube': it must be True, False or \"sphere\""),
        (dict(nll_beta=2.0), r"nll_beta=2\.0: it must be a number in \[0, 1\]"),
        (dict(reward_coef=-1.0), r"reward_coef=-1\.0: it must be None or a finite number >= 0"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BisimSAC("MlpPolicy", ENV, **arguments)
