"""The embedding in TensorBoard: projector and principal components."""

import numpy as np
import torch as th
import torch.nn.functional as F
from matplotlib.figure import Figure
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.logger import TensorBoardOutputFormat
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_robust_bisim.callbacks.diagnostic import DiagnosticCallback, embed, new_axes
from sb3_robust_bisim.frame_buffer import frames_per_observation, newest_frames


class EmbeddingCallback(DiagnosticCallback):
    """
    Shows the embedding in TensorBoard. The projector shows each state with its value and reward, and with its frame if the
    agent observes pixels. ``embedding/pca`` shows the plane of the two largest principal components, coloured by value.

    The states are sampled from the replay buffer, with replacement. Their value is min_k Q_k(s, mean action).

    The arguments are those of :class:`DiagnosticCallback`. From a buffer with fewer than ``n_states`` states, as many are
    drawn as it has.

    :raises ValueError: also at the start of training if there is no TensorBoard log

    Example::

        model = BisimSAC("MlpPolicy", "robust_bisim/SparseCartPole-v0", tensorboard_log="runs")
        model.learn(10_000, callback=EmbeddingCallback(every=2000))
    """

    def _prepare(self) -> None:
        if self._tensorboard() is None:
            raise ValueError(
                f"tensorboard_log={self.model.tensorboard_log!r}: EmbeddingCallback writes to TensorBoard. Pass "
                "tensorboard_log to the model (on the command line: --tensorboard-log), and install tensorboard."
            )

    def _tensorboard(self) -> TensorBoardOutputFormat | None:
        formats = self.logger.output_formats
        return next((output for output in formats if isinstance(output, TensorBoardOutputFormat)), None)

    def _measure(self) -> None:
        buffer = self.model.replay_buffer
        assert buffer is not None
        n_stored = buffer.size() * buffer.n_envs
        if isinstance(buffer, HerReplayBuffer):  # samples only from finished episodes
            n_stored = int(np.count_nonzero(buffer.ep_length))
        if n_stored < 2:
            return
        batch = buffer.sample(min(self.n_states, n_stored), env=self.model._vec_normalize_env)
        z, values = embed(self.model, batch.observations)
        output = self._tensorboard()
        assert output is not None
        output.writer.add_embedding(
            z,
            metadata=th.cat([values, batch.rewards], dim=1).tolist(),
            metadata_header=["value", "reward"],
            label_img=self._sprites(batch.observations),
            global_step=self.num_timesteps,
            tag="embedding",
        )
        self._record_figure("embedding/pca", _pca_figure(z, values))

    def _sprites(self, obs: PyTorchObs) -> th.Tensor | None:
        """The newest frame of each stack, (B, 3, H, W) in [0, 1]; None if there are no images."""
        if isinstance(obs, dict) or not is_image_space(self.model.observation_space):
            return None
        newest = newest_frames(obs, frames_per_observation(self.training_env))
        return (newest.float() / 255).clamp(0, 1)


def _pca_figure(z: th.Tensor, values: th.Tensor) -> Figure:
    """
    :param z: (B, n) embeddings
    :param values: (B, 1)
    """
    centred = (z - z.mean(dim=0)).cpu().double()
    centred = F.pad(centred, (0, max(0, 2 - z.shape[1])))  # an embedding of one number has no second component
    _, singular, directions = th.linalg.svd(centred, full_matrices=False)
    plane = centred @ directions[:2].T
    share = singular.square() / singular.square().sum().clamp(min=1e-30)
    figure, axes = new_axes()
    points = axes.scatter(plane[:, 0].numpy(), plane[:, 1].numpy(), c=values[:, 0].cpu().numpy(), s=9, cmap="viridis")
    figure.colorbar(points, ax=axes, label="value")
    axes.set(xlabel=f"1st component ({share[0]:.0%} of variance)", ylabel=f"2nd component ({share[1]:.0%})")
    return figure
