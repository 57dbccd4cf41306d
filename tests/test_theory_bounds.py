"""Bounds on diameters, values and model errors hold on random finite MDPs. Counterexamples show which conditions matter."""

import re
from typing import Any

import numpy as np
import pytest
import torch as th
from finite_mdps import (
    DISCOUNTS,
    FEW,
    FORK,
    MANY,
    THREE_APART,
    Setting,
    chain,
    distributions,
    mdps_with_policy,
    settings_of,
)
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sb3_robust_bisim.losses import ball_radius, project_to_ball
from sb3_robust_bisim.metrics import METRIC_LOSSES, Metric
from sb3_robust_bisim.theory import (
    Array,
    FiniteMDP,
    aggregate,
    bisimulation_metric,
    policy_bisimulation_metric,
    policy_evaluation,
)
from sb3_robust_bisim.theory.bounds import (
    aggregation_value_bound,
    diameter_bound,
    mean_distance,
    metric_error_bound,
    model_error_value_bound,
    policy_diameter_bound,
    policy_variance_bound,
    reward_error,
    transition_error,
    value_difference_bound,
)

Cells = NDArray[np.intp]

SLACK = 1e-6  # the metrics carry an error of 1e-8, and rounding for p > 1


@st.composite
def aggregations(draw: st.DrawFn) -> tuple[Setting, Cells, Array]:
    """A setting, a partition of its states, and the values of the cells averaged with some weights."""
    setting = draw(settings_of())
    n = setting.mdp.n_states
    cells = np.unique(draw(st.lists(st.integers(0, n - 1), min_size=n, max_size=n)), return_inverse=True)[1]
    weights = np.array(draw(st.lists(st.sampled_from([0.01, 1.0, 5.0]), min_size=n, max_size=n)))
    cell_values = values_of_chain(aggregate(setting.mdp, setting.policy, cells, weights), setting.gamma)
    return setting, cells, cell_values


@st.composite
def models(draw: st.DrawFn) -> tuple[Setting, FiniteMDP]:
    """A setting and an approximate model of it."""
    setting = draw(settings_of())
    states, actions = setting.mdp.reward.shape
    mixing = draw(st.sampled_from([0.0, 0.05, 1.0]))
    noise = draw(distributions(states * actions, states)).reshape(states, actions, states)
    shift = np.reshape(
        draw(st.lists(st.sampled_from([-0.2, 0.0, 0.2]), min_size=states * actions, max_size=states * actions)),
        (states, actions),
    )
    return setting, FiniteMDP((1 - mixing) * setting.mdp.transition + mixing * noise, setting.mdp.reward + shift)


def values_of_chain(mdp: FiniteMDP, gamma: float) -> Array:
    return policy_evaluation(mdp, np.ones((mdp.n_states, 1)), gamma)


def half_diameter_of_cells(distance: Array, cells: Cells) -> float:
    return float(distance[cells[:, None] == cells].max()) / 2


class TestDiameter:
    @MANY
    @given(settings_of())
    def test_lemma_diam_and_lemma_dist_range_hold_for_every_order(self, setting: Setting) -> None:
        bound = diameter_bound(setting.mdp, setting.c_r, setting.c_t)
        on_policy = policy_diameter_bound(setting.mdp, setting.policy, setting.c_r, setting.c_t)
        assert bisimulation_metric(setting.mdp, setting.c_r, setting.c_t, setting.p).max() <= bound + SLACK
        assert setting.metric.max() <= on_policy + SLACK <= bound + 2 * SLACK

    @FEW
    @given(models())
    def test_thm_boundedness_holds_for_a_model_on_the_same_states(self, drawn: tuple[Setting, FiniteMDP]) -> None:
        setting, model = drawn
        approximate = FiniteMDP(model.transition, setting.mdp.reward)
        metric = policy_bisimulation_metric(approximate, setting.policy, setting.c_r, setting.c_t)
        assert metric.max() <= diameter_bound(setting.mdp, setting.c_r, setting.c_t) + SLACK

    def test_is_reached_by_states_that_never_change(self) -> None:
        assert bisimulation_metric(THREE_APART, 1.0, 0.9).max() == pytest.approx(diameter_bound(THREE_APART, 1.0, 0.9))


@pytest.mark.parametrize("shrunk", [0.0, 0.8])
def test_ball_leaves_the_metric_loss_two_fixed_points_when_predictions_grow(shrunk: float) -> None:
    c_t, k = 0.8, 1.5
    radius = ball_radius(1.0, c_t, (0.0, 1.0))
    z = shrunk * radius * th.tensor([[1.0, 0.0], [-1.0, 0.0]])
    metric = Metric("l2", 1.0, c_t, pairs="all")
    gaps, _ = metric.gaps(z, z, th.zeros(2, 1), (project_to_ball(k * z, radius), None))
    assert METRIC_LOSSES[metric.loss](gaps, metric.c_r, metric.c_t).mean().item() == pytest.approx(0.0, abs=1e-9)
    assert gaps.z[0, 1].item() == pytest.approx(2 * shrunk * radius)


class TestValueDifference:
    @MANY
    @given(settings_of())
    def test_thm_generalized_ct_holds_with_the_span_of_the_rewards(self, setting: Setting) -> None:
        values = setting.values()
        bound = value_difference_bound(setting.metric, setting.c_r, setting.c_t, setting.gamma, setting.span)
        assert (np.abs(values[:, None] - values) <= bound + SLACK / setting.c_r).all()

    @MANY
    @given(settings_of())
    def test_half_the_price_of_myopia_is_enough(self, setting: Setting) -> None:
        values = setting.values()
        metric = setting.metric
        full = value_difference_bound(metric, setting.c_r, setting.c_t, setting.gamma, setting.span)
        assert (np.abs(values[:, None] - values) <= (full + metric / setting.c_r) / 2 + SLACK / setting.c_r).all()

    @MANY
    @given(settings_of())
    def test_lemma_p_wasserstein_needs_no_reward_range(self, setting: Setting) -> None:
        values = setting.values(setting.c_t)
        assert (setting.c_r * np.abs(values[:, None] - values) <= setting.metric + SLACK).all()

    def test_rewards_of_span_three_break_the_bound_for_rewards_in_0_1(self) -> None:
        mdp, policy = chain([[1, 0], [0, 1]], [0, 3])
        distance = policy_bisimulation_metric(mdp, policy, 1.0, 0.0)
        gap = np.ptp(policy_evaluation(mdp, policy, 0.9))
        assert gap == pytest.approx(30.0)
        assert value_difference_bound(distance, 1.0, 0.0, 0.9).max() == pytest.approx(21.0)
        assert value_difference_bound(distance, 1.0, 0.0, 0.9, reward_span=3.0).max() == pytest.approx(57.0)

    @MANY
    @given(mdps_with_policy(), DISCOUNTS, DISCOUNTS)
    def test_lemma_diff_gamma_holds_for_rewards_in_0_1(self, drawn: tuple[FiniteMDP, Array], one: float, other: float) -> None:
        low, high = sorted((one, other))
        gap = policy_evaluation(*drawn, high) - policy_evaluation(*drawn, low)
        assert (gap >= -1e-9).all()
        assert (gap <= (high - low) / ((1 - low) * (1 - high)) + 1e-9).all()

    def test_lemma_diff_gamma_fails_for_a_constant_reward_of_two(self) -> None:
        always_two = chain([[1]], [2])
        gap = policy_evaluation(*always_two, 0.9) - policy_evaluation(*always_two, 0.5)
        assert gap == pytest.approx(16.0)  # the lemma allows (0.9 - 0.5) / (0.1 * 0.5) = 8


class TestAggregation:
    @MANY
    @given(aggregations())
    def test_thm_generalized_ct_vfa_holds_for_every_partition_and_weighting(self, drawn: tuple[Setting, Cells, Array]) -> None:
        setting, cells, cell_values = drawn
        epsilon = half_diameter_of_cells(setting.metric, cells)
        error = np.abs(setting.values() - cell_values[cells]).max()
        assert error <= aggregation_value_bound(epsilon, setting.c_r, setting.c_t, setting.gamma, setting.span) + 100 * SLACK
        without_myopia = 2 * epsilon / (setting.c_r * (1 - min(setting.c_t, setting.gamma)))
        half = (aggregation_value_bound(epsilon, setting.c_r, setting.c_t, setting.gamma, setting.span) + without_myopia) / 2
        assert error <= half + 100 * SLACK  # half the price of myopia is enough here too

    def test_rewards_of_span_five_break_the_bound_for_rewards_in_0_1(self) -> None:
        transition, policy = FORK[0].transition, FORK[1]
        mdp = FiniteMDP(transition, 5 * FORK[0].reward)
        assert policy_bisimulation_metric(mdp, policy, 1.0, 0.0)[0, 1] == 0.0
        cells = [0, 0, 1, 2]
        error = np.abs(policy_evaluation(mdp, policy, 0.9) - values_of_chain(aggregate(mdp, policy, cells), 0.9)[cells]).max()
        assert error == pytest.approx(22.5)
        assert aggregation_value_bound(0.0, 1.0, 0.0, 0.9) == pytest.approx(18.0)

    def test_averaging_action_by_action_breaks_the_bound(self) -> None:
        # Both states earn 0, each by an action that would earn 1 in the other: d_pi = 0, epsilon = 0.
        mdp = FiniteMDP(np.repeat(np.eye(2)[:, None], 2, axis=1), np.array([[0.0, 1.0], [1.0, 0.0]]))
        policy = np.eye(2)
        assert policy_bisimulation_metric(mdp, policy, 1.0, 0.9)[0, 1] == 0.0
        assert aggregation_value_bound(0.0, 1.0, 0.9, 0.9) == 0.0
        np.testing.assert_allclose(policy_evaluation(mdp, policy, 0.9), 0.0)
        action_by_action = FiniteMDP(np.ones((1, 2, 1)), mdp.reward.mean(axis=0, keepdims=True))
        assert policy_evaluation(action_by_action, policy.mean(axis=0, keepdims=True), 0.9) == pytest.approx(5.0)
        np.testing.assert_allclose(values_of_chain(aggregate(mdp, policy, [0, 0]), 0.9), 0.0)


class TestModelError:
    @MANY
    @given(models())
    def test_lemma_distanceerror_holds_with_a_p_of_one(self, drawn: tuple[Setting, FiniteMDP]) -> None:
        setting, model = drawn
        exact = setting.metric
        approximate = policy_bisimulation_metric(model, setting.policy, setting.c_r, setting.c_t, setting.p)
        errors = errors_of(setting, model, exact)
        assert np.abs(exact - approximate).max() <= metric_error_bound(*errors, setting.c_r, setting.c_t) + 100 * SLACK

    @MANY
    @given(models(), st.data())
    def test_theorem_valboundmodelerror_and_crl_vfamodelerrorct_hold_for_every_encoder(
        self, drawn: tuple[Setting, FiniteMDP], data: st.DataObject
    ) -> None:
        setting, model = drawn
        n = setting.mdp.n_states
        phi = np.array(data.draw(st.lists(st.sampled_from([0.0, 0.1, 0.5, 2.0]), min_size=n, max_size=n)))
        learned = np.abs(phi[:, None] - phi)
        cells = np.unique(data.draw(st.sampled_from([phi, phi > 0.3, np.zeros(n)])), return_inverse=True)[1]
        exact = setting.metric
        approximate = policy_bisimulation_metric(model, setting.policy, setting.c_r, setting.c_t, setting.p)
        encoder_error = float(np.abs(learned - approximate).max())
        assert np.abs(exact - learned).max() <= (  # lemma:bisimboundencerr
            encoder_error + metric_error_bound(*errors_of(setting, model, exact), setting.c_r, setting.c_t) + 100 * SLACK
        )
        bound = model_error_value_bound(
            half_diameter_of_cells(learned, cells),
            encoder_error,
            *errors_of(setting, model, exact),
            setting.c_r,
            setting.c_t,
            setting.gamma,
            setting.span,
        )
        cell_values = values_of_chain(aggregate(setting.mdp, setting.policy, cells), setting.gamma)
        assert np.abs(setting.values() - cell_values[cells]).max() <= bound + 100 * SLACK

    @FEW
    @given(aggregations())
    def test_a_perfect_model_and_encoder_leave_the_bound_of_the_exact_metric(
        self, drawn: tuple[Setting, Cells, Array]
    ) -> None:
        setting = drawn[0]
        assert errors_of(setting, setting.mdp, setting.metric) == (0.0, pytest.approx(0.0, abs=SLACK))
        weights = (setting.c_r, setting.c_t, setting.gamma, setting.span)
        assert model_error_value_bound(0.3, 0.0, 0.0, 0.0, *weights) == pytest.approx(aggregation_value_bound(0.3, *weights))

    def test_bound_written_out(self) -> None:
        bound = model_error_value_bound(0.1, 0.2, 0.3, 0.4, c_r=2.0, c_t=0.5, gamma=0.9)
        assert bound == pytest.approx((0.2 + 0.2 + 4.0 / 0.5 * 0.3 + 1.0 / 0.5 * 0.4) / (2 * 0.5) + 2 * 0.4 / (0.1 * 0.5))


def errors_of(setting: Setting, model: FiniteMDP, exact: Array) -> tuple[float, float]:
    return (
        reward_error(setting.mdp, model, setting.policy),
        transition_error(setting.mdp, model, setting.policy, exact, setting.p),
    )


class TestBadInput:
    @pytest.mark.parametrize(
        ("call", "message"),
        [
            (
                lambda: value_difference_bound(np.zeros(1), 0.0, 0.5, 0.9),
                "c_r is 0; a metric that ignores rewards bounds no value",
            ),
            (lambda: value_difference_bound(np.zeros(1), 1.0, 1.0, 0.9), "c_t is 1.0"),
            (lambda: value_difference_bound(np.zeros(1), 1.0, 0.5, 1.0), "gamma is 1.0"),
            (
                lambda: value_difference_bound(np.zeros(1), 1.0, 0.5, 0.9, -1.0),
                "reward_span is -1.0; it must be a finite number",
            ),
            (lambda: aggregation_value_bound(-0.1, 1.0, 0.5, 0.9), "epsilon is -0.1"),
            (lambda: model_error_value_bound(0.0, -1.0, 0.0, 0.0, 1.0, 0.5, 0.9), "encoder_error is -1.0"),
            (lambda: metric_error_bound(0.0, np.nan, 1.0, 0.5), "transition_error is nan"),
            (lambda: mean_distance(-1.0, 1.0, 0.5), "mean_reward_gap is -1.0"),
            (lambda: policy_variance_bound(0.0, 0.0, 1.0, 0.8), "c_t is 0.8; the bound needs c_t < sqrt(0.5)"),
            (lambda: diameter_bound(THREE_APART, -1.0, 0.5), "c_r is -1.0"),
            (lambda: reward_error(THREE_APART, FORK[0], np.eye(3)), "model has transitions of shape (4, 1, 4)"),
        ],
    )
    def test_bounds_name_what_is_wrong(self, call: Any, message: str) -> None:
        with pytest.raises(ValueError, match=re.escape(message)):
            call()
