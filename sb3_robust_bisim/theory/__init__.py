"""Finite Markov decision processes, their exact bisimulation metrics and the paper's bounds. Needs the extra ``theory``."""

from sb3_robust_bisim.theory.finite_mdp import (
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

__all__ = [
    "Array",
    "FiniteMDP",
    "aggregate",
    "bisimulation_metric",
    "distance_moments",
    "mico_distance",
    "policy_bisimulation_metric",
    "policy_evaluation",
    "stationary_distribution",
    "wasserstein_distance",
]
