from typing import Any

from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import RolloutReturn

from sb3_robust_bisim.runs.atomic import PathOrStream, atomic_save


class Interruptible(OffPolicyAlgorithm):
    """An off-policy algorithm that neither damages a file nor stores a wrong transition when it is interrupted."""

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        whole = False
        try:
            rollout = super().collect_rollouts(*args, **kwargs)
            whole = rollout.continue_training
            return rollout
        finally:
            if not whole:  # a callback has stopped it before the last step was stored: the next learn() begins new episodes
                self._last_obs = None
                if isinstance(self.replay_buffer, HerReplayBuffer):
                    self.replay_buffer.truncate_last_trajectory()

    def save(self, path: PathOrStream, *args: Any, **kwargs: Any) -> None:
        """Like SB3's ``save``; a file that existed before stays whole until the new one is."""
        with atomic_save(path, ".zip") as whole:
            super().save(whole, *args, **kwargs)

    def save_replay_buffer(self, path: PathOrStream) -> None:
        """Like SB3's ``save_replay_buffer``; a file that existed before stays whole until the new one is."""
        with atomic_save(path, ".pkl") as whole:
            super().save_replay_buffer(whole)
