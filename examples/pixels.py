"""Learn cartpole swing-up from pixels in front of natural video: frame stacks, random shifts, a buffer that shares frames.
The default of 20,000 steps shows how it works; an agent that swings up takes more. Needs the extra `dmc` and OpenGL."""

import argparse

from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack

from sb3_robust_bisim import BisimSAC

TASK, N_STACK = "robust_bisim/cartpole-swingup-pixels-v0", 3

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=20_000)
args = parser.parse_args()


def make_env(n_envs: int, split: str) -> VecEnv:
    """Frames of 64 pixels in front of clips for training ("train") or of clips that are held out ("eval")."""
    env_kwargs = {"distractor": "video", "split": split, "size": 64}
    # one frame shows no velocity
    return VecFrameStack(make_vec_env(TASK, n_envs, seed=0, env_kwargs=env_kwargs), N_STACK)


# Self-prediction: dynamics and reward model shape the encoder. In front of video the full method has not helped yet
model = BisimSAC(
    "CnnPolicy",
    make_env(8, "train"),
    reward_range=(0, 4),  # four control steps per action, at most 1 each
    bisim_coef=0.0,
    norm_constraint=False,
    model_coef=100.0,
    reward_coef=10.0,
    random_shift=4,  # pixels
    learning_rate=1e-3,
    batch_size=128,
    learning_starts=args.steps // 20,
    gradient_steps=2,
    tau=0.02,
    ent_coef="auto_0.1",
    # images go to a FrameStackReplayBuffer, which stores each frame once
    buffer_size=args.steps,
    policy_kwargs={"features_extractor_kwargs": {"strides": (3, 2, 1)}},
    seed=0,
)
model.learn(args.steps, progress_bar=True)

mean, _ = evaluate_policy(model, make_env(1, "eval"), n_eval_episodes=1)
print(f"Return in front of a held-out clip: {mean:.0f} of 1000")
