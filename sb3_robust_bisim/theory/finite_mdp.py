"""Exact bisimulation metrics of finite Markov decision processes: the ground truth behind the learned embedding.

Equation labels are those of Kemertas and Aumentado-Armstrong, "Towards Robust Bisimulation Metric Learning" (NeurIPS 2021).
Needs the ``theory`` extra (SciPy and POT). The bounds built on these metrics are in :mod:`sb3_robust_bisim.theory.bounds`.
Arrays of a wrong shape, what is no distribution, and weights outside their ranges raise ValueError.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

try:
    import ot
    from scipy.sparse import csr_array
    from scipy.spatial.distance import pdist, squareform
except ImportError as error:
    raise ImportError(
        f"{error}: exact metrics and bounds need the extra `theory`: pip install sb3_robust_bisim[theory]"
    ) from error

Array = NDArray[np.float64]

SUM_TOLERANCE = 1e-8  # how far a probability row may be from summing to one before it is refused
MAX_SWEEPS = 1000  # transport sweeps before giving up; a handful is usual
STALLED_SWEEPS = 3  # a residual of the size of rounding that these many sweeps did not lower will not fall any more
ROUNDING = 1e-13  # relative to the diameter, more than a backup with p = 1 errs by


@dataclass(frozen=True, eq=False)
class FiniteMDP:
    """A finite Markov decision process.

    :param transition: ``transition[s, a, t]`` is the probability of moving from state ``s`` to ``t`` under action ``a``;
        shape (S, A, S), each row ``transition[s, a]`` sums to 1. Stored as a normalised, read-only copy.
    :param reward: expected reward ``reward[s, a]``, shape (S, A), finite. Stored as a read-only copy.
    :raises ValueError: for a wrong shape, a negative or non-finite entry, or a row that does not sum to 1.
    """

    transition: Array
    reward: Array

    def __post_init__(self) -> None:
        shape = np.shape(self.transition)
        if len(shape) != 3 or shape[0] != shape[2] or 0 in shape:
            raise ValueError(f"transition has shape {shape}; give an array of shape (states, actions, states)")
        transition = _distributions("transition", self.transition, shape)
        reward = np.array(self.reward, dtype=np.float64)
        if reward.shape != shape[:2]:
            raise ValueError(f"reward has shape {reward.shape}; transition asks for (states, actions) = {shape[:2]}")
        if not np.isfinite(reward).all():
            raise ValueError(f"reward holds {reward[~np.isfinite(reward)][0]}; every reward must be a finite number")
        reward.flags.writeable = transition.flags.writeable = False
        object.__setattr__(self, "transition", transition)
        object.__setattr__(self, "reward", reward)

    @property
    def n_states(self) -> int:
        return self.transition.shape[0]

    @property
    def n_actions(self) -> int:
        return self.transition.shape[1]

    def under(self, policy: ArrayLike) -> FiniteMDP:
        """The Markov chain that a policy makes of this MDP: r^pi and P^pi of ``def:on-policy``, as an MDP with one action.

        :param policy: action probabilities, shape (S, A), rows summing to 1.
        :return: MDP with the same states and a single action.
        """
        probabilities = _distributions("policy", policy, self.reward.shape)
        return FiniteMDP(
            transition=np.einsum("sa,sat->st", probabilities, self.transition)[:, None, :],
            reward=np.einsum("sa,sa->s", probabilities, self.reward)[:, None],
        )


def policy_evaluation(mdp: FiniteMDP, policy: ArrayLike, gamma: float) -> Array:
    """The value function V^pi = r^pi + gamma P^pi V^pi, by a linear solve.

    :param policy: action probabilities, shape (S, A).
    :param gamma: discount factor in [0, 1).
    :return: values, shape (S,).
    """
    check_discount(gamma)
    chain = mdp.under(policy)
    return np.asarray(np.linalg.solve(np.eye(mdp.n_states) - gamma * chain.transition[:, 0], chain.reward[:, 0]), np.float64)


def stationary_distribution(mdp: FiniteMDP, policy: ArrayLike) -> Array:
    """A distribution rho^pi over states that one step of the policy leaves unchanged.

    It is the only one if the chain has a single recurrent class. Otherwise it is the one of smallest Euclidean norm among
    them, which gives every recurrent class some weight (the least-norm mixture of distributions with disjoint supports).

    :param policy: action probabilities, shape (S, A).
    :return: probabilities, shape (S,).
    """
    chain = mdp.under(policy).transition[:, 0]
    equations = np.vstack([chain.T - np.eye(mdp.n_states), np.ones(mdp.n_states)])
    solution = np.linalg.lstsq(equations, np.eye(mdp.n_states + 1)[-1], rcond=None)[0].clip(min=0.0)
    return solution / solution.sum()


def aggregate(mdp: FiniteMDP, policy: ArrayLike, partition: ArrayLike, weights: ArrayLike | None = None) -> FiniteMDP:
    """The xi-average aggregated chain in the proof of ``lemma:on-policy-vfa``.

    The policy is applied first and states are averaged after. Averaging the MDP action by action instead, as the wording of
    ``thm:generalized-ct-vfa`` would allow, breaks its bound when the policy differs inside a cell (docs/theory.md).

    :param policy: action probabilities, shape (S, A).
    :param partition: the cell Phi(s) of each state, shape (S,): integers 0 .. K - 1, each of them used.
    :param weights: the measure xi on states, shape (S,), not negative, positive on each cell; default: uniform.
    :return: an MDP with K states and one action.
    """
    cells = np.asarray(partition)
    if cells.shape != (mdp.n_states,) or not np.array_equal(np.unique(cells), np.arange(cells.max(initial=0) + 1)):
        raise ValueError(f"partition is {partition!r}; give one cell number for each of the {mdp.n_states} states, 0 .. K - 1")
    xi = np.ones(mdp.n_states) if weights is None else np.asarray(weights, dtype=np.float64)
    if xi.shape != (mdp.n_states,) or not np.isfinite(xi).all() or (xi < 0).any():
        raise ValueError(f"weights are {weights!r}; give {mdp.n_states} finite numbers, none of them negative")
    member = (cells == np.arange(cells.max() + 1)[:, None]).astype(np.float64)
    if not (member @ xi > 0).all():
        raise ValueError(f"weights {weights!r} leave cell {int(np.argmin(member @ xi))} without mass; give it some")
    average = member * xi / (member @ xi)[:, None]
    chain = mdp.under(policy)
    return FiniteMDP((average @ chain.transition[:, 0] @ member.T)[:, None, :], average @ chain.reward)


def distance_moments(distance: Array, distribution: ArrayLike) -> tuple[float, float]:
    """Mean and variance of a distance between two states drawn independently: mu_bd and sigma_bd^2, or mu_rd and sigma_rd^2.

    :param distance: a function of two states, shape (S, S).
    :param distribution: state probabilities, shape (S,); the paper's is the stationary distribution of the policy.
    :return: (mean, variance).
    """
    rho = _distributions("distribution", distribution, np.shape(distance)[:1])
    mean = float(rho @ distance @ rho)
    return mean, float(rho @ (distance - mean) ** 2 @ rho)


def wasserstein_distance(metric: Array, mu: ArrayLike, nu: ArrayLike, p: float = 1.0) -> float:
    """W_p(d)(mu, nu) of ``eq:wasserstein`` by exact transport.

    :param metric: the ground distance d, shape (S, S), not negative.
    :param mu: first distribution, shape (S,).
    :param nu: second distribution, shape (S,).
    :param p: order, at least 1.
    """
    check_order(p)
    first, second = (_distributions(name, row, np.shape(metric)[:1]) for name, row in (("mu", mu), ("nu", nu)))
    # the solver has an absolute tolerance, and powers overflow; a state without mass does not count
    scale = metric[np.ix_(first > 0, second > 0)].max() or 1.0
    with np.errstate(over="ignore"):
        cost = (metric / scale) ** p
    sources, targets, mass = _optimal_coupling(cost, first, second)
    return float(scale * (mass @ cost[sources, targets]) ** (1 / p))


def mico_distance(mdp: FiniteMDP, policy: ArrayLike, c_r: float, c_t: float) -> Array:
    """The fixed point of MICo's operator, in which the two successors are drawn independently instead of coupled optimally.

    ``U(i, j) = c_R |r^pi_i - r^pi_j| + c_T E U(i', j')`` with ``i' ~ P^pi(.|i)`` and ``j' ~ P^pi(.|j)`` (Castro et al., "MICo:
    Improved representations via sampling-based state similarity for Markov decision processes", NeurIPS 2021). The
    independent coupling is one of those that W_1 minimises over: U is an upper bound of :func:`policy_bisimulation_metric`
    with p = 1. It is a diffuse metric: symmetric, with the triangle inequality, but U(i, i) is above 0 where two independent
    walks from i can earn different rewards. On a chain with one successor per state the two are equal.

    The equation is linear. Its solution, the sum over t of ``c_T^t (P^pi)^t G (P^pi)^tT``, with G the weighted reward gaps, is
    summed by doubling the number of terms, all of them non-negative, until the rest is below rounding.

    :param policy: action probabilities, shape (S, A).
    :param c_r: weight of the reward gap, at least 0.
    :param c_t: weight of the transition term, in [0, 1).
    :return: U, shape (S, S), symmetric.
    """
    check_weights(c_r, c_t)
    chain = mdp.under(policy)
    distance, transition, weight = c_r * np.abs(chain.reward - chain.reward.T), chain.transition[:, 0], c_t
    while weight > np.finfo(np.float64).eps / 2:  # what is left out is at most this part of lemma:diam
        distance = distance + weight * (transition @ distance @ transition.T)
        transition, weight = transition @ transition, weight**2
    return (distance + distance.T) / 2


def policy_bisimulation_metric(
    mdp: FiniteMDP, policy: ArrayLike, c_r: float, c_t: float, p: float = 1.0, tol: float = 1e-8
) -> Array:
    """The on-policy bisimulation metric of ``eq:p-Wass-bisim-metric``: the one of ``mdp.under(policy)``.

    ``d_pi(i, j) = c_R |r^pi_i - r^pi_j| + c_T W_p(d_pi)(P^pi(.|i), P^pi(.|j))``. For approximate dynamics
    (``eq:approx-bisim-metric``) give the MDP with the model's transitions (and its rewards, for the paper's appendix).

    :param policy: action probabilities, shape (S, A).
    :param c_r: weight of the reward gap, at least 0.
    :param c_t: weight of the transition term, in [0, 1).
    :param p: Wasserstein order, at least 1.
    :param tol: the largest absolute error of an entry.
    :return: distances, shape (S, S).
    """
    return bisimulation_metric(mdp.under(policy), c_r, c_t, p, tol)


def bisimulation_metric(mdp: FiniteMDP, c_r: float, c_t: float, p: float = 1.0, tol: float = 1e-8) -> Array:
    """The policy-independent bisimulation metric; ``eq:ferns-bisim-metric`` is ``c_r=1 - c, c_t=c``.

    ``d(i, j) = max_a c_R |R(i, a) - R(j, a)| + c_T W_p(d)(P(.|i, a), P(.|j, a))``. By Minkowski's inequality the right-hand
    side F is a contraction in the supremum norm at the rate c_T for every p >= 1, and for p = 1 at the rate c_T times the
    largest total variation between two rows of an action. So the metric exists and is unique without the paper's Assumption
    A1, and F(d) is within rate / (1 - rate) * ``||F(d) - d||`` of it: the stopping rule.

    The fixed point is found by Howard's policy iteration over couplings: find the optimal coupling of every pair, hold them,
    iterate the cheap operator that they define, and repeat.

    :param c_r: weight of the reward gap, at least 0.
    :param c_t: weight of the transition term, in [0, 1).
    :param p: Wasserstein order, at least 1.
    :param tol: the largest absolute error of an entry, positive. Rounding comes on top: about 1e-15 of the diameter for
        p = 1, up to (1e-16)^(1/p) of it for p > 1, as mass of the size of the rounding error is moved far; both divided by
        1 - c_T at worst.
    :return: distances, shape (S, S), symmetric with zero diagonal.
    :raises RuntimeError: if ``tol`` is not reached because rounding keeps the residual from shrinking.
    """
    check_weights(c_r, c_t)
    check_order(p)
    if not tol > 0:
        raise ValueError(f"tol is {tol}; give a positive error bound such as 1e-8")
    gap = c_r * np.stack([pdist(reward[:, None], "cityblock") for reward in mdp.reward.T])
    if not gap.any():
        return np.zeros((mdp.n_states, mdp.n_states))
    moved = max(pdist(rows, "cityblock").max() / 2 for rows in mdp.transition.transpose(1, 0, 2)) if p == 1 else 1.0
    rate = c_t * min(moved, 1.0)  # with p = 1 no more mass than the largest total variation has to move
    distance = gap.max(axis=0)
    residuals: list[float] = []
    for _ in range(MAX_SWEEPS):
        couplings = [_couplings(mdp.transition[:, action], squareform(distance), p) for action in range(mdp.n_actions)]
        updated = _backup(distance, gap, couplings, c_t, p)
        residual = float(np.abs(updated - distance).max())
        if rate * residual <= (1 - rate) * tol:
            return squareform(updated)
        residuals.append(residual)
        recent, before = residuals[-STALLED_SWEEPS:], residuals[:-STALLED_SWEEPS]
        if before and min(recent) >= min(before) and residual <= ROUNDING ** (1 / p) * updated.max():
            break
        steps = int(np.log(0.01) / np.log(rate)) + 1  # enough to shrink the residual of the held couplings a hundredfold
        for _ in range(steps):
            previous, updated = updated, _backup(updated, gap, couplings, c_t, p)
            if np.abs(updated - previous).max() <= residual / 100:
                break
        distance = updated
    raise RuntimeError(f"tol={tol} is lost in rounding: entries still move by {residual:.1e}; give a larger tol")


def _backup(distance: Array, gap: Array, couplings: list[csr_array], c_t: float, p: float) -> Array:
    """One application of the bisimulation operator with the couplings held.

    :param distance: one entry for each pair of distinct states, shape (S (S - 1) / 2,), not all zero.
    :param gap: weighted reward gaps, shape (A, S (S - 1) / 2).
    """
    scale = distance.max()  # keeps the powers from overflowing
    powers = (distance / scale) ** p
    moved = [scale * (coupling @ powers) ** (1 / p) for coupling in couplings]
    return np.max(gap + c_t * np.stack(moved), axis=0)


def _couplings(rows: Array, distance: Array, p: float) -> csr_array:
    """The optimal coupling of each pair of rows, as one sparse matrix over pairs of distinct states.

    :param rows: next-state distributions, shape (S, S).
    :param distance: ground distance, shape (S, S).
    :return: entry (m, n) is the mass that pair m of rows puts on pair n of states; S (S - 1) / 2 rows and columns.
    """
    first, second = np.triu_indices(len(rows), 1)
    if (rows.max(axis=1) == 1).all():  # point masses: nothing to optimise
        successor = rows.argmax(axis=1)
        pairs, sources, targets, mass = np.arange(len(first)), successor[first], successor[second], np.ones(len(first))
    else:
        pairs, sources, targets, mass = _solve_transports(rows, (distance / distance.max()) ** p, keep_common_mass=p == 1)
    number = squareform(np.arange(len(first)))  # the number of the pair (k, l), in either order
    apart = sources != targets
    index = (pairs[apart], number[sources[apart], targets[apart]])
    return csr_array((mass[apart], index), shape=(len(first), len(first)))


def _solve_transports(
    rows: Array, cost: Array, keep_common_mass: bool
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp], Array]:
    """Solve one transport problem per pair of rows.

    With p = 1 the mass that two rows share may stay where it is (triangle inequality), which halves the problem and
    lowers the contraction rate. The iterates need not satisfy the triangle inequality, but the fixed point does.

    :return: for each entry of each optimal plan its pair number, source state, target state and mass.
    """
    none = np.zeros(0, dtype=np.intp)
    plans = [(none, none, none, np.zeros(0))]
    for number, (i, j) in enumerate(zip(*np.triu_indices(len(rows), 1), strict=True)):
        mu, nu = rows[i], rows[j]
        if keep_common_mass:
            mu, nu = np.maximum(mu - nu, 0.0), np.maximum(nu - mu, 0.0)
        if mu.any() and nu.any():
            sources, targets, mass = _optimal_coupling(cost, mu, nu)
            plans.append((np.full(len(mass), number, dtype=np.intp), sources, targets, mass))
    pairs, sources, targets, mass = (np.concatenate(part) for part in zip(*plans, strict=True))
    return pairs, sources, targets, mass


def _optimal_coupling(cost: Array, mu: Array, nu: Array) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """The optimal transport plan between two measures of equal mass, as (sources, targets, mass)."""
    sources, targets = np.flatnonzero(mu), np.flatnonzero(nu)
    if min(len(sources), len(targets)) == 1:  # the only plan there is
        plan = np.outer(mu[sources], nu[targets]) / mu.sum()
    else:
        plan = ot.emd(mu[sources], nu[targets], cost[np.ix_(sources, targets)], numItermax=10_000_000, check_marginals=False)
    row, column = np.nonzero(plan)
    return sources[row], targets[column], plan[row, column]


def _distributions(name: str, rows: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Copy, check and normalise probability rows along the last axis."""
    array = np.array(rows, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}; it must be {shape}")
    if not (array >= 0).all():
        raise ValueError(f"{name} holds {array[~(array >= 0)][0]}; probabilities are not negative")
    sums = array.sum(axis=-1, keepdims=True)
    wrong = ~(np.abs(sums - 1) <= SUM_TOLERANCE)
    if wrong.any():
        raise ValueError(f"{name} has a row that sums to {sums[wrong][0]}; divide each row by its sum")
    return array / sums


def check_weights(c_r: float, c_t: float) -> None:
    """Refuse weights for which no bisimulation metric need exist."""
    if not (0 <= c_r < np.inf):
        raise ValueError(f"c_r is {c_r}; the reward weight must be a finite number, at least 0")
    if not (0 <= c_t < 1):
        raise ValueError(f"c_t is {c_t}; the transition weight must be in [0, 1)")


def check_order(p: float) -> None:
    """Refuse a Wasserstein order for which W_p is no metric."""
    if not (1 <= p < np.inf):
        raise ValueError(f"p is {p}; the Wasserstein order must be finite and at least 1")


def check_discount(gamma: float) -> None:
    """Refuse a discount factor without finite values."""
    if not (0 <= gamma < 1):
        raise ValueError(f"gamma is {gamma}; the discount factor must be in [0, 1)")
