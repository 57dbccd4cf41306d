"""
Does the embedding learn the metric that the theory is about?

BisimSAC's encoder, models, optimizer and representation losses (metric, dynamics, reward, optionally inverse dynamics;
no critic, no actor: the policy is fixed) on random finite MDPs, whose exact d_pi is known. Each arm reports how the learned
distances of all pairs of states compare with it. The last line printed is one JSON object.

deterministic: every state has one successor. stochastic: two to four. equal rewards: d_pi = 0, so the metric asks for
collapse, and two actions lead to different states, so the inverse-dynamics head asks for the opposite. terminating:
deterministic, and a quarter of the states end the episode; the end counts as a state without reward.
Observations are one-hot, or one-hot with as many numbers of fresh Gaussian noise of standard deviation 1 appended.
Each arm and seed writes one file when it ends, and is not run again when it has one.
"""

import argparse
import csv
import json
import os
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium as gym
import numpy as np
import torch as th
from _machine import machine
from matplotlib.figure import Figure
from scipy.stats import spearmanr
from tqdm import tqdm

from sb3_robust_bisim import BisimSAC
from sb3_robust_bisim.losses import on_surface, pairwise_distance
from sb3_robust_bisim.representation import Batch
from sb3_robust_bisim.runs.atomic import atomic_path
from sb3_robust_bisim.theory import FiniteMDP, mico_distance, policy_bisimulation_metric

ROOT = Path(__file__).parent
N_STATES, C_R, C_T = 16, 1.0, 0.8
NOISE_MULTIPLIER = 1
BATCH_SIZE = 128
MICO = {"successors": "sample", "target_encoder": "both", "loss": "huber", "pairs": "all"}
ACTIONS = np.array([[-1.0], [1.0]], dtype=np.float32)


@dataclass(frozen=True)
class Arm:
    """
    One thing to be trained.

    :param mdp: "deterministic", "stochastic", "terminating" or "equal rewards"
    :param noise: whether noise is appended to the observations
    :param distance: as BisimSAC's
    :param ball: as BisimSAC's ``norm_constraint``
    :param dynamics: as BisimSAC's
    :param inverse_dynamics_coef: as BisimSAC's
    :param reward_max: rewards lie in [0, reward_max], which sets the radius of the ball too
    :param nll_beta: as BisimSAC's
    :param absorbing: as Metric's
    """

    mdp: str
    noise: bool
    distance: str
    ball: bool
    dynamics: str = "deterministic"
    inverse_dynamics_coef: float = 0.0
    reward_max: float = 4.0
    nll_beta: float = 0.0
    absorbing: bool = False

    @property
    def metric_kwargs(self) -> dict:
        """MICo takes its successors from the samples, as the paper does; here there is no target encoder."""
        return {"absorbing": self.absorbing, **(MICO if self.distance == "mico" else {})}

    @property
    def wasserstein_order(self) -> float:
        """p of the metric that is aimed at: a Gaussian model is compared by its 2-Wasserstein distance."""
        return 1.0 if self.dynamics == "deterministic" else 2.0

    @property
    def name(self) -> str:
        """For titles and keys."""
        observations = "noise-padded" if self.noise else "one-hot"
        parts = [self.mdp, observations, self.distance, "ball" if self.ball else "no ball"]
        parts += [self.dynamics] if self.dynamics != "deterministic" else []
        parts += [f"beta {self.nll_beta}"] if self.nll_beta else []
        parts += ["absorbing"] if self.absorbing else []
        parts += ["rewards in [0, 1]"] if self.reward_max == 1 else []
        if self.mdp == "equal rewards":
            parts.append("inverse dynamics" if self.inverse_dynamics_coef else "no inverse dynamics")
        return ", ".join(parts)


def arms() -> list[Arm]:
    deterministic = [
        *(
            Arm("deterministic", noise, distance, ball)
            for noise in (False, True)
            for distance in ("l1", "l2", "huber")
            for ball in (True, False)
        ),
        *(
            Arm("deterministic", False, distance, ball, reward_max=1.0)
            for distance in ("l2", "huber")
            for ball in (True, False)
        ),
    ]
    stochastic = [
        *(Arm("stochastic", False, distance, True) for distance in ("l1", "l2")),
        *(Arm("stochastic", noise, "l2", True, "probabilistic") for noise in (False, True)),
    ]
    gaussian = [Arm("stochastic", False, "l2", True, "probabilistic", nll_beta=beta) for beta in (0.5, 1.0)]
    ends = [Arm("terminating", False, "l2", True, absorbing=absorbing) for absorbing in (False, True)]
    mico = [Arm("stochastic", False, "mico", False)]
    collapse = [Arm("equal rewards", False, "l2", True, inverse_dynamics_coef=coef) for coef in (0.0, 1.0)]
    return deterministic + stochastic + gaussian + ends + mico + collapse


def random_mdp(kind: str, reward_max: float, rng: np.random.Generator) -> tuple[FiniteMDP, np.ndarray]:
    """
    :return: the MDP and the policy. Rewards belong to states, uniform in [0, reward_max]. The policy takes action 1
        everywhere, but with equal rewards it is uniform over both actions
    """
    transition = np.zeros((N_STATES, 2, N_STATES))
    for state in range(N_STATES):
        if kind == "stochastic":
            successors = rng.choice(N_STATES, rng.integers(2, 5), replace=False)
            transition[state][:, successors] = rng.dirichlet(np.ones(len(successors)))
        else:
            transition[state, [0, 1], rng.choice(N_STATES, 2, replace=False)] = 1.0
    if kind == "terminating":
        transition[-1] = np.eye(N_STATES)[-1]  # the end, which several states lead to
        transition[: N_STATES // 4, 1] = np.eye(N_STATES)[-1]
    rewards = reward_max * (np.full(N_STATES, 0.5) if kind == "equal rewards" else rng.random(N_STATES))
    if kind == "terminating":
        rewards[-1] = 0.0
    policy = [0.5, 0.5] if kind == "equal rewards" else [0.0, 1.0]
    return FiniteMDP(transition, np.tile(rewards[:, None], 2)), np.tile(policy, (N_STATES, 1))


class Observations:
    """
    What the agent sees of a state.

    :param noise: whether noise is appended
    """

    def __init__(self, noise: bool, rng: np.random.Generator) -> None:
        self.n_noise = NOISE_MULTIPLIER * N_STATES if noise else 0
        self.rng = rng
        self.space = gym.spaces.Box(-np.inf, np.inf, (N_STATES + self.n_noise,), np.float32)

    def __call__(self, states: np.ndarray) -> th.Tensor:
        noise = self.rng.standard_normal((len(states), self.n_noise), dtype=np.float32)
        return th.as_tensor(np.concatenate([np.eye(N_STATES, dtype=np.float32)[states], noise], axis=1))


class Spaces(gym.Env):
    """BisimSAC asks for an environment; this one only has spaces."""

    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, observation_space: gym.spaces.Box) -> None:
        self.observation_space = observation_space


@th.no_grad()
def learned_distances(model: BisimSAC, observe: Observations, draws: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """
    Distances between all states, averaged over draws of the noise, elementwise distances averaged over coordinates.

    :return: (S, S) and the (draws, S, n) embeddings
    """
    z = th.stack([model.critic.features_extractor.encode(observe(np.arange(N_STATES))) for _ in range(2 * draws)])
    rows, columns = th.broadcast_tensors(z[:draws, :, None], z[draws:, None])
    distances = pairwise_distance(rows, columns, model.distance).mean(dim=(0, -1))
    return distances.numpy(), z.numpy()


def build(arm: Arm, observe: Observations, seed: int) -> BisimSAC:
    """BisimSAC, of which only the representation is used."""
    return BisimSAC(
        "MlpPolicy",
        Spaces(observe.space),
        seed=seed,
        device="cpu",
        learning_rate=1e-3,
        buffer_size=1,
        c_r=C_R,
        c_t=C_T,
        reward_range=(0.0, arm.reward_max),
        norm_constraint=arm.ball,
        distance=arm.distance,
        dynamics=arm.dynamics,
        nll_beta=arm.nll_beta,
        metric_kwargs=arm.metric_kwargs,
        inverse_dynamics_coef=arm.inverse_dynamics_coef,
    )


def train(arm: Arm, seed: int, steps: int, path: Path) -> dict:
    """Train one arm and compare, or read its file if there is one of the same settings."""
    key = {"arm": asdict(arm), "seed": seed, "steps": steps, "c_r": C_R, "c_t": C_T, "n_states": N_STATES}
    finished = json.loads(path.read_text()) if path.exists() else {"arm": {}}
    if finished["arm"] and finished.items() >= {**key, "arm": finished["arm"]}.items() and Arm(**finished["arm"]) == arm:
        return finished
    rng, started = np.random.default_rng(seed), time.process_time()
    mdp, policy = random_mdp(arm.mdp, arm.reward_max, rng)
    observe = Observations(arm.noise, rng)
    model = build(arm, observe, seed)
    optimizers = [model.critic.optimizer, model.policy.representation.inverse_dynamics.optimizer]
    schedule = th.optim.lr_scheduler.CosineAnnealingLR(optimizers[0], steps, eta_min=1e-5)
    at_start, _ = learned_distances(model, observe)
    cumulative = mdp.transition.cumsum(axis=-1)
    for _ in range(steps):
        # an agent never acts in a terminal state
        states = rng.integers(N_STATES - (arm.mdp == "terminating"), size=BATCH_SIZE)
        actions = (rng.random(BATCH_SIZE) > policy[states, 0]).astype(int)
        next_states = (cumulative[states, actions] < rng.random((BATCH_SIZE, 1))).sum(axis=1).clip(max=N_STATES - 1)
        rewards = th.as_tensor(mdp.reward[states, actions][:, None], dtype=th.float32)
        encode = model.critic.features_extractor.encode
        z, next_z = encode(observe(states)), encode(observe(next_states))
        ends = (next_states == N_STATES - 1) & (arm.mdp == "terminating")
        dones = th.as_tensor(ends[:, None], dtype=th.float32)
        batch = Batch(z, th.as_tensor(ACTIONS[actions]), rewards, dones, next_z, next_z.detach(), z.detach())
        loss, terms = model.policy.representation.losses(batch)
        for optimizer in optimizers:
            optimizer.zero_grad()
        loss.backward()
        for optimizer in optimizers:
            optimizer.step()
        schedule.step()
    learned, embeddings = learned_distances(model, observe)
    if arm.distance == "mico":
        exact = mico_distance(mdp, policy, C_R, C_T)
    else:
        exact = policy_bisimulation_metric(mdp, policy, C_R, C_T, p=arm.wasserstein_order)
    norms = np.linalg.norm(embeddings, axis=-1)
    run = {
        **key,
        **compare(exact, learned),
        "mean_distance_at_start": float(at_start[~np.eye(N_STATES, dtype=bool)].mean()),
        "centre_norm": float(np.linalg.norm(embeddings.mean(axis=(0, 1)))),
        "largest_norm": float(norms.max()),
        "radius": model.radius,
        "clamp_fraction": float(on_surface(norms, model.radius).mean()) if model.radius is not None else None,
        "losses": {name: float(value.detach().mean()) for name, value in terms.items()},
        "cpu_seconds": round(time.process_time() - started, 1),
        **machine(),
        "exact": exact.tolist(),
        "learned": learned.tolist(),
    }
    if arm.mdp == "deterministic" and arm.distance == "huber":
        target = huberised(mdp)
        run["huberised"] = {"distances": target.tolist(), **compare(target, learned)}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(run))
    return run


def compare(exact: np.ndarray, learned: np.ndarray) -> dict:
    """Learned distances of all pairs beside the exact ones; where these are 0 only the means say something."""
    pairs = np.triu_indices(N_STATES, 1)
    x, y = exact[pairs], learned[pairs]
    result = {"mean_exact": x.mean(), "mean_learned": y.mean(), "mean_self_distance": np.diag(learned).mean()}
    if x.min() > 0:
        error = np.abs(y - x) / x
        result |= {"spearman": spearmanr(x, y).statistic, "median_relative_error": np.median(error)}
        result |= {"90th_percentile_relative_error": np.quantile(error, 0.9)}
    return {name: round(float(value), 4) for name, value in result.items()}


def huberised(mdp: FiniteMDP) -> np.ndarray:
    """The fixed point that the elementwise Huber aims at on a deterministic chain: d_pi of Huber's reward gaps."""
    successors, rewards = mdp.transition[:, 1].argmax(axis=-1), mdp.reward[:, 1]
    gap = np.abs(rewards[:, None] - rewards)
    gap = np.where(gap < 1, 0.5 * gap**2, gap - 0.5)
    distance = np.zeros_like(gap)
    for _ in range(1000):
        distance = C_R * gap + C_T * distance[np.ix_(successors, successors)]
    return distance


def plot(runs: list[dict], path: Path) -> None:
    """Learned against exact distances, one panel per arm but for the collapse."""
    shown = [arm for arm in arms() if arm.mdp != "equal rewards"]
    figure = Figure(figsize=(16, 15.5), layout="constrained")
    for axes, arm in zip(figure.subplots(5, 5).flat, shown, strict=False):
        pairs = np.triu_indices(N_STATES, 1)
        largest = 0.0
        for run in (run for run in runs if Arm(**run["arm"]) == arm):
            exact, learned = np.array(run["exact"])[pairs], np.array(run["learned"])[pairs]
            largest = max(largest, exact.max())
            axes.plot(
                exact,
                learned,
                ".",
                alpha=0.6,
                label=f"seed {run['seed']}: {run['spearman']:.2f}, {run['median_relative_error']:.0%}",
            )
        axes.plot([0, largest], [0, largest], color="black", linewidth=1)
        axes.set_title(arm.name.replace(", ", ",\n", 1), fontsize=10)
        axes.legend(fontsize=8, loc="upper left")
    for axes in figure.axes[len(shown) :]:
        axes.remove()
    figure.supxlabel("exact $d_\\pi$")
    figure.supylabel("learned distance (Huber: mean over coordinates)")
    figure.suptitle(
        "Learned against exact distances of all pairs of states; legend: Spearman correlation, median relative error"
    )
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=80, format="png")


def write_csv(runs: list[dict], path: Path) -> None:
    with atomic_path(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["arm", "seed", "state_i", "state_j", "exact", "learned"])
        for run in runs:
            for i, j in zip(*np.triu_indices(N_STATES, 1), strict=True):
                row = (run["exact"][i][j], run["learned"][i][j])
                writer.writerow([Arm(**run["arm"]).name, run["seed"], i, j, *(f"{value:.6g}" for value in row)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1], help="of MDP and model (default: %(default)s)")
    parser.add_argument(
        "--steps", type=int, default=4000, help="gradient steps, twice as many with noise (default: %(default)s)"
    )
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="arms whose name holds one of these texts")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "metric_exactness")
    args = parser.parse_args()
    th.set_num_threads(1)
    if args.out == parser.get_default("out"):
        for option in ("seeds", "steps", "only"):
            if getattr(args, option) != parser.get_default(option):
                parser.error(f"--{option}: name another folder with --out, because {args.out} has the published results.")
    wanted = [arm for arm in arms() if any(text in arm.name for text in args.only)]
    todo = [(arm, seed) for seed in args.seeds for arm in wanted]
    runs = []
    for arm, seed in tqdm(todo, unit="arm", file=sys.stderr):
        name = arm.name.replace(", ", "_").replace(" ", "-").replace("[0_1]", "0-1")
        steps = args.steps * (2 if arm.noise else 1)
        runs.append(train(arm, seed, steps, args.out / "runs" / f"{name}_seed{seed}.json"))
    plot(runs, args.out / "learned_against_exact.png")
    write_csv(runs, args.out / "distances.csv")
    hidden = ("arm", "exact", "learned", "huberised", "losses", *machine())
    results: dict[str, list[dict]] = {}
    for run in runs:
        shown = {key: value for key, value in run.items() if key not in (*hidden, "steps", "c_r", "c_t", "n_states")}
        if "huberised" in run:
            shown["against_huberised"] = {key: value for key, value in run["huberised"].items() if key != "distances"}
        results.setdefault(Arm(**run["arm"]).name, []).append(shown)
    settings = {"steps": args.steps, "n_states": N_STATES, "c_r": C_R, "c_t": C_T}
    summary = {"benchmark": "metric_exactness", **settings, **machine(), "arms": results}
    with atomic_path(args.out / "summary.json") as temporary:
        temporary.write_text(json.dumps(summary, indent=1))
    print(json.dumps(summary))


if __name__ == "__main__":
    main()
