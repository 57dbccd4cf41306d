"""Play a trained agent under distractors that it has or has not seen: `robust-bisim evaluate`."""

import argparse
import hashlib
import json
from contextlib import closing
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any

from rl_zoo3 import ALGOS
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import set_random_seed
from tqdm import tqdm

from sb3_robust_bisim.bisim_sac import BisimSAC
from sb3_robust_bisim.callbacks import DenoisingFactorCallback
from sb3_robust_bisim.cli.agents import Agent, add_agent_arguments, chosen_agent
from sb3_robust_bisim.cli.distractors import Distractors, distractors_of
from sb3_robust_bisim.cli.record import record_or_explain
from sb3_robust_bisim.cli.scores import NAN, Score, draw, markdown, read_scores, write_scores
from sb3_robust_bisim.runs.atomic import atomic_path

CSV = "evaluation.csv"
DESCRIPTION = (
    "Play a trained agent under a list of distractors. The environment is that of the training; only the distractor differs. "
    "Writes evaluation.csv, evaluation.md, evaluation.png, and a video of the best and of the worst distractor. Rows that the "
    "CSV file has already, for the same agent and settings, are not played again."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command to those that all commands have."""
    add_agent_arguments(parser)  # all distractors have the same start states, those of --seed
    parser.add_argument(
        "--distractors",
        nargs="+",
        metavar="NAME",
        help='distractors to play, "+" combines them, for example: clean video-heldout video-heldout+camera-easy. An unknown '
        "name shows all names for the task (default: a list for the task)",
    )
    parser.add_argument("--n-episodes", type=int, default=10, metavar="N", help="episodes for each (default: %(default)s)")
    parser.add_argument(
        "--n-states", type=int, default=125, metavar="N", help="states for the denoising factor (default: %(default)s)"
    )
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="folder for the results (default: `evaluation` in the run)")
    parser.add_argument("--no-video", action="store_true", help="record no videos")


def check_arguments(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Stop with a message for a number or a folder that cannot be used."""
    for name, lowest in (("n_episodes", 1), ("n_states", 2), ("seed", 0)):
        if (value := getattr(args, name)) < lowest:
            parser.error(f"--{name.replace('_', '-')} {value}: must be at least {lowest}.")
    if args.algo not in ALGOS:
        parser.error(f"--algo {args.algo}: must be one of {', '.join(ALGOS)}.")
    if args.out is not None and args.out.exists() and not args.out.is_dir():
        parser.error(f"--out {args.out}: this is a file; name a folder.")


def evaluate(args: argparse.Namespace) -> None:
    """
    Run the command.

    :param args: see :func:`add_arguments`, and ``algo``
    :raises UsageError: if there is no such agent, or for a distractor that does not exist or does not fit the task
    """
    agent = chosen_agent(args)
    distractors = distractors_of(agent.env_id, agent.env_kwargs, args.env_kwargs)
    chosen = _chosen(distractors, args.distractors)
    out = args.out or agent.path.parent / "evaluation"
    done = read_scores(out / CSV)
    with closing(agent.make_env(next(iter(chosen.values())), args.seed)) as venv:
        model = agent.load(venv, args.device)

    files = _hashes(agent)
    settings = {name: _settings(files, agent.env_id, env_kwargs, args) for name, env_kwargs in chosen.items()}
    to_play: dict[str, str] = {}  # two names may mean the same
    for name in chosen:
        if settings[name] not in done:
            to_play.setdefault(settings[name], name)
    n_done = sum(setting in done for setting in settings.values())
    print(f"Agent: {agent.path}\nDistractors to play: {len(to_play)}. Already in {out / CSV}: {n_done}.")
    with tqdm(total=len(to_play) * args.n_episodes, unit="episode", disable=None) as bar:
        for name in to_play.values():
            bar.set_description(name)
            returns, factor = _play(model, agent, distractors, chosen[name], args, bar)
            about = (agent.env_id, _json(chosen[name]), args.seed, str(agent.path), settings[name])
            done[settings[name]] = Score(name, distractors.seen(chosen[name]), returns, factor, *about)
            write_scores(out / CSV, done.values())  # after each, so that an interruption loses little

    scores = [replace(done[settings[name]], distractor=name) for name in chosen]
    title = f"{agent.env_id}, episodes for each distractor: {args.n_episodes}"
    draw(out / "evaluation.png", scores, title)
    text = f"# {title}\n\nAgent: `{agent.path}`\n\n{markdown(scores)}\n\n"
    by_mean = attrgetter("mean")
    for end, score in (("Best", max(scores, key=by_mean)), ("Worst", min(scores, key=by_mean))):
        video = "" if args.no_video else f" {_video(model, agent, chosen[score.distractor], score, out)}"
        text += f"{end}: {score.distractor}, {score.mean:.1f}.{video}\n\n"
    with atomic_path(out / "evaluation.md") as temporary:
        temporary.write_text(f"{text}![](evaluation.png)\n")
    print(f"\n{text}Written: {out / CSV}, {out / 'evaluation.md'}, {out / 'evaluation.png'}")


def _chosen(distractors: Distractors, names: list[str] | None) -> dict[str, dict[str, Any]]:
    """The distractors to play and their environments' arguments; by default, those that fit the task, each once."""
    if names is not None:
        return {name: distractors.env_kwargs(name) for name in names}
    chosen: dict[str, dict[str, Any]] = {}
    for name in distractors.suggested:
        try:
            env_kwargs = distractors.env_kwargs(name)
        except ValueError as error:  # such as no held-out clip
            print(f"Left out: {error}")
            continue
        if env_kwargs not in chosen.values():
            chosen[name] = env_kwargs
    return chosen


def _play(
    model: BaseAlgorithm,
    agent: Agent,
    distractors: Distractors,
    env_kwargs: dict[str, Any],
    args: argparse.Namespace,
    bar: tqdm,
) -> tuple[tuple[float, ...], float]:
    """The returns of the episodes, and the denoising factor or NaN."""

    def advance(variables: dict[str, Any], _: dict[str, Any]) -> None:
        bar.update(int(variables["done"]))

    set_random_seed(args.seed)
    with closing(agent.make_env(env_kwargs, args.seed)) as venv:
        model.set_env(venv)
        returns, _ = evaluate_policy(model, venv, args.n_episodes, callback=advance, return_episode_rewards=True)
        factor = NAN
        # the callback cannot copy other wrappers
        if isinstance(model, BisimSAC) and distractors.distracts(env_kwargs) and "env_wrapper" not in agent.hyperparams:
            look = DenoisingFactorCallback(n_states=args.n_states, seed=args.seed)
            factor = look.factor_of(model)
    return tuple(map(float, returns)), factor  # type: ignore[arg-type]


def _video(model: BaseAlgorithm, agent: Agent, env_kwargs: dict[str, Any], score: Score, out: Path) -> str:
    """A link to a video of the first episode; or the reason why there is none."""
    folder = Path("videos", f"{score.distractor}-{score.settings[:8]}")  # one for each agent and its settings
    video = folder / "agent.mp4"
    if not (out / video).exists():
        rendered = {**env_kwargs, "render_mode": "rgb_array"}
        found = record_or_explain(model, lambda: agent.make_env(rendered, score.seed), out / folder)
        if not (out / video).exists():
            return f"Video: {found}."
    return f"Video: [{video}](<{video}>)."


def _hashes(agent: Agent) -> list[str]:
    """Of the agent's file and of VecNormalize's statistics, if there are any."""
    files = (agent.path, Path(agent.stats or agent.path.parent, "vecnormalize.pkl"))
    return [hashlib.sha256(file.read_bytes()).hexdigest() for file in files if file.is_file()]


def _settings(files: list[str], env_id: str, env_kwargs: dict[str, Any], args: argparse.Namespace) -> str:
    """Fingerprint of what the numbers depend on, except for the content of the user's clips."""
    everything = [*files, env_id, env_kwargs, args.seed, args.n_episodes, args.n_states]
    return hashlib.sha256(_json(everything).encode()).hexdigest()[:16]


def _json(value: Any) -> str:
    return json.dumps(value, default=str, sort_keys=True)
