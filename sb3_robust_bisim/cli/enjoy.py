"""What `enjoy` has in addition to rl-zoo3's: videos, and the trained agents that come with the package."""

import argparse
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from rl_zoo3.utils import EnvironmentName
from stable_baselines3.common.utils import set_random_seed

from sb3_robust_bisim.cli.agents import chosen_agent
from sb3_robust_bisim.cli.record import play, write_video
from sb3_robust_bisim.export import load_agent

TRAINED = Path(__file__).parents[1] / "trained_agents"


def record_episode(args: argparse.Namespace) -> str:
    """
    Write a video of one episode of the deterministic policy.

    :param args: see :func:`~sb3_robust_bisim.cli.agents.add_agent_arguments`; also ``algo``, ``trained``, and ``video``, the
        file
    :return: the agent, the return and the file, for the user
    :raises ValueError: if there is no such agent, or if the task renders no frames
    """
    agent = chosen_agent(args)
    set_random_seed(args.seed)
    with closing(agent.make_env({**agent.env_kwargs, **args.env_kwargs, "render_mode": "rgb_array"}, args.seed)) as venv:
        model = agent.load(venv, args.device)
        venv.seed(args.seed)  # loading has set the seed of the training
        episode = play(model, venv)
    write_video(args.video, episode.shown, episode.fps)
    name = "the one that comes with the package" if args.trained else agent.path
    return f"Agent: {name}\nEpisode: {len(episode.shown)} steps, return {episode.total_reward:.2f}\nVideo: {args.video}"


def trained_tasks() -> list[str]:
    """The ids of the tasks with a trained agent. Folders have a "-" in place of "/"."""
    return sorted(path.parent.name.replace("-", "/", 1) for path in TRAINED.glob("*/config.json"))


@contextmanager
def trained_run(algo: str, env: EnvironmentName) -> Iterator[str]:
    """
    Unpack a trained agent to where the commands look for runs. They then treat it like any other.

    :param algo: name of BisimSAC
    :param env: one of :func:`trained_tasks`
    :return: a folder with one run, which exists until the block ends
    """
    source = TRAINED / env
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder, algo, f"{env}_1")
        (run / env).mkdir(parents=True)
        load_agent(source, device="cpu").save(run / f"{env}.zip")
        shutil.copy(source / "task.yml", run / env / "config.yml")
        yield folder
