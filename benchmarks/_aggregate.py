"""Curves and tables of a figure: mean and standard error as in the paper, and rliable's interquartile mean with intervals."""

import csv
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from _figures import Figure
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture
from matplotlib.ticker import MaxNLocator
from rliable import library, metrics

from sb3_robust_bisim.runs.atomic import atomic_path

Result = dict[str, Any]
Curve = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # steps, middle, low, high
REPS, REPS_OF_CURVES = 1000, 200  # bootstrap samples
MANY = 4  # runs from which on an interquartile mean leaves something out and an interval means something
FEWEST = {"iqm_return": MANY}
FULL = "normed-IR-ID"
# A method looks the same in every figure: colour and dashes; what a figure adds of its own gets the colours that are left,
# then dotted lines
LOOKS = {
    "SAC": ("C0", "-"),
    "DBC": ("C1", "-"),
    "DBC-normed": ("C2", "--"),  # dashes, as it may lie on SAC, or normed-IR on DBC-IR
    "normed-IR": ("C3", "--"),
    "normed-ID": ("C4", "-."),
    FULL: ("C5", "-"),
    f"{FULL}-no-metric": ("C5", ":"),
    "self-prediction": ("C6", "-"),
    "self-prediction-IR": ("C7", "-"),
    "DBC-IR": ("C8", "-"),
    "DBC-alt": ("C9", "-"),
}
AS_WRITTEN = "-max0.1"  # another setting of the same method: thin


def of(results: list[Result], **wanted: Any) -> list[Result]:
    return [result for result in results if result.items() >= wanted.items()]


def series(runs: list[Result], key: str) -> tuple[np.ndarray, np.ndarray]:
    """
    Steps and (runs, evaluations) values. "return" is the mean of the episodes; the return of a run that broke off stays where
    it was, all else of it is unknown from there on.
    """
    longest = max((run["evaluations"] for run in runs), key=len)
    rows = []
    for run in runs:
        row = [np.mean(e["returns"]) if key == "return" else e.get(key, np.nan) for e in run["evaluations"]]
        rows.append(row + [row[-1] if key == "return" else np.nan] * (len(longest) - len(row)))
    return np.array([evaluation["step"] for evaluation in longest]), np.array(rows, dtype=float)


def mean_curve(runs: list[Result], key: str) -> Curve:
    steps, values = series(runs, key)
    middle = values.mean(axis=0)
    error = values.std(axis=0, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.zeros_like(middle)
    return steps, middle, middle - error, middle + error


def estimate(scores: dict[str, Any], statistic: Callable[..., np.ndarray], reps: int) -> tuple[dict, dict]:
    """rliable's estimates and intervals, the same each time: it samples from NumPy's global generator alone."""
    np.random.seed(0)  # noqa: NPY002
    return library.get_interval_estimates(scores, statistic, reps=reps)


def iqm_curve(runs: list[Result], key: str) -> Curve:
    steps, values = series(runs, key)
    scores = {"": values[:, None, :]}  # runs, tasks, evaluations

    def iqm(x: np.ndarray) -> np.ndarray:
        return np.array([metrics.aggregate_iqm(x[..., i]) for i in range(x.shape[-1])])

    middle, intervals = estimate(scores, iqm, REPS_OF_CURVES)
    return steps, middle[""], *intervals[""]


def median_curve(runs: list[Result], key: str) -> Curve:
    """Median and range: what grows without bound has no useful mean."""
    steps, values = series(runs, key)
    values = np.ma.masked_invalid(values)
    middle, low, high = np.ma.median(values, axis=0), values.min(axis=0), values.max(axis=0)
    return steps, np.ma.filled(middle, np.nan), np.ma.filled(low, np.nan), np.ma.filled(high, np.nan)


def ratio_curve(runs: list[Result], key: str) -> Curve:
    """Mean over the runs of mu_bd / mu_rd, where any reward has been found."""
    (steps, mu_bd), (_, mu_rd) = series(runs, "mu_bd"), series(runs, "mu_rd")
    middle = np.ma.mean(np.ma.masked_invalid(mu_bd) / np.ma.masked_less_equal(np.ma.masked_invalid(mu_rd), 0), axis=0)
    middle = np.ma.filled(middle, np.nan)
    return steps, middle, middle, middle


# Row of a figure: the curve, what it is drawn from, the label of its axis and its scale
QUANTITIES: dict[str, tuple[Callable[[list[Result], str], Curve], str, str, str]] = {
    "mean_return": (mean_curve, "return", "return, mean ± standard error", "linear"),
    "iqm_return": (iqm_curve, "return", "return, IQM, 95 % interval", "linear"),
    "embedding_norm_max": (median_curve, "embedding_norm_max", "largest norm, median and range", "log"),
    "mu_ratio": (ratio_curve, "mu_bd", "$\\mu_{bd} / \\mu_{rd}$ (dotted: $c_R / (1 - c_T)$)", "log"),
}


def styles(methods: Iterable[str]) -> dict[str, dict[str, Any]]:
    """How each method is drawn."""
    names = {method: method.removesuffix(AS_WRITTEN) for method in methods}
    dotted = [(colour, ":") for colour, _ in LOOKS.values()]
    free = iter([look for name, look in LOOKS.items() if name not in names.values()] + dotted)
    looks = {name: LOOKS.get(name) or next(free) for name in dict.fromkeys(names.values())}
    return {
        method: {"color": looks[name][0], "linestyle": looks[name][1], "linewidth": 2.0 if method == name else 1.0}
        for method, name in names.items()
    }


def draw(results: list[Result], figure: Figure, out: Path) -> None:
    """``curves.png`` and ``curves.csv``: one column of axes per task, one row per quantity."""
    style = styles(figure.methods)
    panels = [panel for panel in figure.panels if of(results, panel=panel)]
    shown = {quantity: {panel: _enough(results, figure, panel, quantity) for panel in panels} for quantity in figure.rows}
    rows = [quantity for quantity in figure.rows if any(shown[quantity].values())]
    picture = Picture(figsize=(1.5 + 4.2 * len(panels), 0.8 + 3.2 * len(rows)), layout="constrained")
    axes = picture.subplots(len(rows), len(panels), squeeze=False, sharex=True)
    table: list[list[Any]] = [["quantity", "panel", "method", "runs", "step", "middle", "low", "high"]]
    for row, quantity in enumerate(rows):
        leftmost = next(panel for panel in panels if shown[quantity][panel])
        for ax, panel in zip(axes[row], panels, strict=True):
            methods = shown[quantity][panel]
            if not methods:
                ax.set_axis_off()
                continue
            table += _draw_panel(ax, quantity, panel, methods, style)
            _label(ax, quantity, f"{panel}, {_count(methods)}" if row == 0 else "", panel == leftmost)
    for column in range(len(panels)):
        axes[-1, column].set_xlabel("environment steps")
        axes[-1, column].xaxis.set_major_locator(MaxNLocator(5))  # six digits each
    handles = {label: line for ax in axes.flat for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    picture.legend(handles.values(), handles, loc="outside lower center", ncols=min(len(handles), 2 * len(panels)))
    with atomic_path(out / "curves.png") as temporary:
        picture.savefig(temporary, dpi=90, format="png")
    with atomic_path(out / "curves.csv") as temporary, temporary.open("w", newline="") as file:
        csv.writer(file).writerows(table)


def _enough(results: list[Result], figure: Figure, panel: str, quantity: str) -> dict[str, list[Result]]:
    """The runs of each method that has as many as the quantity takes."""
    runs = {method: of(results, panel=panel, method=method) for method in figure.methods}
    return {method: found for method, found in runs.items() if len(found) >= FEWEST.get(quantity, 1)}


def _draw_panel(
    ax: Axes, quantity: str, panel: str, methods: dict[str, list[Result]], style: dict[str, dict[str, Any]]
) -> list[list[Any]]:
    """:return: what is drawn, as rows of ``curves.csv``"""
    curve, key, _, _ = QUANTITIES[quantity]
    table: list[list[Any]] = []
    for method, runs in methods.items():
        lines = curve(runs, key)
        _draw_curve(ax, lines, method, style[method])
        if quantity == "mu_ratio":
            target = np.nanmax(series(runs, "mu_ratio_target")[1])
            ax.axhline(target, color=style[method]["color"], linestyle=":", linewidth=1)
        values = zip(*lines, strict=True)
        table += [[quantity, panel, method, len(runs), *(f"{v:.6g}" for v in point)] for point in values]
    return table


def _draw_curve(ax: Axes, curve: Curve, label: str, style: dict[str, Any]) -> None:
    steps, middle, low, high = curve
    ax.plot(steps, middle, label=label, **style)
    ax.fill_between(steps, low, high, color=style["color"], alpha=0.15, linewidth=0)


def _count(methods: dict[str, list[Result]]) -> str:
    fewest, most = min(map(len, methods.values())), max(map(len, methods.values()))
    return f"{most if fewest == most else f'{fewest} to {most}'} run{'s' if most > 1 else ''}"


def _label(ax: Axes, quantity: str, title: str, first: bool) -> None:
    _, _, label, scale = QUANTITIES[quantity]
    decades = 0 < 10 * ax.dataLim.y0 < ax.dataLim.y1  # otherwise a logarithm has nothing to show
    ax.set(title=title, yscale=scale if decades else "linear", ylabel=label if first else "")
    ax.grid(alpha=0.3)


def tables(results: list[Result], figure: Figure, out: Path) -> dict[str, Any]:
    """``table.md``: where each method ended; and the same for the closing JSON."""
    panels: dict[str, dict[str, Any]] = {}
    for panel in figure.panels:
        ends = {m: series(runs, "return")[1][:, -1] for m in figure.methods if (runs := of(results, panel=panel, method=m))}
        panels[panel] = {m: _ending(of(results, panel=panel, method=m), final, ends.get(FULL)) for m, final in ends.items()}
        if figure.solved is not None:
            for method, row in panels[panel].items():
                row["solved"] = _solved(of(results, panel=panel, method=method), figure.solved)
    splits = list(dict.fromkeys(split for panel in figure.panels.values() for split in panel.splits))
    played = [f"final agent on {split} clips" for split in splits]
    solved = [f"reached {figure.solved:g}", "median step", "mean fall after the best"] if figure.solved is not None else []
    heads = ["task", "method", "runs", "last return of each", "mean ± s.e.", "IQM [95 %]", "P(full is better) [95 %]"]
    heads += [*solved, *played, "largest norm", "minutes"]
    lines = [" | ".join(["", *heads, ""]).strip(), "|---" * len(heads) + "|"]
    for panel, methods in panels.items():
        for method, row in methods.items():
            error = "" if row["standard_error"] is None else f" ± {row['standard_error']}"
            better = "{} [{}, {}]".format(*row["full_is_better"]) if method != FULL and "full_is_better" in row else ""
            played = [", ".join(map(str, row.get(f"final_return_{split}", []))) for split in splits]
            cells = [
                panel,
                method,
                row["runs"],
                ", ".join(f"{value:.4g}" for value in row["final_returns"]),
                f"{row['mean']}{error}",
                "{} [{}, {}]".format(*row["iqm"]) if row["runs"] >= MANY else "",
                better,
                *row.get("solved", {}).values(),
                *played,
            ]
            lines.append(" | ".join(["", *map(str, cells), str(row["largest_norm"]), str(row["minutes"]), ""]).strip())
    measured = sorted({f"commit {r['commit']}, {r['machine']}, torch {r['versions']['torch']}" for r in results})
    seeds = sorted({r["seed"] for r in results})
    broken = [
        f"{r['panel']} {r['method']} seed {r['seed']} at step {r['evaluations'][-1]['step']}"
        for r in results
        if "stopped" in r
    ]
    lines += ["", f"Seeds {seeds[0]} to {seeds[-1]}; {'; '.join(measured)}.", ""]
    if broken:
        lines += [f"Broke off with a loss that was not finite: {', '.join(broken)}.", ""]
    with atomic_path(out / "table.md") as temporary:
        temporary.write_text("\n".join(lines))
    return {"panels": panels}


def _ending(runs: list[Result], final: np.ndarray, full: np.ndarray | None) -> dict[str, Any]:
    iqm, interval = estimate({"": final[:, None]}, lambda x: np.array([metrics.aggregate_iqm(x)]), REPS)
    row: dict[str, Any] = {
        "runs": len(final),
        "mean": _short(final.mean()),
        "standard_error": _short(final.std(ddof=1) / np.sqrt(len(final)) if len(final) > 1 else np.nan),
        "iqm": [_short(value) for value in (iqm[""][0], *(interval[""][:, 0] if len(final) >= MANY else [np.nan, np.nan]))],
        "final_returns": [_short(value) for value in final],
        "largest_norm": _short(max(e.get("embedding_norm_max", 0.0) for run in runs for e in run["evaluations"])),
        "minutes": _short(np.median([run["seconds"] for run in runs]) / 60),
        "stopped": sum("stopped" in run for run in runs),
    }
    if full is not None and min(len(full), len(final)) >= MANY:
        pair = {"": (full[:, None], final[:, None])}
        better, interval = estimate(pair, metrics.probability_of_improvement, REPS)
        row["full_is_better"] = [_short(value) for value in (better[""], *np.ravel(interval[""]))]
    played = [run["final_return_by_split"] for run in runs if "final_return_by_split" in run]  # those that did not break off
    for split in played[0] if played else ():
        row[f"final_return_{split}"] = [_short(np.mean(returns[split])) for returns in played]
    return row


def _solved(runs: list[Result], threshold: float) -> dict[str, Any]:
    """Which runs reach a return, the median of their first steps there, and how far runs end below their best evaluation."""
    steps, returns = series(runs, "return")
    first = [steps[np.argmax(row >= threshold)] for row in returns if row.max() >= threshold]
    fall = (returns.max(axis=1) - returns[:, -1]).mean()
    return {
        "runs": f"{len(first)} of {len(runs)}",
        "median_step": int(np.median(first)) if first else "",
        "fall": _short(fall),
    }


def _short(value: float) -> float | None:
    if not np.isfinite(value):
        return None
    return float(f"{value:.3g}") if abs(value) < 1000 else round(float(value))
