"""Watch the embedding of noisy sparse cartpole form: `embedding` in TensorBoard's projector, `embedding/pca` among the images.
Afterwards, or meanwhile: tensorboard --logdir logs"""

import argparse

import gymnasium as gym

from sb3_robust_bisim import BisimSAC
from sb3_robust_bisim.callbacks import EmbeddingCallback

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=5000)
args = parser.parse_args()

model = BisimSAC(
    "MlpPolicy",
    gym.make("robust_bisim/SparseCartPole-v0", noise_multiplier=2),
    intrinsic_reward_scale=2.0,
    inverse_dynamics_coef=1.0,
    learning_rate=1e-3,
    learning_starts=args.steps // 10,
    tensorboard_log="logs",
    seed=0,
)
model.learn(args.steps, callback=EmbeddingCallback(every=max(args.steps // 5, 1)), progress_bar=True)
print("Now run: tensorboard --logdir logs")
