"""The paper's bounds on bisimulation metrics and value functions, one function each, with the conditions that they need.

Equation labels are those of Kemertas and Aumentado-Armstrong, "Towards Robust Bisimulation Metric Learning" (NeurIPS 2021).
Each docstring gives the conditions that are needed. docs/theory.md has an example of what happens without them, and says which
of them the paper assumes.
Weights outside their ranges (c_R >= 0, 0 <= c_T < 1, 0 <= gamma < 1), and negative errors or spans, raise ValueError.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sb3_robust_bisim.theory.finite_mdp import Array, FiniteMDP, check_discount, check_weights, wasserstein_distance


def diameter_bound(mdp: FiniteMDP, c_r: float, c_t: float) -> float:
    """``lemma:diam``, ``thm:boundedness``: no two states are further apart than c_R (R_max - R_min) / (1 - c_T).

    Holds for the policy-independent and every on-policy metric, exact or with approximate dynamics on the same states, p >= 1.
    """
    check_weights(c_r, c_t)
    return c_r * float(np.ptp(mdp.reward)) / (1 - c_t)


def policy_diameter_bound(mdp: FiniteMDP, policy: ArrayLike, c_r: float, c_t: float) -> float:
    """``lemma:dist-range``: :func:`diameter_bound` with the span of r^pi in place of that of R; on-policy metrics, p >= 1.

    :param policy: action probabilities, shape (S, A).
    """
    return diameter_bound(mdp.under(policy), c_r, c_t)


def value_difference_bound(distance: Array, c_r: float, c_t: float, gamma: float, reward_span: float = 1.0) -> Array:
    """``thm:generalized-ct``: an upper bound of |V^pi(i) - V^pi(j)|, i.e. the paper's inequality divided by c_R > 0.

    Holds for p >= 1. Any rewards will do where c_T >= gamma (``lemma:p-wasserstein``). Where c_T < gamma, R_max - R_min must
    not exceed ``reward_span``; the paper's R in [0, 1] is a span of 1, and only the span matters.

    :param distance: d_pi or any upper bound of it, of any shape.
    :return: the bound for each entry of ``distance``.
    """
    _check_value_bound(c_r, c_t, gamma, reward_span=reward_span)
    return distance / c_r + _myopia(c_t, gamma, reward_span)


def aggregation_value_bound(epsilon: float, c_r: float, c_t: float, gamma: float, reward_span: float = 1.0) -> float:
    """``thm:generalized-ct-vfa``: an upper bound of |V^pi(s) - V~^pi(Phi(s))| in every state.

    Holds for p >= 1 if any two states of a cell are at most 2 epsilon apart and V~^pi is the value of the chain that
    :func:`~sb3_robust_bisim.theory.aggregate` makes, with any weights. It can fail for the MDP averaged action by action when
    the policy differs inside a cell. Rewards as for :func:`value_difference_bound`.

    :param epsilon: half of the largest distance d_pi inside a cell.
    """
    _check_value_bound(c_r, c_t, gamma, reward_span=reward_span, epsilon=epsilon)
    return 2 * epsilon / (c_r * (1 - min(c_t, gamma))) + _myopia(c_t, gamma, reward_span)


def reward_error(mdp: FiniteMDP, model: FiniteMDP, policy: ArrayLike) -> float:
    """E_r of ``prop:modelerror``: the largest |r^pi - r^pi of the model|."""
    _check_same_states(mdp, model)
    return float(np.abs(mdp.under(policy).reward - model.under(policy).reward).max())


def transition_error(mdp: FiniteMDP, model: FiniteMDP, policy: ArrayLike, distance: Array, p: float = 1.0) -> float:
    """E_P of ``prop:modelerror``: the largest W_p(d_pi) between P^pi(.|s) and the model's.

    :param distance: the exact d_pi of ``mdp`` with the same p, shape (S, S).
    """
    _check_same_states(mdp, model)
    exact, approximate = (chain.under(policy).transition[:, 0] for chain in (mdp, model))
    return max(wasserstein_distance(distance, mu, nu, p) for mu, nu in zip(exact, approximate, strict=True))


def metric_error_bound(reward_error: float, transition_error: float, c_r: float, c_t: float) -> float:
    """``corollary:distanceerrorpequal1``: an upper bound of ||d_pi - d^_pi||, d^_pi being the metric of the model.

    Holds for every p >= 1, with both metrics and E_P taken at that p: Minkowski's inequality gives a_p = 1 in
    ``lemma:distanceerror``, so its diameter term and its condition c_T a_p < 1 are not needed.
    """
    check_weights(c_r, c_t)
    _check_not_negative(reward_error=reward_error, transition_error=transition_error)
    return 2 * (c_r * reward_error + c_t * transition_error) / (1 - c_t)


def model_error_value_bound(
    epsilon: float,
    encoder_error: float,
    reward_error: float,
    transition_error: float,
    c_r: float,
    c_t: float,
    gamma: float,
    reward_span: float = 1.0,
) -> float:
    """``theorem:valboundmodelerror`` and, where c_T < gamma, ``crl:vfamodelerrorct``: bounds |V^pi(s) - V~^pi(Phi(s))|.

    V~^pi is the value of the true chain, averaged by :func:`~sb3_robust_bisim.theory.aggregate` over cells that the learned
    distance makes. Holds for every p >= 1, see :func:`metric_error_bound`; rewards as for :func:`value_difference_bound`.

    :param epsilon: half of the largest learned distance ||phi(i) - phi(j)|| inside a cell.
    :param encoder_error: E_phi, the largest difference between the learned distance and the model's metric.
    :param reward_error: E_r.
    :param transition_error: E_P, measured in the exact d_pi.
    """
    _check_not_negative(encoder_error=encoder_error, epsilon=epsilon)
    radius = epsilon + (encoder_error + metric_error_bound(reward_error, transition_error, c_r, c_t)) / 2
    return aggregation_value_bound(radius, c_r, c_t, gamma, reward_span)


def mean_distance(mean_reward_gap: float, c_r: float, c_t: float) -> float:
    """``lemma:mean-lemma``: mu_bd = c_R / (1 - c_T) mu_rd.

    An equality, for every p, if states are drawn independently from a stationary distribution of the policy, and the chain of
    the policy moves from each of these states to a single next state. A deterministic environment is not enough: a
    stochastic policy makes the chain stochastic. For p = 1 and any chain it bounds mu_bd from above, for p > 1 not even that.
    For :func:`~sb3_robust_bisim.theory.mico_distance` it is an equality on every chain.

    :param mean_reward_gap: mu_rd, the mean of |r^pi_i - r^pi_j|.
    """
    check_weights(c_r, c_t)
    _check_not_negative(mean_reward_gap=mean_reward_gap)
    return c_r * mean_reward_gap / (1 - c_t)


def mean_variance_bound(mdp: FiniteMDP, c_r: float, c_t: float) -> tuple[float, float]:
    """``corollary:meanvar``: upper bounds of the mean and the variance of the distance between two random states.

    The bound of the variance holds for every metric that ``lemma:diam`` covers and every joint distribution of the two
    states. The bound of the mean holds for on-policy metrics with p = 1 and independent, identically distributed states
    (any distribution), and for MICo's distance. It can fail for the policy-independent metric and for any p > 1. The mean over
    dependent states may reach :func:`diameter_bound`, twice as much.

    :return: (bound of the mean, bound of the variance).
    """
    half = diameter_bound(mdp, c_r, c_t) / 2
    return half, half**2


def policy_variance_bound(mean_reward_gap: float, reward_gap_variance: float, c_r: float, c_t: float) -> float:
    """``prop:prop4``: an upper bound of (sigma_bd^pi)^2, under the conditions of :func:`mean_distance` for equality.

    A deterministic environment alone is not enough here either: with a stochastic policy the bound can fail, with p = 1 and
    with p = 2.

    :param mean_reward_gap: mu_rd.
    :param reward_gap_variance: sigma_rd^2.
    :param c_t: weight of the transition term, in [0, sqrt(0.5)).
    :raises ValueError: for c_t of sqrt(0.5) or more, where ``mean_variance_bound`` is what remains.
    """
    check_weights(c_r, c_t)
    _check_not_negative(mean_reward_gap=mean_reward_gap, reward_gap_variance=reward_gap_variance)
    if 2 * c_t**2 >= 1:
        raise ValueError(f"c_t is {c_t}; the bound needs c_t < sqrt(0.5), use mean_variance_bound instead")
    mean_term = ((1 - 2 * c_t) / (1 - c_t) * mean_reward_gap) ** 2
    return c_r**2 * (2 * reward_gap_variance + mean_term) / (1 - 2 * c_t**2)


def _myopia(c_t: float, gamma: float, reward_span: float) -> float:
    """What c_T < gamma costs: twice ``lemma:diff-gamma``, as in the paper, though once is enough (docs/theory.md)."""
    return 2 * reward_span * (gamma - min(c_t, gamma)) / ((1 - gamma) * (1 - c_t))


def _check_value_bound(c_r: float, c_t: float, gamma: float, **not_negative: float) -> None:
    check_weights(c_r, c_t)
    check_discount(gamma)
    _check_not_negative(**not_negative)
    if c_r == 0:
        raise ValueError("c_r is 0; a metric that ignores rewards bounds no value, give c_r > 0")


def _check_not_negative(**numbers: float) -> None:
    for name, number in numbers.items():
        if not (0 <= number < np.inf):
            raise ValueError(f"{name} is {number}; it must be a finite number, at least 0")


def _check_same_states(mdp: FiniteMDP, model: FiniteMDP) -> None:
    if mdp.transition.shape != model.transition.shape:
        raise ValueError(f"model has transitions of shape {model.transition.shape}; the MDP asks for {mdp.transition.shape}")
