"""
How much of the true state does the embedding of an agent from pixels hold, in front of a clip that it has never seen?

    python benchmarks/state_probe.py logs/reproduce/dmc_pixels/video_*_seed0

All agents look at the same frames. In half of the environments actions are random; each of the others follows one agent and
takes three of ten actions at random. A small net then learns to predict the true state, as dm_control observes it, from each
agent's embeddings in front of the training clips. The table has its R² on frames with the held-out clip: 1 is perfect, 0 is no
better than the mean. The last line printed is one JSON object.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from _machine import machine
from rl_zoo3.utils import EnvironmentName
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecTransposeImage
from torch import nn
from torch.nn import functional as F
from tqdm import tqdm

from sb3_robust_bisim import BisimSAC
from sb3_robust_bisim.cli.agents import chosen_agent
from sb3_robust_bisim.runs.atomic import atomic_path

ROOT = Path(__file__).resolve().parent
RANDOM_ACTIONS = 0.3


def load(folder: Path, env_id: str) -> tuple[BisimSAC, dict[str, Any]]:
    """The agent at the end of the latest run in a folder, and the arguments of its environment."""
    which = dict(folder=str(folder), env=EnvironmentName(env_id), algo="bisim_sac", exp_id=0, gym_packages=[])
    agent = chosen_agent(argparse.Namespace(**which, load_best=False, load_checkpoint=None, load_last_checkpoint=False))
    return BisimSAC.load(agent.path, device="cpu", buffer_size=1), agent.env_kwargs


def true_state(env: Any) -> dict[str, float]:
    """What dm_control observes of a task from states, by name."""
    suite = env.unwrapped._env.unwrapped._env
    observed = suite.task.get_observation(suite.physics).items()
    return {f"{name} {i + 1}": float(value) for name, values in observed for i, value in enumerate(np.ravel(values))}


def collect(agents: list[BisimSAC], make: Any, steps: int, seed: int) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """
    :param make: of the number of environments and a seed
    :return: frames (N, C, H, W), true states (N, n), with 2 * steps for each agent, and the names of the n numbers
    """
    n = len(agents)
    venv: VecEnv = make(2 * n, seed)
    rng = np.random.default_rng(seed)
    obs = venv.reset()
    frames, states = [], []
    for _ in range(steps):
        frames.append(np.array(obs))
        states += [true_state(env) for env in venv.unwrapped.envs]  # type: ignore[attr-defined]
        actions = rng.uniform(-1, 1, (2 * n, *venv.action_space.shape)).astype(np.float32)  # type: ignore[misc]
        for i, agent in enumerate(agents):
            if rng.random() >= RANDOM_ACTIONS:
                actions[i] = agent.predict(np.asarray(obs)[i])[0]
        obs, *_ = venv.step(actions)
    venv.close()
    return np.concatenate(frames), np.array([list(state.values()) for state in states]), list(states[0])


@th.no_grad()
def embed(agent: BisimSAC, frames: np.ndarray) -> th.Tensor:
    encoder = agent.critic.features_extractor
    return th.cat([encoder(encoder.preprocess(th.as_tensor(part))) for part in np.array_split(frames, len(frames) // 256 + 1)])


def r2(train: tuple[th.Tensor, np.ndarray], test: tuple[th.Tensor, np.ndarray], updates: int, seed: int) -> np.ndarray:
    """:return: (n,) for each number of the state, of a net with two hidden layers of 128"""
    th.manual_seed(seed)
    (z, state), (test_z, test_state) = train, test
    (z_mean, z_std), (mean, std) = (z.mean(0), z.std(0) + 1e-6), (state.mean(0), state.std(0))
    z, wanted = (z - z_mean) / z_std, th.as_tensor((state - mean) / std, dtype=th.float32)
    net = nn.Sequential(
        *(nn.Linear(z.shape[1], 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU(), nn.Linear(128, wanted.shape[1]))
    )
    optimizer = th.optim.AdamW(net.parameters(), 1e-3, weight_decay=1e-2)
    for _ in range(updates):
        batch = th.randint(len(z), (256,))
        optimizer.zero_grad()
        F.mse_loss(net(z[batch]), wanted[batch]).backward()
        optimizer.step()
    with th.no_grad():
        error = net((test_z - z_mean) / z_std).numpy() * std + mean - test_state
    return 1 - (error**2).mean(axis=0) / test_state.var(axis=0)


def table(scores: dict[str, np.ndarray], names: list[str]) -> str:
    """Means over the repetitions, and the standard error of the mean over the state."""
    lines = [f"| agent | mean R² | {' | '.join(names)} |", "|---" * (len(names) + 2) + "|"]
    for name, values in sorted(scores.items(), key=lambda item: -item[1].mean()):
        means = values.mean(axis=1)
        error = f" ± {means.std(ddof=1) / np.sqrt(len(means)):.2f}" if len(means) > 1 else ""
        lines.append(f"| {name} | {means.mean():.2f}{error} | {' | '.join(f'{v:.2f}' for v in values.mean(axis=0))} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, help="folders of runs, as `robust-bisim train -f` writes them")
    parser.add_argument("--env", default="robust_bisim/cartpole-swingup-pixels-v0", help="task (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=400, help="of each environment, per repetition (default: %(default)s)")
    parser.add_argument("--updates", type=int, default=3000, help="of the net (default: %(default)s)")
    parser.add_argument("--repeats", type=int, default=3, help="with other frames and other nets (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "state_probe", help="folder (default: %(default)s)")
    args = parser.parse_args()
    names_of_folders = [folder.resolve().name for folder in args.folders]
    if len(set(names_of_folders)) < len(names_of_folders):
        parser.error(f"folders {' '.join(names_of_folders)}: two have the same name, which would be one row of the table")
    agents = {name: load(folder, args.env) for name, folder in zip(names_of_folders, args.folders, strict=True)}
    first = next(iter(agents.values()))[1]
    for name, (_, of_agent) in agents.items():
        if of_agent != first:
            parser.error(f"folder {name}: trained with {of_agent}, the first agent with {first}; compare agents of one task")
    env_kwargs = {**first, "distractor": "video"}

    def make(split: str) -> Any:
        def venv(n_envs: int, seed: int) -> VecEnv:
            one_frame = make_vec_env(args.env, n_envs, seed=seed, env_kwargs={**env_kwargs, "split": split})
            return VecTransposeImage(VecFrameStack(one_frame, 3))

        return venv

    names: list[str] = []
    models = [model for model, _ in agents.values()]
    scores: dict[str, list[np.ndarray]] = {name: [] for name in agents}
    for seed in tqdm(range(args.repeats), unit="repetition"):
        frames, states, names = collect(models, make("train"), args.steps, seed)
        test_frames, test_states, _ = collect(models, make("eval"), args.steps // 2, 1000 + seed)
        for name, model in zip(agents, models, strict=True):
            train, test = (embed(model, frames), states), (embed(model, test_frames), test_states)
            scores[name].append(r2(train, test, args.updates, seed))
    text = table({name: np.array(values) for name, values in scores.items()}, names)
    settings = {name: getattr(args, name) for name in ("env", "steps", "updates", "repeats")}
    result = {
        **machine(),
        **settings,
        "state": names,
        "r2": {name: np.array(values).round(3).tolist() for name, values in scores.items()},
    }
    args.out.mkdir(parents=True, exist_ok=True)
    for file, content in ((args.out / "table.md", text), (args.out / "state_probe.json", json.dumps(result, indent=1) + "\n")):
        with atomic_path(file) as temporary:
            temporary.write_text(content)
    print(text)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
