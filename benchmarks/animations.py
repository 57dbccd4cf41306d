"""Draw the animations of the documentation, each below 1 MB: `norms`, `cartpole`, and `agent` from a video of any agent."""

import argparse
import json
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

import gymnasium as gym
import numpy as np
from PIL import Image, ImageDraw, ImageOps, ImageSequence

import sb3_robust_bisim
from sb3_robust_bisim.cli.record import gif_durations
from sb3_robust_bisim.runs.atomic import atomic_path

ROOT = Path(__file__).resolve().parents[1]
TASK = "robust_bisim/SparseCartPole-v0"
LARGEST = 1_000_000  # bytes
RADIUS = 50  # of the ball, with rewards in [0, 1] and gamma 0.99
METHODS = {"DBC": ("C1", "DBC"), "normed-IR-ID": ("C5", "the full method")}  # colours as in the figures
STATE, NOISE, LINE = (49, 104, 142), (190, 190, 190), (90, 90, 90)


def norms(panel: str) -> list[Image.Image]:
    """The largest norm of an embedding over the steps, a line for each run, evaluation by evaluation."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    results = [json.loads(path.read_text()) for path in sorted((ROOT / "benchmarks/results/cartpole").glob("*.json"))]
    runs = [result for result in results if result["panel"] == panel and result["method"] in METHODS]
    figure = Figure(figsize=(6, 3.2), dpi=90, layout="constrained")
    canvas, axes = FigureCanvasAgg(figure), figure.subplots()
    axes.axhline(RADIUS, color="black", linestyle=":", linewidth=1)
    axes.text(100, RADIUS * 1.3, "radius of the ball", fontsize=8)
    lines = []
    for run in runs:
        points = [(e["step"], e["embedding_norm_max"]) for e in run["evaluations"] if "embedding_norm_max" in e]
        colour, label = METHODS[run["method"]]
        (line,) = axes.plot([], [], color=colour, linewidth=1.5, label=label if run["seed"] == 0 else None)
        lines.append((line, np.array(points, dtype=float)))
    last = max(int(points[-1, 0]) for _, points in lines)
    most = max(points[:, 1].max() for _, points in lines)
    axes.set(
        xlim=(0, last), yscale="log", ylim=(1, 3 * most), xlabel="environment steps", ylabel="largest norm of an embedding"
    )
    axes.legend(
        loc="upper left", title=f"noisy sparse cartpole, ${panel.replace('N_m', 'N_m ')}$", title_fontsize=8, fontsize=8
    )
    frames = []
    for step in range(1000, last + 1, 500):  # agents train from step 1000 on
        for line, points in lines:
            line.set_data(*points[points[:, 0] <= step].T)
        canvas.draw()
        frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
    return frames


def cartpole(every: int = 2) -> list[Image.Image]:
    """An episode of the agent that comes with the package, above the numbers that it observes."""
    agent = sb3_robust_bisim.load_agent(str(files("sb3_robust_bisim") / "trained_agents" / TASK.replace("/", "-")))
    env = gym.make(TASK, noise_multiplier=2, theta_rew_fraction=1.0, render_mode="rgb_array")
    observation, _ = env.reset(seed=0)
    frames, done, step = [], False, 0
    while not done:
        if step % every == 0:
            picture = Image.fromarray(np.asarray(env.render())[130:350]).resize((450, 165), Image.Resampling.LANCZOS)
            frames.append(_above(picture, _bars(observation, picture.width)))
        action, _ = agent.predict(observation, deterministic=True)
        observation, _, terminated, truncated, _ = env.step(action)
        done, step = terminated or truncated, step + 1
    return frames


def _bars(observation: np.ndarray, width: int, height: int = 90, largest: float = 3.0) -> Image.Image:
    """A bar for each number of the observation, up to 3 in either direction; the first four are the state."""
    picture = Image.new("RGB", (width, height), "white")
    draw = ImageDraw.Draw(picture)
    middle, gap = height // 2 + 7, width / len(observation)
    for i, number in enumerate(observation):
        top = middle - float(np.clip(number / largest, -1, 1)) * (height // 2 - 10)
        colour = STATE if i < 4 else NOISE
        draw.rectangle((i * gap + 6, min(top, middle), (i + 1) * gap - 6, max(top, middle)), fill=colour)
    draw.line((0, middle, width, middle), fill=LINE)
    draw.text((6, 1), "observed: 4 numbers of the state", fill=STATE)
    draw.text((4 * gap + 100, 1), "8 of noise", fill=LINE)
    return picture


def _above(upper: Image.Image, lower: Image.Image) -> Image.Image:
    joined = Image.new("RGB", (upper.width, upper.height + lower.height))
    joined.paste(upper, (0, 0))
    joined.paste(lower, (0, upper.height))
    return joined


def _frames_of(video: Path, fps: float, seconds: float) -> list[Image.Image]:
    """Frames of the first seconds of an MP4 or GIF."""
    frames: Iterator[Image.Image]
    if video.suffix == ".gif":
        with Image.open(video) as gif:
            rate = 1000 / gif.info["duration"]
            frames = iter([frame.convert("RGB") for frame in ImageSequence.Iterator(gif)])
    else:
        import imageio.v2 as imageio

        reader = imageio.get_reader(video)
        rate = reader.get_meta_data()["fps"]
        frames = (Image.fromarray(np.asarray(frame)) for frame in reader)
    whole = list(frames)
    picked = np.arange(0, min(len(whole), seconds * rate), max(rate / fps, 1)).astype(int)
    return [whole[i] for i in picked]


def save_gif(path: Path, frames: list[Image.Image], fps: float, colors: int, hold: float = 0.0) -> int:
    """
    :param path: file
    :param frames: equally large
    :param fps: frames per second
    :param colors: size of the palette, which all frames share
    :param hold: seconds for which the last frame stays in addition
    :return: size in bytes
    """
    sample = Image.new("RGB", (frames[0].width, 4 * frames[0].height))
    for i, frame in enumerate(frames[j] for j in np.linspace(0, len(frames) - 1, 4).astype(int)):
        sample.paste(frame, (0, i * frame.height))
    palette = sample.quantize(colors)
    first, *others = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    durations = gif_durations(len(frames), fps)
    durations[-1] += round(1000 * hold)
    with atomic_path(path) as temporary:
        first.save(temporary, save_all=True, append_images=others, duration=durations, loop=0, optimize=True)
    return path.stat().st_size


def agent(path: Path, out: Path, width: int, fps: float, seconds: float, colors: int) -> None:
    """Make a video smaller until it fits; each try has four fifths of the width of the one before."""
    frames = _frames_of(path, fps, seconds)
    while True:
        scaled = [ImageOps.contain(frame, (width, 10_000), Image.Resampling.LANCZOS) for frame in frames]
        if save_gif(out, scaled, fps, colors) < LARGEST:
            return
        width = width * 4 // 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    for name, about in (
        ("norms", "norms of embeddings, from benchmarks/results/cartpole"),
        ("cartpole", "the agent that comes with the package"),
        ("agent", "a smaller copy of a video"),
    ):
        command = commands.add_parser(name, help=about, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
        command.add_argument("--out", type=Path, default=Path("docs", f"{name}.gif"), help="the GIF to write")
        if name == "norms":
            command.add_argument("--panel", default="N_m=2", help="noise dimensions per state dimension")
        elif name == "agent":
            command.add_argument("video", type=Path, help="MP4 or GIF, such as the agent.mp4 of a run")
            command.add_argument("--width", type=int, default=256, help="largest width in pixels")
            command.add_argument("--fps", type=float, default=12.5, help="frames per second")
            command.add_argument("--seconds", type=float, default=8.0, help="how much of the video")
            command.add_argument("--colors", type=int, default=64, help="number of colours, at most 256")
    args = parser.parse_args()
    if args.command == "norms":
        save_gif(args.out, norms(args.panel), fps=5, colors=64, hold=3)
    elif args.command == "cartpole":
        save_gif(args.out, cartpole(), fps=25, colors=32)
    else:
        agent(args.video, args.out, args.width, args.fps, args.seconds, args.colors)
    with Image.open(args.out) as gif:
        size = args.out.stat().st_size
        print(f"{args.out}: {gif.width} x {gif.height} pixels, {gif.n_frames} frames, {size / 1000:.0f} kB")
        assert size < LARGEST


if __name__ == "__main__":
    main()
