"""Small finite MDPs for the tests of the theory. Hypothesis draws some, others are written out."""

from dataclasses import dataclass

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st

from sb3_robust_bisim.theory import Array, FiniteMDP, policy_bisimulation_metric, policy_evaluation

FEW = settings(max_examples=30, deadline=None, derandomize=True)
MANY = settings(max_examples=80, deadline=None, derandomize=True)

ORDERS = st.sampled_from([1.0, 1.5, 2.0])
REWARD_WEIGHTS = st.sampled_from([0.3, 1.0, 2.0])
SPREADS = st.sampled_from([1.0, 4.0, -3.0])  # rewards are multiplied by it and shifted
TRANSITION_WEIGHTS = st.sampled_from([0.0, 0.3, 0.6, 0.9])
DISCOUNTS = st.sampled_from([0.0, 0.5, 0.9, 0.95])


@st.composite
def distributions(draw: st.DrawFn, rows: int, columns: int, point_masses: bool = False) -> Array:
    """Row-stochastic arrays with exact zeros, ties and rare events, or point masses only."""
    main = np.eye(columns)[draw(st.lists(st.integers(0, columns - 1), min_size=rows, max_size=rows))]
    if point_masses:
        return main
    entries = st.sampled_from([0.0, 0.0, 0.01, 0.3, 1.0])
    rest = np.reshape(draw(st.lists(entries, min_size=rows * columns, max_size=rows * columns)), (rows, columns))
    return (main + rest) / (main + rest).sum(axis=1, keepdims=True)


@st.composite
def mdps(
    draw: st.DrawFn, states: tuple[int, int] = (2, 4), actions: tuple[int, int] = (1, 3), deterministic: bool = False
) -> FiniteMDP:
    """MDPs with rewards in [0, 1]."""
    n_states, n_actions = draw(st.integers(*states)), draw(st.integers(*actions))
    transition = draw(distributions(n_states * n_actions, n_states, deterministic))
    rewards = st.one_of(st.sampled_from([0.0, 1.0]), st.floats(0.0, 1.0, width=16))
    reward = draw(st.lists(rewards, min_size=n_states * n_actions, max_size=n_states * n_actions))
    return FiniteMDP(transition.reshape(n_states, n_actions, n_states), np.reshape(reward, (n_states, n_actions)))


@st.composite
def mdps_with_policy(draw: st.DrawFn, deterministic: bool = False) -> tuple[FiniteMDP, Array]:
    """An MDP and a policy. Either both are deterministic or neither is."""
    mdp = draw(mdps(deterministic=deterministic))
    return mdp, draw(distributions(mdp.n_states, mdp.n_actions, deterministic))


def chain(transition: list[list[float]], reward: list[float]) -> tuple[FiniteMDP, Array]:
    """A Markov chain as an MDP with one action, and its only policy."""
    return FiniteMDP(np.array(transition)[:, None], np.array(reward)[:, None]), np.ones((len(reward), 1))


# Two states with reward 0. One leads to reward 0 for ever, the other to reward 1.
FORK = chain([[0, 0, 1, 0], [0, 0, 0, 1], [0, 0, 1, 0], [0, 0, 0, 1]], [0, 0, 0, 1])
BEFORE_FORK = [0.5, 0.5, 0.0, 0.0]
# Three states that never change. Each pair differs under one of three actions.
THREE_APART = FiniteMDP(np.repeat(np.eye(3)[:, None], 3, axis=1), np.eye(3))


@dataclass
class Setting:
    """A random MDP with policy and weights. The rewards have the span ``span`` and may lie outside of [0, 1]."""

    mdp: FiniteMDP
    policy: Array
    c_r: float
    c_t: float
    gamma: float
    p: float

    @property
    def span(self) -> float:
        return float(np.ptp(self.mdp.reward))

    @property
    def metric(self) -> Array:
        return policy_bisimulation_metric(self.mdp, self.policy, self.c_r, self.c_t, self.p)

    def values(self, gamma: float | None = None) -> Array:
        return policy_evaluation(self.mdp, self.policy, self.gamma if gamma is None else gamma)

    def reward_gap(self) -> Array:
        reward = self.mdp.under(self.policy).reward
        return np.abs(reward - reward.T)


@st.composite
def settings_of(draw: st.DrawFn, deterministic: bool = False) -> Setting:
    """Settings with rewards in [0, 1], [4, 8] or [-6, -3]."""
    mdp, policy = draw(mdps_with_policy(deterministic=deterministic))
    spread = draw(SPREADS)
    mdp = FiniteMDP(mdp.transition, spread * mdp.reward + spread)
    return Setting(mdp, policy, draw(REWARD_WEIGHTS), draw(TRANSITION_WEIGHTS), draw(DISCOUNTS), draw(ORDERS))
