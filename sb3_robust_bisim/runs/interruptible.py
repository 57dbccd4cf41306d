from pathlib import Path
from typing import Any

from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import MaybeCallback, RolloutReturn

from sb3_robust_bisim.runs.atomic import PathOrStream, atomic_save


class Interruptible(OffPolicyAlgorithm):
    """An off-policy algorithm that neither damages a file, nor stores a wrong transition, nor mixes logs when interrupted."""

    log_folder: str | None = None  # of the run, in tensorboard_log

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        custom = self._custom_logger
        if not reset_num_timesteps and not custom and self._logs_in(tb_log_name):
            # SB3 would go on in the newest folder of tensorboard_log, whichever run's it is
            self.set_logger(configure(self.log_folder, ["stdout", "tensorboard"] if self.verbose >= 1 else ["tensorboard"]))
        try:
            prepared = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        finally:
            self._custom_logger = custom
        self.log_folder = None if self.tensorboard_log is None else self.logger.get_dir()
        return prepared

    def _logs_in(self, tb_log_name: str) -> bool:
        """Whether the run's folder is there, and where this name would be logged."""
        if self.log_folder is None or self.tensorboard_log is None:
            return False
        folder = Path(self.log_folder)
        return folder.is_dir() and folder.parent == Path(self.tensorboard_log) and folder.name.startswith(f"{tb_log_name}_")

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
