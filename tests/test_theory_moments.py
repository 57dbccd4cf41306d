"""The paper's statements about the mean and variance of distances, on random finite MDPs, with counterexamples."""

import numpy as np
import ot
import pytest
from finite_mdps import BEFORE_FORK, FORK, MANY, THREE_APART, Setting, chain, distributions, settings_of
from hypothesis import given
from hypothesis import strategies as st

from sb3_robust_bisim.theory import (
    FiniteMDP,
    bisimulation_metric,
    distance_moments,
    mico_distance,
    policy_bisimulation_metric,
    stationary_distribution,
)
from sb3_robust_bisim.theory.bounds import mean_distance, mean_variance_bound, policy_variance_bound

SLACK = 1e-6  # the metrics carry an error of 1e-8, and rounding for p > 1


class TestMeanDistance:
    @MANY
    @given(settings_of(deterministic=True))
    def test_lemma_mean_lemma_is_an_equality_for_deterministic_chains(self, setting: Setting) -> None:
        rho = stationary_distribution(setting.mdp, setting.policy)
        expected = mean_distance(distance_moments(setting.reward_gap(), rho)[0], setting.c_r, setting.c_t)
        assert distance_moments(setting.metric, rho)[0] == pytest.approx(expected, abs=SLACK)

    @MANY
    @given(settings_of())
    def test_lemma_mean_lemma_is_an_upper_bound_for_every_chain_when_p_is_one(self, setting: Setting) -> None:
        setting.p = 1.0
        rho = stationary_distribution(setting.mdp, setting.policy)
        bound = mean_distance(distance_moments(setting.reward_gap(), rho)[0], setting.c_r, setting.c_t)
        assert distance_moments(setting.metric, rho)[0] <= bound + SLACK

    @MANY
    @given(settings_of())
    def test_lemma_mean_lemma_is_an_equality_for_mico_on_every_chain(self, setting: Setting) -> None:
        rho = stationary_distribution(setting.mdp, setting.policy)
        expected = mean_distance(distance_moments(setting.reward_gap(), rho)[0], setting.c_r, setting.c_t)
        distance = mico_distance(setting.mdp, setting.policy, setting.c_r, setting.c_t)
        assert distance_moments(distance, rho)[0] == pytest.approx(expected, abs=SLACK)

    def test_stochastic_policy_in_a_deterministic_environment_breaks_the_equality(self) -> None:
        mdp = FiniteMDP(np.array([np.eye(2), np.eye(2)]), np.array([[0.0, 0.0], [1.0, 1.0]]))  # action a leads to state a
        policy = np.full((2, 2), 0.5)
        rho = stationary_distribution(mdp, policy)
        mean, _ = distance_moments(policy_bisimulation_metric(mdp, policy, 1.0, 0.9), rho)
        assert mean == pytest.approx(0.5)
        assert mean_distance(0.5, 1.0, 0.9) == pytest.approx(5.0)

    def test_states_not_from_the_stationary_distribution_break_the_equality(self) -> None:
        mean, _ = distance_moments(policy_bisimulation_metric(*FORK, 1.0, 0.9), BEFORE_FORK)
        assert mean == pytest.approx(4.5)  # while every reward gap is 0

    def test_rare_event_breaks_the_upper_bound_when_p_is_two(self) -> None:
        rare = chain([[0, 0.99, 0.01], [1, 0, 0], [1, 0, 0]], [0, 0, 1])
        rho = stationary_distribution(*rare)
        mean, _ = distance_moments(policy_bisimulation_metric(*rare, 1.0, 0.9, p=2), rho)
        gap, _ = distance_moments(np.abs(rare[0].reward - rare[0].reward.T), rho)
        assert mean == pytest.approx(0.1367, abs=1e-4)
        assert mean_distance(gap, 1.0, 0.9) == pytest.approx(0.0995, abs=1e-4)


class TestMeanAndVariance:
    @MANY
    @given(settings_of(), st.data())
    def test_mean_bound_of_corollary_meanvar_holds_on_policy_for_independent_states(
        self, setting: Setting, data: st.DataObject
    ) -> None:
        rho = data.draw(distributions(1, setting.mdp.n_states))[0]
        bound, _ = mean_variance_bound(setting.mdp, setting.c_r, setting.c_t)
        upper = mico_distance(setting.mdp, setting.policy, setting.c_r, setting.c_t)  # of the metric with p = 1
        assert distance_moments(upper, rho)[0] <= bound + SLACK

    @MANY
    @given(settings_of(), st.data())
    def test_ball_has_room_for_every_on_policy_metric_that_embeds_in_l2(self, setting: Setting, data: st.DataObject) -> None:
        setting.p = 1.0
        rho = data.draw(distributions(1, setting.mdp.n_states))[0]
        radius, _ = mean_variance_bound(setting.mdp, setting.c_r, setting.c_t)  # half the diameter
        # The squared radius of the smallest ball around points is the largest such mean, over all distributions.
        assert rho @ setting.metric**2 @ rho / 2 <= radius**2 + 100 * SLACK

    @MANY
    @given(settings_of(), st.data())
    def test_variance_bound_of_corollary_meanvar_holds_for_every_metric_and_any_pairs(
        self, setting: Setting, data: st.DataObject
    ) -> None:
        n = setting.mdp.n_states
        pairs = data.draw(distributions(1, n * n)).reshape(n, n)
        _, bound = mean_variance_bound(setting.mdp, setting.c_r, setting.c_t)
        for distance in (setting.metric, bisimulation_metric(setting.mdp, setting.c_r, setting.c_t, setting.p)):
            assert (pairs * distance**2).sum() - (pairs * distance).sum() ** 2 <= bound + 100 * SLACK

    def test_both_bounds_are_reached_by_two_states_that_never_change(self) -> None:
        never_changes = chain([[1, 0], [0, 1]], [0, 1])
        moments = distance_moments(policy_bisimulation_metric(*never_changes, 1.0, 0.9), [0.5, 0.5])
        assert moments == (pytest.approx(5.0), pytest.approx(25.0))
        assert mean_variance_bound(never_changes[0], 1.0, 0.9) == (pytest.approx(5.0), pytest.approx(25.0))

    def test_mean_of_the_policy_independent_metric_exceeds_the_bound(self) -> None:
        mean, _ = distance_moments(bisimulation_metric(THREE_APART, 1.0, 0.9), np.full(3, 1 / 3))
        assert mean == pytest.approx(20 / 3)
        assert mean_variance_bound(THREE_APART, 1.0, 0.9)[0] == pytest.approx(5.0)

    def test_mean_of_dependent_states_exceeds_the_bound(self) -> None:
        never_changes = chain([[1, 0], [0, 1]], [0, 1])
        assert policy_bisimulation_metric(*never_changes, 1.0, 0.9)[0, 1] == pytest.approx(10.0)  # the pair is always (0, 1)
        assert mean_variance_bound(never_changes[0], 1.0, 0.9)[0] == pytest.approx(5.0)

    @pytest.mark.parametrize(("p", "rare", "expected"), [(2, 0.01, 5.277), (1.1, 1e-5, 5.00007)])
    def test_mean_of_an_on_policy_metric_exceeds_the_bound_when_p_is_above_one(
        self, p: float, rare: float, expected: float
    ) -> None:
        stays = 1 - rare
        swap = chain([[stays, 0, rare, 0], [0, 1, 0, 0], [rare, 0, stays, 0], [0, 0, 0, 1]], [1, 0, 0, 1])
        mean, _ = distance_moments(policy_bisimulation_metric(*swap, 1.0, 0.9, p), stationary_distribution(*swap))
        assert mean == pytest.approx(expected, abs=1e-2 * (expected - 5))
        assert mean_variance_bound(swap[0], 1.0, 0.9)[0] == pytest.approx(5.0)


class TestVarianceOnPolicy:
    @MANY
    @given(settings_of(deterministic=True))
    def test_prop_prop4_holds_for_deterministic_chains(self, setting: Setting) -> None:
        rho = stationary_distribution(setting.mdp, setting.policy)
        setting.c_t *= 0.7
        moments = distance_moments(setting.reward_gap(), rho)
        assert (
            distance_moments(setting.metric, rho)[1] <= policy_variance_bound(*moments, setting.c_r, setting.c_t) + 100 * SLACK
        )

    def test_prop_prop4_at_one_half_is_four_times_the_variance_of_the_reward_gap(self) -> None:
        assert policy_variance_bound(123.0, 0.25, 3.0, 0.5) == pytest.approx(4 * 9 * 0.25)

    @pytest.mark.parametrize(("p", "expected"), [(1, 0.7744), (2, 0.7768)])
    def test_stochastic_policy_in_a_deterministic_environment_breaks_it(self, p: float, expected: float) -> None:
        # Action a leads states 0 and 1 to state 2, and state 2 to state a.
        transition = np.eye(3)[np.array([[2, 2], [2, 2], [0, 1]])]
        mdp = FiniteMDP(transition, np.array([[1.0, 1.0], [0.8, 0.8], [0.0, 0.0]]))
        policy = np.full((3, 2), 0.5)
        rho = stationary_distribution(mdp, policy)
        _, variance = distance_moments(policy_bisimulation_metric(mdp, policy, 1.0, 0.5, p), rho)
        moments = distance_moments(np.abs(mdp.under(policy).reward - mdp.under(policy).reward.T), rho)
        assert variance == pytest.approx(expected, abs=1e-4)
        assert policy_variance_bound(*moments, 1.0, 0.5) == pytest.approx(0.7575, abs=1e-4)

    def test_states_not_from_the_stationary_distribution_break_it(self) -> None:
        _, variance = distance_moments(policy_bisimulation_metric(*FORK, 1.0, 0.6), BEFORE_FORK)
        assert variance > 0.5
        assert policy_variance_bound(0.0, 0.0, 1.0, 0.6) == 0.0


def test_eq_2_wasserstein_holds_for_standard_deviations_and_not_for_variances() -> None:
    zero, two = np.zeros(1), np.full((1, 1), 2.0)
    distance = ot.gaussian.bures_wasserstein_distance(zero, zero, np.eye(1), two**2)
    assert distance == pytest.approx(1.0)  # |2 - 1|; the formula on covariances would give |4 - 1|
