"""The report at the end of a run: the learning curve, and the first, best and last evaluation."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from sb3_robust_bisim.runs.atomic import atomic_path


def report(run: Path, title: str, learning_starts: int) -> None:
    """
    Draw the learning curve of a run and print its first, best and last evaluation.

    :param run: folder with the ``evaluations.npz`` of SB3's EvalCallback; without that file, a message says so
    :param title: title of the figure
    :param learning_starts: step of the first update; -1 if the agent was trained before the run
    """
    if not (run / "evaluations.npz").exists():
        print("No learning curve without evaluations: --eval-freq is larger than the number of steps, or below 1.")
        return
    with np.load(run / "evaluations.npz") as evaluations:
        steps, returns = evaluations["timesteps"], evaluations["results"]
    episodes = returns.shape[1]
    mean, standard_error = returns.mean(axis=1), returns.std(axis=1, ddof=min(1, episodes - 1)) / np.sqrt(episodes)
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.subplots()
    axes.plot(steps, mean, marker=".")
    axes.fill_between(steps, mean - standard_error, mean + standard_error, alpha=0.25)
    axes.set(title=title, xlabel="environment steps", ylabel=f"evaluation return, mean of {episodes} episodes")
    axes.grid(alpha=0.3)
    with atomic_path(run / "learning_curve.png") as temporary:
        figure.savefig(temporary, dpi=120, format="png")
    print(f"Evaluation return, mean of {episodes} episodes:")
    print(f"  {'before training' if steps[0] <= learning_starts else 'at first'} (step {steps[0]}): {mean[0]:.1f}")
    best = int(mean.argmax())
    print(f"  best (step {steps[best]}): {mean[best]:.1f}, kept as {run / 'best_model.zip'}")
    print(f"  {'last' if steps[-1] > learning_starts else 'still before training'} (step {steps[-1]}): {mean[-1]:.1f}")
    print(f"Learning curve: {run / 'learning_curve.png'}")
