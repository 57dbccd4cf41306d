"""The results of `evaluate`: one row for each distractor, as CSV, as a Markdown table and as a picture."""

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import bootstrap

from sb3_robust_bisim.cli.errors import UsageError
from sb3_robust_bisim.runs.atomic import atomic_path

COLUMNS = (
    *("distractor", "seen", "episodes", "mean", "low", "high", "std", "denoising_factor", "returns"),
    *("env", "env_kwargs", "seed", "agent", "settings"),
)
COLORS = {True: "tab:blue", False: "tab:orange"}
LABELS = {True: "seen in training", False: "not seen in training"}
NAN = float("nan")


@dataclass(frozen=True)
class Score:
    """
    What an agent reached under one distractor.

    :param distractor: its name
    :param seen: True if the agent was trained with it
    :param returns: returns of the episodes, at least one
    :param denoising_factor: in [-1, 1]; NaN if it does not exist
    :param env: id of the task
    :param env_kwargs: arguments of the environment, as JSON
    :param seed: seed of the first episode
    :param agent: file of the agent
    :param settings: fingerprint of everything that the numbers depend on
    """

    distractor: str
    seen: bool
    returns: tuple[float, ...]
    denoising_factor: float
    env: str
    env_kwargs: str
    seed: int
    agent: str
    settings: str

    @property
    def mean(self) -> float:
        return float(np.mean(self.returns))

    @property
    def std(self) -> float:
        """Standard deviation of the episodes (n - 1); NaN for a single one."""
        return float(np.std(self.returns, ddof=1)) if len(self.returns) > 1 else NAN

    @property
    def interval(self) -> tuple[float, float]:
        """95 % bootstrap interval (percentile) of the mean, always the same; NaN for a single episode."""
        if len(self.returns) < 2:
            return NAN, NAN
        found = bootstrap((self.returns,), np.mean, method="percentile", rng=np.random.default_rng(0)).confidence_interval
        return float(found.low), float(found.high)


def read_scores(path: Path) -> dict[str, Score]:
    """
    :param path: CSV file of :func:`write_scores`; it may be missing
    :return: its rows, by their settings
    :raises UsageError: if it is another file
    """
    if not path.exists():
        return {}
    with path.open(newline="") as file:
        rows = csv.DictReader(file)
        if tuple(rows.fieldnames or ()) != COLUMNS:
            raise UsageError(f"{path}: not a table of this command or of this version; pass another --out, or move the file")
        return {row["settings"]: _score(row) for row in rows}


def write_scores(path: Path, scores: Iterable[Score]) -> None:
    """
    :param path: CSV file
    :param scores: its rows
    """
    with atomic_path(path) as temporary, temporary.open("w", newline="") as file:
        table = csv.DictWriter(file, COLUMNS)
        table.writeheader()
        for score in scores:
            low, high = score.interval
            numbers = {"episodes": len(score.returns), "mean": score.mean, "low": low, "high": high, "std": score.std}
            returns = " ".join(map(repr, score.returns))
            table.writerow({**vars(score), **numbers, "returns": returns})


def markdown(scores: Sequence[Score]) -> str:
    """A Markdown table with one row for each score."""
    rows = [
        (
            "distractor",
            "seen in training",
            "mean return",
            "95 % interval",
            "standard deviation",
            "episodes",
            "denoising factor",
        ),
        ("---", "---", "---:", "---:", "---:", "---:", "---:"),
    ]
    for score in scores:
        low, high = score.interval
        rows.append(
            (
                *(score.distractor, "yes" if score.seen else "no", _number(score.mean)),
                "–" if math.isnan(low) else f"{_number(low)} to {_number(high)}",
                *(_number(score.std), str(len(score.returns)), _number(score.denoising_factor, 2)),
            )
        )
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def draw(path: Path, scores: Sequence[Score], title: str) -> None:
    """
    Draw a horizontal bar with its interval for each score.

    :param path: PNG file
    :param scores: from top to bottom
    :param title: title of the figure
    """
    longest = max(len(score.distractor) for score in scores)
    figure = Figure(figsize=(5.5 + 0.09 * longest, 1.6 + 0.32 * len(scores)), layout="constrained")
    axes = figure.subplots()
    for position, score in enumerate(scores):
        low, high = score.interval
        errors = None if math.isnan(low) else [[max(score.mean - low, 0)], [max(high - score.mean, 0)]]
        axes.barh(position, score.mean, color=COLORS[score.seen], xerr=errors, capsize=3, ecolor="0.2", height=0.7)
    for seen in sorted({score.seen for score in scores}, reverse=True):
        axes.barh(0, 0, color=COLORS[seen], label=LABELS[seen])
    axes.set_yticks(range(len(scores)), [score.distractor for score in scores])
    axes.invert_yaxis()
    axes.margins(y=0.02)
    axes.set_xlabel("return, mean and 95 % interval")
    figure.suptitle(title)
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png")


def _number(value: float, digits: int = 1) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f}"


def _score(row: dict[str, str]) -> Score:
    texts = {key: row[key] for key in ("distractor", "env", "env_kwargs", "agent", "settings")}
    returns = tuple(map(float, row["returns"].split()))
    return Score(
        seen=row["seen"] == "True",
        returns=returns,
        denoising_factor=float(row["denoising_factor"]),
        seed=int(row["seed"]),
        **texts,
    )
