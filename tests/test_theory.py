"""Exact bisimulation metrics of finite MDPs agree with hand calculations and independent solvers, and obey their axioms."""

import re
import runpy
import sys
import time
from typing import Any

import numpy as np
import pytest
from finite_mdps import FEW, MANY, ORDERS, REWARD_WEIGHTS, TRANSITION_WEIGHTS, chain, distributions, mdps, mdps_with_policy
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

import sb3_robust_bisim.theory.finite_mdp as solver
from sb3_robust_bisim.theory import (
    Array,
    FiniteMDP,
    aggregate,
    bisimulation_metric,
    distance_moments,
    mico_distance,
    policy_bisimulation_metric,
    policy_evaluation,
    stationary_distribution,
    wasserstein_distance,
)

SWITCH = FiniteMDP(np.array([np.eye(2), np.eye(2)]), np.array([[0.0, 0.0], [1.0, 1.0]]))  # action a leads to state a


def transport_by_linear_programming(cost: Array, mu: Array, nu: Array) -> float:
    n = len(mu)
    marginals = np.vstack([np.kron(np.eye(n), np.ones(n)), np.kron(np.ones(n), np.eye(n))[:-1]])
    solution = linprog(cost.ravel(), A_eq=marginals, b_eq=np.concatenate([mu, nu[:-1]]))
    assert solution.success
    return float(solution.fun)


def operator(mdp: FiniteMDP, distance: Array, c_r: float, c_t: float, p: float) -> Array:
    """The right-hand side of eq:p-Wass-bisim-metric with a maximum over actions, transport by transport."""
    values = np.zeros((mdp.n_states, mdp.n_states))
    for i, j in np.ndindex(values.shape):
        gaps = c_r * np.abs(mdp.reward[i] - mdp.reward[j])
        moved = [wasserstein_distance(distance, mdp.transition[i, a], mdp.transition[j, a], p) for a in range(mdp.n_actions)]
        values[i, j] = (gaps + c_t * np.array(moved)).max()
    return values


@st.composite
def distance_pairs(draw: st.DrawFn) -> tuple[FiniteMDP, Array, Array]:
    """An MDP and two non-negative symmetric functions of its state pairs."""
    mdp = draw(mdps(states=(2, 3), actions=(1, 2)))
    size = mdp.n_states**2
    entries = st.lists(st.floats(0.0, 5.0, width=16), min_size=size, max_size=size)
    first, second = (np.reshape(draw(entries), (mdp.n_states, mdp.n_states)) for _ in range(2))
    return mdp, np.maximum(first, first.T), np.maximum(second, second.T)


class TestTransport:
    @MANY
    @given(st.integers(2, 5).flatmap(lambda n: st.tuples(distributions(2, n), st.permutations(range(n)))))
    def test_agrees_with_a_linear_program(self, drawn: tuple[Array, list[int]]) -> None:
        (mu, nu), order = drawn
        position = np.sqrt(np.arange(len(mu)))[order]
        distance = np.abs(position[:, None] - position)
        for p in (1.0, 2.0):
            expected = transport_by_linear_programming(distance**p, mu, nu)
            assert wasserstein_distance(distance, mu, nu, p) ** p == pytest.approx(expected, abs=1e-6)

    @MANY
    @given(st.integers(2, 5).flatmap(lambda n: distributions(2, n)), st.sampled_from([1.5, 2.0, 4.0]))
    def test_order_obeys_lemma_wass_lemma_and_lemma_wass_diam(self, rows: Array, p: float) -> None:
        distance = 3 * np.abs(np.subtract.outer(np.arange(rows.shape[1]), np.arange(rows.shape[1])))
        first, higher = (wasserstein_distance(distance, rows[0], rows[1], order) for order in (1.0, p))
        assert first <= higher + 1e-9
        assert higher <= distance.max() ** ((p - 1) / p) * first ** (1 / p) + 1e-6

    @pytest.mark.parametrize("p", [1.0, 2.0, 4.0, 100.0])
    @pytest.mark.parametrize("scale", [1e-9, 1e-4, 1e4])
    def test_grows_in_proportion_to_the_metric(self, scale: float, p: float) -> None:
        random = np.random.default_rng(0)
        distance = np.abs(np.subtract.outer(position := random.random(12), position))
        mu, nu = random.dirichlet(np.ones(12), size=2)
        expected = wasserstein_distance(distance, mu, nu, p)
        assert wasserstein_distance(scale * distance, mu, nu, p) == pytest.approx(scale * expected, rel=1e-6)

    @pytest.mark.parametrize("p", [1.0, 2.0, 4.0, 100.0])
    def test_does_not_depend_on_a_far_state_without_mass(self, p: float) -> None:
        random = np.random.default_rng(0)
        position = np.append(random.random(12), 1e6)
        distance = np.abs(np.subtract.outer(position, position))
        mu, nu = random.dirichlet(np.ones(12), size=2)
        expected = wasserstein_distance(distance[:12, :12], mu, nu, p)
        assert wasserstein_distance(distance, np.append(mu, 0), np.append(nu, 0), p) == pytest.approx(expected, rel=1e-9)

    def test_between_point_masses_is_the_distance(self) -> None:
        assert wasserstein_distance(np.array([[0.0, 7.0], [7.0, 0.0]]), [1, 0], [0, 1], p=3) == pytest.approx(7.0)


class TestMetric:
    @FEW
    @given(mdps(), REWARD_WEIGHTS, TRANSITION_WEIGHTS, ORDERS)
    def test_is_a_pseudometric(self, mdp: FiniteMDP, c_r: float, c_t: float, p: float) -> None:
        distance = bisimulation_metric(mdp, c_r, c_t, p)
        np.testing.assert_array_equal(distance, distance.T)
        np.testing.assert_array_equal(np.diag(distance), 0.0)
        assert (distance >= 0).all()
        assert (distance[:, None, :] <= distance[:, :, None] + distance[None, :, :] + 1e-6).all()

    @FEW
    @given(mdps(), REWARD_WEIGHTS, TRANSITION_WEIGHTS, ORDERS)
    def test_is_the_fixed_point_of_its_equation(self, mdp: FiniteMDP, c_r: float, c_t: float, p: float) -> None:
        distance = bisimulation_metric(mdp, c_r, c_t, p, tol=1e-9)
        np.testing.assert_allclose(operator(mdp, distance, c_r, c_t, p), distance, atol=1e-9 if p == 1 else 1e-6)

    @FEW
    @given(distance_pairs(), REWARD_WEIGHTS, TRANSITION_WEIGHTS, st.sampled_from([1.0, 2.0, 4.0]))
    def test_operator_contracts_by_c_t_whatever_the_order(
        self, drawn: tuple[FiniteMDP, Array, Array], c_r: float, c_t: float, p: float
    ) -> None:
        mdp, first, second = drawn
        moved = np.abs(operator(mdp, first, c_r, c_t, p) - operator(mdp, second, c_r, c_t, p)).max()
        assert moved <= c_t * np.abs(first - second).max() + 1e-6

    @FEW
    @given(mdps_with_policy(), st.sampled_from([1.0, 0.1, 1e-3]), ORDERS)
    def test_error_stays_below_tol(self, drawn: tuple[FiniteMDP, Array], tol: float, p: float) -> None:
        rough, exact = (policy_bisimulation_metric(*drawn, 1.0, 0.9, p, tol=bound) for bound in (tol, 1e-9))
        assert np.abs(rough - exact).max() <= tol + 1e-6

    @settings(FEW, max_examples=10)
    @given(mdps_with_policy())
    def test_agrees_with_value_iteration_over_linear_programs(self, drawn: tuple[FiniteMDP, Array]) -> None:
        reward_process = drawn[0].under(drawn[1])
        rows, reward = reward_process.transition[:, 0], reward_process.reward[:, 0]
        expected = np.zeros((len(rows), len(rows)))
        for _ in range(7):
            plans = [[transport_by_linear_programming(expected, mu, nu) for nu in rows] for mu in rows]
            expected = np.abs(reward[:, None] - reward) + 0.1 * np.array(plans)
        np.testing.assert_allclose(policy_bisimulation_metric(*drawn, 1.0, 0.1), expected, atol=1e-6)

    def test_keeps_its_tolerance_on_many_states_and_a_long_horizon(self) -> None:
        rng = np.random.default_rng(0)
        mdp = FiniteMDP(rng.dirichlet(np.full(12, 0.2), size=(12, 2)), rng.random((12, 2)))
        distance = bisimulation_metric(mdp, 1.0, 0.99, tol=1e-9)
        np.testing.assert_allclose(operator(mdp, distance, 1.0, 0.99, 1.0), distance, atol=2e-9)

    def test_of_twenty_dense_states_takes_less_than_a_second(self) -> None:
        rng = np.random.default_rng(0)
        mdp = FiniteMDP(rng.dirichlet(np.ones(20), size=(20, 1)), rng.random((20, 1)))
        start = time.process_time()
        bisimulation_metric(mdp, 1.0, 0.99)
        assert time.process_time() - start < 1.0

    def test_says_so_when_rounding_stands_in_the_way_of_tol(self) -> None:
        def solve_to_the_last_bit() -> None:
            for seed in range(100):
                rng = np.random.default_rng(seed)
                bisimulation_metric(FiniteMDP(rng.dirichlet(np.ones(4), size=(4, 2)), rng.random((4, 2))), 1.0, 0.9, 2, 1e-300)

        with pytest.raises(RuntimeError, match=r"tol=1e-300 is lost in rounding.*larger tol"):
            solve_to_the_last_bit()

    @pytest.mark.parametrize("p", [1.0, 2.0])
    @pytest.mark.parametrize("c_t", [0.99, 0.999])
    def test_gives_up_within_a_few_sweeps_when_rounding_stands_in_the_way(
        self, c_t: float, p: float, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(solver, "MAX_SWEEPS", 50)
        sweeps, find_couplings = 0, solver._couplings

        def count_and_find(*arguments: Any) -> Any:
            nonlocal sweeps
            sweeps += 1
            return find_couplings(*arguments)

        def solve_with_large_rewards() -> None:
            nonlocal sweeps
            for seed in range(30):  # a residual may also end at exactly 0
                rng, sweeps = np.random.default_rng(seed), 0
                bisimulation_metric(FiniteMDP(rng.dirichlet(np.ones(6), size=(6, 1)), 1e8 * rng.random((6, 1))), 1.0, c_t, p)

        monkeypatch.setattr(solver, "_couplings", count_and_find)
        with pytest.raises(RuntimeError, match="lost in rounding"):
            solve_with_large_rewards()
        assert sweeps < 20


class TestSolvedByHand:
    @MANY
    @given(mdps_with_policy(deterministic=True), TRANSITION_WEIGHTS, st.sampled_from([1.0, 2.0, 7.0]))
    def test_deterministic_metric_is_the_discounted_sum_of_reward_gaps(
        self, drawn: tuple[FiniteMDP, Array], c_t: float, p: float
    ) -> None:
        mdp, policy = drawn
        step = mdp.under(policy).transition[:, 0].argmax(axis=1)
        reward = mdp.under(policy).reward[:, 0]
        expected, reached = np.zeros((mdp.n_states, mdp.n_states)), np.arange(mdp.n_states)
        for t in range(300):
            expected += 2.0 * c_t**t * np.abs(reward[reached, None] - reward[reached])
            reached = step[reached]
        np.testing.assert_allclose(policy_bisimulation_metric(mdp, policy, 2.0, c_t, p), expected, atol=2e-8)

    def test_ring(self) -> None:
        n, c_t = 5, 0.8
        distance = policy_bisimulation_metric(*chain(np.roll(np.eye(n), 1, axis=1).tolist(), [1, 0, 0, 0, 0]), 1.0, c_t)
        wait = -np.arange(n) % n  # steps until the rewarded state 0
        expected = (c_t ** wait[:, None] + c_t**wait) / (1 - c_t**n) * (1 - np.eye(n))
        np.testing.assert_allclose(distance, expected, atol=1e-8)

    @pytest.mark.parametrize("p", [1.0, 2.0, 3.0])
    def test_chain_that_is_absorbed_with_chance_q(self, p: float) -> None:
        q, c_t = 0.3, 0.9
        distance = policy_bisimulation_metric(*chain([[1 - q, q], [0, 1]], [0, 1]), 2.0, c_t, p)
        assert distance[0, 1] == pytest.approx(2.0 / (1 - c_t * (1 - q) ** (1 / p)), abs=1e-8)

    def test_corridor_to_an_absorbing_goal(self) -> None:
        distance = policy_bisimulation_metric(*chain([[0, 1, 0], [0, 0, 1], [0, 0, 1]], [0, 0, 1]), 1.0, 0.5)
        np.testing.assert_allclose(distance, [[0, 0.5, 1.5], [0.5, 0, 1], [1.5, 1, 0]], atol=1e-8)

    @pytest.mark.parametrize("p", [1.0, 2.0, 4.0])
    def test_shared_mass_moves_when_that_is_shorter(self, p: float) -> None:
        # States 0, 1, 2 lie 2 apart on a line. From row 3 to row 4 all mass moves by 2, or half of it by 4: worse if p > 1.
        line = np.eye(3, 5)
        rows = np.vstack([line, (line[0] + line[1]) / 2, (line[1] + line[2]) / 2])
        distance = policy_bisimulation_metric(*chain(rows.tolist(), [0, 1, 2, 0, 0]), 1.0, 0.5, p)
        np.testing.assert_allclose(distance[:3, :3], 2 * np.abs(np.subtract.outer(range(3), range(3))), atol=1e-8)
        assert distance[3, 4] == pytest.approx(1.0)

    def test_equal_rows_leave_the_reward_gap(self) -> None:
        distance = policy_bisimulation_metric(*chain([[0.3, 0.7], [0.3, 0.7]], [0, 1]), 3.0, 0.9)
        np.testing.assert_allclose(distance, [[0, 3], [3, 0]])

    def test_constant_rewards_collapse_the_metric(self) -> None:
        np.testing.assert_array_equal(policy_bisimulation_metric(*chain([[0, 1], [1, 0]], [5, 5]), 1.0, 0.9), 0.0)


def test_a_metric_need_not_be_unique_where_distances_are_unbounded() -> None:
    # The chain s -> s + 1 without rewards: d(i, j) = c_T d(i + 1, j + 1) holds for 0 and for this one.
    c_t, state = 0.5, np.arange(20.0)
    distance = np.abs(np.subtract.outer(c_t**-state, c_t**-state))
    np.testing.assert_array_equal(distance[:-1, :-1], c_t * distance[1:, 1:])


class TestMICo:
    def test_of_two_states_with_the_same_random_successor(self) -> None:
        # The mean m over two uniform states solves m = 0.5 + 0.9 m.
        distance = mico_distance(*chain([[0.5, 0.5], [0.5, 0.5]], [0, 1]), 1.0, 0.9)
        np.testing.assert_allclose(distance, [[4.5, 5.5], [5.5, 4.5]])

    def test_of_a_chain_that_is_absorbed_with_chance_q(self) -> None:
        q, c_r, c_t = 0.3, 2.0, 0.9
        stays = 1 - q
        between = c_r / (1 - c_t * stays)
        itself = 2 * c_t * q * stays * between / (1 - c_t * stays**2)
        distance = mico_distance(*chain([[stays, q], [0, 1]], [0, 1]), c_r, c_t)
        np.testing.assert_allclose(distance, [[itself, between], [between, 0]])

    @FEW
    @given(mdps_with_policy(), REWARD_WEIGHTS, TRANSITION_WEIGHTS, st.integers(0, 5))
    def test_iteration_from_anywhere_comes_closer_by_c_t_each_time(
        self, drawn: tuple[FiniteMDP, Array], c_r: float, c_t: float, seed: int
    ) -> None:
        reward_process = drawn[0].under(drawn[1])
        rows, gap = reward_process.transition[:, 0], c_r * np.abs(reward_process.reward - reward_process.reward.T)
        distance = mico_distance(*drawn, c_r, c_t)
        iterate = 5 * np.random.default_rng(seed).random(gap.shape)
        error = np.abs(iterate - distance).max()
        for _ in range(300):
            iterate = gap + c_t * np.einsum("ik,jl,kl->ij", rows, rows, iterate)
            assert np.abs(iterate - distance).max() <= c_t * error + 1e-12
            error = np.abs(iterate - distance).max()
        np.testing.assert_allclose(iterate, distance, atol=1e-11)

    @MANY
    @given(mdps_with_policy(), REWARD_WEIGHTS, TRANSITION_WEIGHTS)
    def test_is_a_diffuse_metric_between_the_bisimulation_metric_and_the_diameter(
        self, drawn: tuple[FiniteMDP, Array], c_r: float, c_t: float
    ) -> None:
        distance = mico_distance(*drawn, c_r, c_t)
        np.testing.assert_array_equal(distance, distance.T)
        assert (distance[:, None, :] <= distance[:, :, None] + distance[None, :, :] + 1e-9).all()
        assert (policy_bisimulation_metric(*drawn, c_r, c_t) <= distance + 1e-6).all()
        assert distance.max() <= c_r * np.ptp(drawn[0].under(drawn[1]).reward) / (1 - c_t) + 1e-9

    @FEW
    @given(mdps_with_policy(deterministic=True), TRANSITION_WEIGHTS)
    def test_is_the_bisimulation_metric_of_a_deterministic_chain(self, drawn: tuple[FiniteMDP, Array], c_t: float) -> None:
        np.testing.assert_allclose(mico_distance(*drawn, 2.0, c_t), policy_bisimulation_metric(*drawn, 2.0, c_t), atol=2e-8)

    def test_refuses_weights_without_a_fixed_point(self) -> None:
        with pytest.raises(ValueError, match=re.escape("c_t is 1.0")):
            mico_distance(SWITCH, np.full((2, 2), 0.5), 1.0, 1.0)


class TestPolicyIndependentMetric:
    def test_takes_the_action_that_tells_states_apart(self) -> None:
        mdp = FiniteMDP(np.repeat(np.eye(2)[:, None], 2, axis=1), np.array([[0.0, 0.2], [0.0, 0.6]]))
        assert bisimulation_metric(mdp, 1.0, 0.5)[0, 1] == pytest.approx(0.8)
        assert policy_bisimulation_metric(mdp, [[1, 0], [1, 0]], 1.0, 0.5)[0, 1] == 0.0

    @FEW
    @given(mdps())
    def test_of_ferns_scales_to_at_most_one(self, mdp: FiniteMDP) -> None:
        c = 0.7
        distance = bisimulation_metric(mdp, 1 - c, c)
        assert distance.max() <= 1 + 1e-6
        np.testing.assert_allclose(distance * 3, bisimulation_metric(mdp, 3 * (1 - c), c), atol=1e-6)

    @FEW
    @given(mdps())
    def test_bounds_the_difference_of_optimal_values(self, mdp: FiniteMDP) -> None:
        values = np.zeros(mdp.n_states)
        for _ in range(200):
            values = (mdp.reward + 0.8 * mdp.transition @ values).max(axis=1)
        assert (np.abs(values[:, None] - values) <= bisimulation_metric(mdp, 1.0, 0.8) + 1e-6).all()


class TestPolicyQuantities:
    @FEW
    @given(mdps_with_policy())
    def test_values_are_the_discounted_rewards_to_come(self, drawn: tuple[FiniteMDP, Array]) -> None:
        reward_process = drawn[0].under(drawn[1])
        expected = np.zeros(drawn[0].n_states)
        for _ in range(200):
            expected = reward_process.reward[:, 0] + 0.8 * reward_process.transition[:, 0] @ expected
        np.testing.assert_allclose(policy_evaluation(*drawn, 0.8), expected, atol=1e-9)

    @MANY
    @given(mdps_with_policy())
    def test_stationary_distribution_does_not_move(self, drawn: tuple[FiniteMDP, Array]) -> None:
        rho = stationary_distribution(*drawn)
        assert (rho >= 0).all()
        assert rho.sum() == pytest.approx(1.0)
        np.testing.assert_allclose(rho @ drawn[0].under(drawn[1]).transition[:, 0], rho, atol=1e-9)

    def test_stationary_distribution_reaches_every_recurrent_class(self) -> None:
        np.testing.assert_allclose(stationary_distribution(*chain(np.eye(3).tolist(), [0, 0, 0])), np.full(3, 1 / 3))

    def test_moments_are_those_of_independent_states(self) -> None:
        mean, variance = distance_moments(np.array([[0.0, 4.0], [4.0, 0.0]]), [0.25, 0.75])
        assert (mean, variance) == (pytest.approx(1.5), pytest.approx(16 * 0.375 - 1.5**2))

    def test_cells_average_rewards_and_add_up_transitions(self) -> None:
        mdp, policy = chain([[0, 0.5, 0.5], [1, 0, 0], [0, 0, 1]], [1, 2, 3])
        cells = aggregate(mdp, policy, [0, 0, 1], weights=[3, 1, 5])
        np.testing.assert_allclose(cells.transition[:, 0], np.array([[0.625, 0.375], [0, 1]]))
        np.testing.assert_allclose(cells.reward[:, 0], [1.25, 3.0])


class TestBadInput:
    @pytest.mark.parametrize(
        ("transition", "reward", "message"),
        [
            (
                np.ones((2, 2)),
                np.ones((2, 1)),
                "transition has shape (2, 2); give an array of shape (states, actions, states)",
            ),
            (np.ones((2, 1, 3)), np.ones((2, 1)), "transition has shape (2, 1, 3)"),
            (np.ones((2, 1, 2)), np.ones((2, 1)), "transition has a row that sums to 2.0; divide each row by its sum"),
            ([[[1.5, -0.5]], [[1, 0]]], np.ones((2, 1)), "transition holds -0.5; probabilities are not negative"),
            ([[[np.nan, 1]], [[1, 0]]], np.ones((2, 1)), "transition holds nan"),
            (np.eye(2)[:, None], np.ones(2), "reward has shape (2,); transition asks for (states, actions) = (2, 1)"),
            (np.eye(2)[:, None], [[np.inf], [0]], "reward holds inf; every reward must be a finite number"),
        ],
    )
    def test_mdp_names_what_is_wrong(self, transition: Any, reward: Any, message: str) -> None:
        with pytest.raises(ValueError, match=re.escape(message)):
            FiniteMDP(transition, reward)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"c_t": 1.0}, "c_t is 1.0; the transition weight must be in [0, 1)"),
            ({"c_t": -0.1}, "c_t is -0.1"),
            ({"c_r": -1.0}, "c_r is -1.0; the reward weight must be a finite number, at least 0"),
            ({"p": 0.5}, "p is 0.5; the Wasserstein order must be finite and at least 1"),
            ({"tol": 0.0}, "tol is 0.0; give a positive error bound"),
            ({"policy": np.ones((2, 2))}, "policy has a row that sums to 2.0"),
            ({"policy": np.ones((2, 1))}, "policy has shape (2, 1); it must be (2, 2)"),
        ],
    )
    def test_metric_names_what_is_wrong(self, arguments: dict[str, Any], message: str) -> None:
        with pytest.raises(ValueError, match=re.escape(message)):
            policy_bisimulation_metric(**{"mdp": SWITCH, "policy": np.full((2, 2), 0.5), "c_r": 1.0, "c_t": 0.9, **arguments})

    def test_discount_of_one_is_refused(self) -> None:
        with pytest.raises(ValueError, match=re.escape("gamma is 1.0; the discount factor must be in [0, 1)")):
            policy_evaluation(SWITCH, np.full((2, 2), 0.5), 1.0)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"partition": [0, 2]}, "partition is [0, 2]; give one cell number for each of the 2 states"),
            ({"partition": [0]}, "partition is [0]"),
            ({"partition": [0, 1], "weights": [1, 0]}, "leave cell 1 without mass"),
            ({"partition": [0, 0], "weights": [1, -1]}, "none of them negative"),
        ],
    )
    def test_aggregation_names_what_is_wrong(self, arguments: dict[str, Any], message: str) -> None:
        with pytest.raises(ValueError, match=re.escape(message)):
            aggregate(SWITCH, np.full((2, 2), 0.5), **arguments)

    def test_a_missing_package_is_named(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "ot", None)
        with pytest.raises(ImportError, match=r"need the extra `theory`: pip install sb3_robust_bisim\[theory\]"):
            runpy.run_path(str(solver.__file__))

    def test_arrays_of_an_mdp_cannot_be_changed(self) -> None:
        with pytest.raises(ValueError, match="read-only"):
            SWITCH.reward[0, 0] = 1.0
