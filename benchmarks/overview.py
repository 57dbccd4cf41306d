"""
One table of all methods on all tasks, from the results of `reproduce.py`: mean last return, standard error and runs. In front
of video, it is the mean of the final agent's 20 episodes with the held-out clip.

    python benchmarks/overview.py       # replaces the table in docs/choosing.md

Bold: the highest mean of a column, and every mean less than one of its own standard errors below it; none if that is a single
run.
"""

import argparse
import json
import re
from pathlib import Path

import numpy as np
from _figures import FIGURES

from sb3_robust_bisim.runs.atomic import atomic_path

RESULTS = Path(__file__).parent / "results"
ON_CARTPOLE = ("cartpole", "dbc_alt", "metric")
# Heading: panel, and the figures to look in
TASKS: dict[str, tuple[str, tuple[str, ...]]] = {
    "cartpole, N_m = 0": ("N_m=0", ON_CARTPOLE),
    "N_m = 2": ("N_m=2", ON_CARTPOLE),
    "N_m = 3": ("N_m=3", ON_CARTPOLE),
    "mountain car, N_m = 1": ("N_m=1", ("mountain_car",)),
    "mountain car, N_m = 2": ("N_m=2", ("mountain_car",)),
    "swingup_sparse, state": ("cartpole-swingup_sparse", ("dmc_state",)),
    "swingup_sparse, projected": ("cartpole-swingup_sparse", ("metric_control",)),
    "cheetah-run, state": ("cheetah-run", ("dmc_state",)),
    "cheetah-run, projected": ("cheetah-run", ("metric_control",)),
    "swingup, video": ("video", ("dmc_pixels",)),
}
METHODS = {  # in the figures: in the table
    "SAC": "SAC",
    "SAC-shift": "SAC with random shift",
    "DBC": "DBC",
    "DBC-shift": "DBC with random shift",
    "DBC-alt": "DBC-alt",
    "DBC-normed": "DBC-normed",
    "DBC-IR": "DBC-IR",
    "normed-ID": "normed-ID",
    "normed-IR": "normed-IR",
    "normed-IR-ID": "normed-IR-ID (full)",
    "IR-ID": "full without ball",
    "normed-IR-no-metric": "normed-IR without metric",
    "normed-IR-ID-no-metric": "full without metric",
    "self-prediction": "self-prediction",
    "self-prediction-shift": "self-prediction with random shift",
    "self-prediction-metric": "self-prediction with random shift and metric",
    "self-prediction-IR": "self-prediction with bonus",
    "full-MICo": "full with MICo's metric",
    "full-SimSR": "full with SimSR's metric",
    "full-RAP": "full with RAP's metric",
}


def last_returns(panel: str, figures: tuple[str, ...]) -> dict[str, list[float]]:
    """The last return of each run of a task by method."""
    found: dict[str, dict[int, float]] = {}
    for figure in figures:
        for path in sorted((RESULTS / figure).glob("*_seed*.json")):
            run = json.loads(path.read_text())
            if (run["panel"], run["steps"]) == (panel, FIGURES[figure].steps):
                returns = run.get("final_return_by_split", {}).get("eval", run["evaluations"][-1]["returns"])
                found.setdefault(run["method"], {})[run["seed"]] = float(np.mean(returns))
    return {method: list(seeds.values()) for method, seeds in found.items()}


def error(values: list[float]) -> float:
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0


def column(returns: dict[str, list[float]]) -> dict[str, str]:
    """The cells of a task."""
    best = max(returns, key=lambda method: np.mean(returns[method]), default="")
    cells = {}
    for method, values in returns.items():
        text = f"{round(np.mean(values))}" + (f" ± {error(values):.0f}" if len(values) > 1 else "")
        near = min(len(returns), len(returns[best])) > 1 and np.mean(values) + error(values) >= np.mean(returns[best])
        cells[method] = f"{f'**{text}**' if near else text} ({len(values)})".replace(" ", "\N{NO-BREAK SPACE}")
    return cells


def table() -> str:
    columns = {name: column(last_returns(*task)) for name, task in TASKS.items()}
    columns = {name: cells for name, cells in columns.items() if cells}
    rows = [f"| method | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|"]
    for method, name in METHODS.items():
        cells = [column.get(method, "") for column in columns.values()]
        if any(cells):
            rows.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(__file__).parents[1] / "docs" / "choosing.md"
    parser.add_argument("--page", type=Path, default=default, help="Markdown file with the table (default: %(default)s)")
    args = parser.parse_args()
    before, _, after = re.split(r"(?m)((?:^\| method .*\n)(?:^\|.*\n)*)", args.page.read_text(), maxsplit=1)
    with atomic_path(args.page) as temporary:
        temporary.write_text(before + table() + after)


if __name__ == "__main__":
    main()
