"""Give PPO the encoder of a trained BisimSAC agent, frozen. The agent is the one that comes with the package.
The task is cartpole with the standard reward; 8 of the 12 observed numbers are noise."""

import argparse
from importlib.resources import files

import gymnasium as gym
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_robust_bisim import PretrainedEncoder

# For an agent of your own: the folder that sb3_robust_bisim.export_agent(model, folder) has written
AGENT = str(files("sb3_robust_bisim") / "trained_agents" / "robust_bisim-SparseCartPole-v0")

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=20_000)
args = parser.parse_args()

env = Monitor(gym.make("robust_bisim/SparseCartPole-v0", noise_multiplier=2, theta_rew_fraction=1.0))
encoder = dict(features_extractor_class=PretrainedEncoder, features_extractor_kwargs=dict(path=AGENT, freeze=True))
ppo = PPO("MlpPolicy", env, n_steps=min(2048, args.steps), policy_kwargs=encoder, device="cpu", seed=0)
before, _ = evaluate_policy(ppo, env, n_eval_episodes=10)
ppo.learn(args.steps, progress_bar=True)
after, _ = evaluate_policy(ppo, env, n_eval_episodes=10)
print(f"Return before training: {before:.0f}, after: {after:.0f} of 200")
