"""The end of a run: its learning curve as a picture, and where it began and ended in words."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from sb3_robust_bisim.runs.atomic import atomic_path


def report(run: Path, title: str, learning_starts: int) -> None:
    """
    Draw the learning curve of a run and print where it began and where it ended.

    :param run: folder with the ``evaluations.npz`` of SB3's EvalCallback; without one there is nothing to report
    :param title: of the picture
    :param learning_starts: steps before which nothing was learned, -1 if the agent had learned before
    """
    if not (run / "evaluations.npz").exists():
        print("No evaluation, no learning curve: --eval-freq was larger than the number of steps, or negative.")
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
    print(f"  {'after' if steps[-1] > learning_starts else 'still before'} training (step {steps[-1]}): {mean[-1]:.1f}")
    print(f"Learning curve: {run / 'learning_curve.png'}")
