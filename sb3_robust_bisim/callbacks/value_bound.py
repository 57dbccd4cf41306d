"""How often learned distances bound differences of value."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sb3_robust_bisim.callbacks.diagnostic import EnvironmentCallback, embed, new_axes
from sb3_robust_bisim.losses import pairwise_distance


class ValueBoundCallback(EnvironmentCallback):
    """
    Records how often learned distances bound differences of value. By thm:generalized-ct, the exact metric always does.

    The callback runs episodes of the current policy. The value of a state is the discounted return of the rest of its episode;
    after a time-out, the critic's value of the last state replaces the missing part. For every pair of states, the
    difference of their values is compared with the bound
    d / c_R + 2 (R_max - R_min) (gamma - c_T) / ((1 - gamma) (1 - c_T)), whose second term applies only if c_T < gamma.

    ``bisim/value_bound_violations`` is the fraction of pairs whose difference exceeds the bound. ``bisim/value_gap`` and
    ``bisim/value_bound`` are the means of both, and ``bisim/value_gap_against_bound`` is a scatter plot.

    The theorem is about expected returns, while a single return of a stochastic task varies. The returns do not include the
    intrinsic reward, while the metric was trained with it. The distance is the one that the metric loss trains. ``huber`` is
    averaged over coordinates and is not a metric, so it can violate the bound at any time.

    The arguments are those of :class:`EnvironmentCallback`. Complete episodes are run until there are ``n_states`` states. An
    environment given by ``env_id`` should have the rewards that the agent was trained with.

    :raises ValueError: also at the start of training if ``c_r=0`` or ``gamma=1``, because there is no bound then
    :raises ImportError: without the extra ``theory``

    Example::

        model = BisimSAC("MlpPolicy", "robust_bisim/SparseCartPole-v0", distance="l1")
        model.learn(10_000, callback=ValueBoundCallback(every=2000))
    """

    def _prepare(self) -> None:
        from sb3_robust_bisim.theory.bounds import value_difference_bound  # the only callback that needs the extra

        self._bound = value_difference_bound
        if self.model.c_r == 0 or self.model.gamma == 1:
            raise ValueError(f"c_r={self.model.c_r}, gamma={self.model.gamma}: a bound on values needs c_r > 0 and gamma < 1.")
        super()._prepare()

    def _measure(self) -> None:
        obs, returns = self._returns()
        keep = np.linspace(0, len(obs) - 1, self.n_states).astype(int)  # evenly from all episodes
        z, _ = embed(self.model, self._tensor([obs[i] for i in keep]))
        first, second = np.triu_indices(len(keep), 1)
        distance = pairwise_distance(z[first], z[second], self.model.distance).mean(dim=1).cpu().double().numpy()
        gap = np.abs(returns[keep][first] - returns[keep][second])
        objective = self.model.policy.objective
        r_min, r_max = objective.with_absorbing(self.model.reward_range)
        bound = self._bound(distance, self.model.c_r, objective.c_t, self.model.gamma, r_max - r_min)
        self.logger.record("bisim/value_bound_violations", float((gap > bound).mean()))
        self.logger.record("bisim/value_gap", float(gap.mean()))
        self.logger.record("bisim/value_bound", float(bound.mean()))
        self._record_figure("bisim/value_gap_against_bound", _bound_figure(bound, gap))

    def _returns(self) -> tuple[list[Any], np.ndarray]:
        """Observations of complete episodes, and the discounted return after each of them."""
        observations: list[Any] = []
        returns: list[float] = []
        rewards: list[float] = []
        for step in self._walk():
            observations.append(step.obs)
            rewards.append(step.reward)
            if step.done:
                value = self._value(step.info["terminal_observation"]) if step.info["TimeLimit.truncated"] else 0.0
                episode = []
                for reward in reversed(rewards):
                    value = reward + self.model.gamma * value
                    episode.append(value)
                returns += reversed(episode)
                rewards = []
                if len(returns) >= self.n_states:
                    break
        return observations, np.array(returns)

    def _value(self, obs: Any) -> float:
        row = {key: value[None] for key, value in obs.items()} if isinstance(obs, dict) else obs[None]
        return embed(self.model, self._tensor([row]))[1].item()


def _bound_figure(bound: np.ndarray, gap: np.ndarray) -> Figure:
    """
    :param bound: one entry per pair of states, likewise ``gap``
    """
    figure, axes = new_axes()
    shown = np.linspace(0, len(gap) - 1, min(len(gap), 5000)).astype(int)
    axes.scatter(bound[shown], gap[shown], s=4, alpha=0.3)
    largest = float(max(bound.max(), gap.max()))
    axes.plot([0, largest], [0, largest], color="black", linewidth=1, label="bound (above: broken)")
    axes.set(xlabel="bound from the learned distance", ylabel="observed gap of values")
    axes.legend()
    return figure
