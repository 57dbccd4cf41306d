"""Random camera poses and colours stay in bounds, are reproducible and leave no trace in the model."""

import math
import pickle
from collections.abc import Callable
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import sb3_robust_bisim.envs  # noqa: F401
from sb3_robust_bisim.envs.distractors import ColorDistractor
from sb3_robust_bisim.envs.pixels import PixelTask
from sb3_robust_bisim.envs.scene import SCALES, CameraPose, SceneColors

HARD = {"camera_distraction": "hard", "color_distraction": "hard"}


@pytest.fixture
def make() -> Any:
    made: list[PixelTask] = []

    def build(task: str, **kwargs: Any) -> PixelTask:
        env = gym.make(f"robust_bisim/{task}-pixels-v0", **kwargs).unwrapped
        assert isinstance(env, PixelTask)
        made.append(env)
        return env

    yield build
    for env in made:
        env.close()


Make = Callable[..., PixelTask]


def play(env: PixelTask, seed: int | None, steps: int = 3) -> dict[str, np.ndarray]:
    """Frames, states and rewards of the first steps of an episode. The actions are always the same."""
    frames, states, rewards = [env.reset(seed=seed)[0]], [env.physics.get_state()], []
    env.action_space.seed(0)
    for _ in range(steps):
        frame, reward, *_ = env.step(env.action_space.sample())
        frames.append(frame)
        states.append(env.physics.get_state())
        rewards.append(reward)
    return {"frames": np.array(frames), "states": np.array(states), "rewards": np.array(rewards)}


def objects(env: PixelTask) -> np.ndarray:
    """Mask of the pixels that are the same on a black and on a white background."""
    assert isinstance(env.distraction.background, ColorDistractor)
    frames = []
    for shade in (0, 255):
        env.distraction.background.paint(np.full(3, shade, dtype=np.uint8))
        frames.append(env.look(env.distraction))
    return (frames[0] == frames[1]).all(-1)


# Camera and colours in the environment


@pytest.mark.parametrize("dynamic", [False, True])
@pytest.mark.parametrize("distractor", ["none", "balls"])
@pytest.mark.parametrize(("camera", "color"), [("easy", None), (None, "easy"), ("hard", "hard")])
def test_a_seed_reproduces_the_frames_and_the_states_do_not_depend_on_the_distraction(
    make: Make, camera: str | None, color: str | None, distractor: str, dynamic: bool
) -> None:
    kwargs = dict(camera_distraction=camera, color_distraction=color, dynamic=dynamic)
    env = make("cheetah-run", distractor=distractor, shadows=False, size=48, **kwargs)
    usual = play(make("cheetah-run", distractor=distractor, shadows=False, size=48), seed=1)
    runs = [play(env, seed) for seed in (1, 1, 2)]
    for key in ("frames", "states", "rewards"):
        np.testing.assert_array_equal(runs[0][key], runs[1][key])
    for key in ("states", "rewards"):
        np.testing.assert_array_equal(runs[0][key], usual[key])
    for frame, undistracted, other_seed in zip(runs[0]["frames"], usual["frames"], runs[2]["frames"], strict=True):
        assert (frame != undistracted).any()
        assert (frame != other_seed).any()


@pytest.mark.parametrize("dynamic", [False, True])
def test_pose_and_colours_change_between_episodes_and_only_dynamic_ones_within_an_episode(make: Make, dynamic: bool) -> None:
    env = make("reacher-easy", dynamic=dynamic, shadows=False, size=32, **HARD)
    camera, colors = env.distraction.camera, env.distraction.colors
    assert camera is not None
    assert colors is not None
    for _ in range(2):
        env.reset()
        before = [camera.pose.copy(), colors.colors.copy()]
        env.step(env.action_space.sample())
        for now, then in zip([camera.pose, colors.colors], before, strict=True):
            assert (now != then).any() == dynamic
        env.reset()
        assert (camera.pose != before[0]).all()
        assert (colors.colors != before[1]).any()


@pytest.mark.parametrize("distractor", ["none", "noise"])
def test_a_pickled_environment_continues_exactly_within_and_beyond_the_episode(make: Make, distractor: str) -> None:
    env = make("walker-walk", distractor=distractor, dynamic=True, shadows=False, size=32, **HARD)
    play(env, seed=0)
    copied = pickle.loads(pickle.dumps(env))
    action = env.action_space.sample()
    for _ in range(3):
        np.testing.assert_array_equal(copied.step(action)[0], env.step(action)[0])
    # The generator of the start state is copied too
    np.testing.assert_array_equal(copied.reset()[0], env.reset()[0])
    np.testing.assert_array_equal(copied.step(action)[0], env.step(action)[0])
    np.testing.assert_array_equal(copied.look(), env.look())
    copied.close()


def test_pose_and_colours_depend_neither_on_the_background_nor_on_each_other(make: Make) -> None:
    seen = []
    for distractor, names in product(("none", "noise"), (["camera_distraction"], ["color_distraction"], list(HARD))):
        env = make("cheetah-run", distractor=distractor, dynamic=True, size=16, **{name: "hard" for name in names})
        play(env, seed=3)
        seen.append(env.distraction)
    poses = [distraction.camera.pose for distraction in seen if distraction.camera is not None]
    colors = [distraction.colors.colors for distraction in seen if distraction.colors is not None]
    assert len(poses) == len(colors) == 4
    assert all(np.array_equal(pose, poses[0]) for pose in poses)
    assert all(np.array_equal(color, colors[0]) for color in colors)


def test_rendering_restores_the_model_and_the_clean_frame_equals_that_of_dm_control(make: Make) -> None:
    env = make("cheetah-run", clean_obs=True, dynamic=True, render_mode="rgb_array", **HARD)
    model, data = env.physics.model.ptr, env.physics.data.ptr
    usual = [model.mat_rgba.copy(), model.geom_rgba.copy(), model.cam_pos.copy()]
    observation, info = env.reset(seed=0)
    for _ in range(3):
        place = data.cam_xpos.copy()
        assert env.render() is not None
        np.testing.assert_array_equal(info["clean_obs"], env.physics.render(84, 84, camera_id=0))
        assert (observation != info["clean_obs"]).any()
        np.testing.assert_array_equal(data.cam_xpos, place)
        for now, then in zip([model.mat_rgba, model.geom_rgba, model.cam_pos], usual, strict=True):
            np.testing.assert_array_equal(now, then)
        observation, *_, info = env.step(env.action_space.sample())


def test_the_agent_sees_what_render_shows(make: Make) -> None:
    env = make("cheetah-run", dynamic=True, render_mode="rgb_array", render_size=84, **HARD)
    for observation in play(env, seed=0)["frames"][-1:]:
        np.testing.assert_array_equal(env.render(), observation)


@pytest.mark.parametrize("distractor", ["none", "color", "video"])
def test_a_look_shows_the_same_state_under_another_distraction_and_does_not_change_the_episode(
    make: Make, distractor: str
) -> None:
    kwargs = dict(distractor=distractor, dynamic=True, shadows=False, size=32) | HARD
    expected = play(make("cheetah-run", **kwargs), seed=0)
    env = make("cheetah-run", **kwargs)
    start = env.reset(seed=0)[0]
    env.action_space.seed(0)
    other = env.distraction.another()
    for step in range(3):
        looks = [env.look(), env.look(), env.look(other)]
        assert all(look.shape == (32, 32, 3) and (look != expected["frames"][step]).any() for look in looks)
        assert (looks[0] != looks[1]).any()
        np.testing.assert_array_equal(looks[2], env.look(other))
        np.testing.assert_array_equal(env.look(env.distraction), expected["frames"][step])
        frame = env.step(env.action_space.sample())[0]
        other.step()
        np.testing.assert_array_equal(frame, expected["frames"][step + 1])
    np.testing.assert_array_equal(start, expected["frames"][0])


def test_a_look_without_any_distraction_is_the_frame(make: Make) -> None:
    env = make("cheetah-run", shadows=False, size=32)
    np.testing.assert_array_equal(env.reset(seed=0)[0], env.look())


@pytest.mark.parametrize("task", ["cheetah-run", "reacher-easy", "finger-spin", "fish-swim", "manipulator-bring_ball"])
def test_even_the_darkest_object_is_not_taken_for_background(make: Make, task: str) -> None:
    env = make(task, distractor="color")
    env.reset(seed=0)
    model = env.physics.model.ptr
    model.mat_rgba[:, :3] *= 0.25 / model.mat_rgba[:, :3].max(axis=1, keepdims=True)  # dark from the outset
    colors = SceneColors(model, SCALES["hard"], False)
    masks = []
    for present in (colors.low, colors.high, None):
        env.distraction.colors = colors if present is not None else None
        if present is not None:
            colors.colors = present
        masks.append(objects(env))
    assert 10 < masks[2].sum() < 2000
    np.testing.assert_array_equal(masks[0], masks[2])
    np.testing.assert_array_equal(masks[1], masks[2])


def test_planes_stay_hidden_from_a_camera_elsewhere(make: Make) -> None:
    env = make("cheetah-run", distractor="color", camera_distraction="hard")
    for seed in range(4):
        env.reset(seed=seed)
        covered = objects(env)
        assert 50 < covered.sum() < 1500  # the ground would cover thousands


def test_a_distracted_scene_keeps_the_contract_of_gymnasium(make: Make) -> None:
    check_env(make("point_mass-easy", distractor="noise", dynamic=True, **HARD))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"camera_distraction": "extreme"}, "camera_distraction must be None .* one of .'easy', 'medium', 'hard'.*'extreme'"),
        ({"camera_distraction": 0.1}, r"camera_distraction must be .* got 0\.1"),
        ({"color_distraction": ["easy"]}, r"color_distraction must be None .* got \['easy'\]"),
        ({"color_distraction": "none"}, "color_distraction must be None .* got 'none'"),
        ({"camera_distraction": "easy", "dynamic": 1}, "dynamic must be True or False, got 1"),
        ({"dynamic": True}, "dynamic=True .* add camera_distraction or color_distraction, or omit it"),
    ],
)
def test_a_bad_argument_is_named_with_its_value_and_a_remedy(make: Make, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make("cheetah-run", **arguments)


# The camera


@pytest.mark.parametrize("scale", SCALES.values())
@pytest.mark.parametrize("dynamic", [False, True])
def test_poses_fill_their_bounds_and_stay_in_them(scale: float, dynamic: bool) -> None:
    camera = CameraPose(scale, dynamic, None, radius=2.0)
    camera.seed(0)
    poses = []
    for _ in range(4 if dynamic else 2000):
        camera.reset()
        poses.append(camera.pose)
        for _ in range(2000 if dynamic else 1):
            camera.step()
            poses.append(camera.pose)
    angle = scale * math.pi / 2
    low, high = np.array([-angle, -angle, 1 - 0.5 * scale, -angle]), np.array([angle, angle, 1 + 1.5 * scale, angle])
    assert (np.array(poses) >= low).all()
    assert (np.array(poses) <= high).all()
    np.testing.assert_allclose(np.min(poses, axis=0), low, atol=0.05 * scale)
    np.testing.assert_allclose(np.max(poses, axis=0), high, atol=0.05 * scale)


def test_a_moving_camera_keeps_its_speed_limits_and_gathers_speed_in_small_steps() -> None:
    scale = 0.2
    camera = CameraPose(scale, True, None, radius=2.0)
    camera.seed(0)
    camera.reset()
    moves = []
    for _ in range(2000):
        before = camera.pose
        camera.step()
        moves.append(camera.pose - before)
    speed, roll_speed = np.linalg.norm(np.array(moves)[:, :3], axis=1), np.abs(np.array(moves)[:, 3])
    assert speed.max() == pytest.approx(0.1 * scale)
    assert roll_speed.max() == pytest.approx(math.pi / 50 * scale)
    # The first step is one draw of the noise from rest
    firsts = []
    for _ in range(2000):
        camera.reset()
        before = camera.pose
        camera.step()
        firsts.append(camera.pose - before)
    inside = np.abs(np.array(firsts)) > 0  # a pose that was drawn at a bound stays there
    assert inside.mean() > 0.95
    expected = scale * np.array([0.025, 0.025, 0.025, math.pi / 300])
    np.testing.assert_allclose(np.std(firsts, axis=0), expected, rtol=0.1)


@pytest.mark.parametrize(
    ("task", "upper_quadrant"), [("cheetah-run", True), ("cup", True), ("point_mass-easy", True), ("reacher-easy", False)]
)
def test_the_camera_stays_above_what_it_looks_at_and_in_front_except_for_the_reacher(
    make: Make, task: str, upper_quadrant: bool
) -> None:
    env = make("ball_in_cup-catch" if task == "cup" else task, camera_distraction="hard", size=8)
    camera = env.distraction.camera
    assert camera is not None
    env.reset(seed=0)
    usual, axes = env.physics.data.cam_xpos[0].copy(), env.physics.data.cam_xmat[0].reshape(3, 3).copy()
    target = usual - camera._radius * axes[:, 2]
    heights, tilts = [], []
    for _ in range(300):
        camera.reset()
        position, turned = camera.move(usual, axes)
        distance = np.linalg.norm(position - target)
        np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose((position - target) / distance, turned[:, 2], atol=1e-9)  # it looks at the target
        assert 1 - 0.15 <= distance / camera._radius <= 1 + 0.45
        heights.append(math.asin(turned[2, 2]))
        tilts.append(camera.pose[1])
        assert turned[:, 2] @ axes[:, 2] > 0
    elevation = math.asin(min(axes[2, 2], 1.0))
    if upper_quadrant:
        np.testing.assert_allclose(np.array(heights) - elevation, tilts, atol=1e-7)  # without passing over the pole
        assert min(heights) >= -1e-9
    else:
        assert min(tilts) < -0.4 < 0.4 < max(tilts)


def test_a_camera_that_looks_straight_ahead_is_never_lowered_and_one_from_above_never_passes_the_pole() -> None:
    angle = 0.3 * math.pi / 2
    for elevation, low, high in ((0.0, 0.0, angle), (math.pi / 2, -angle, 0.0), (0.2, -0.2, angle), (-0.1, 0.1, angle)):
        camera = CameraPose(0.3, False, elevation, 1.0)
        assert (camera.low[1], camera.high[1]) == (pytest.approx(low), pytest.approx(high))


def test_a_camera_that_follows_the_robot_still_does(make: Make) -> None:
    env = make("cheetah-run", distractor="color", camera_distraction="hard")
    env.reset(seed=2)
    camera = env.distraction.camera
    assert camera is not None
    camera.pose = np.array([0.3, 0.3, 1.0, 0.2])
    middle = []
    for place in (0.0, 50.0):
        with env.physics.reset_context():
            env.physics.named.data.qpos["rootx"] = place
        middle.append(np.argwhere(objects(env)).mean(axis=0))
    np.testing.assert_allclose(middle[0], middle[1], atol=1)
    np.testing.assert_allclose(middle[0], 42, atol=12)


@pytest.mark.parametrize("task", ["humanoid-stand", "quadruped-walk"])
def test_a_camera_on_a_body_and_one_that_aims_at_a_body_can_be_moved(make: Make, task: str) -> None:
    env = make(task, camera_distraction="hard", camera_id="egocentric", shadows=False, size=32)
    assert env.distraction.camera is not None
    assert env.distraction.camera._radius == env.physics.model.stat.extent
    frames = play(env, seed=0)["frames"]
    assert (frames[0] != play(make(task, camera_id="egocentric", shadows=False, size=32), seed=0)["frames"][0]).any()


# The colours


@pytest.mark.parametrize("scale", SCALES.values())
@pytest.mark.parametrize("dynamic", [False, True])
def test_colours_fill_their_bounds_and_stay_in_them(make: Make, scale: float, dynamic: bool) -> None:
    env = make("walker-walk", size=8)
    usual = env.physics.model.ptr.mat_rgba[:, :3].copy()
    colors = SceneColors(env.physics.model.ptr, scale, dynamic)
    colors.seed(0)
    seen = []
    for _ in range(60 if dynamic else 1000):
        colors.reset()
        for _ in range(200 if dynamic else 1):
            colors.step()
            seen.append(colors.colors[: len(usual)])
    low, high = np.clip(usual - scale, 0, 1), np.clip(usual + scale, 0, 1)
    assert (np.array(seen) >= low - 1e-6).all()
    assert (np.array(seen) <= high + 1e-6).all()
    np.testing.assert_allclose(np.max(seen, axis=0), high, atol=0.1 * scale)
    not_lifted = low.max(axis=1) >= 0.1
    assert not_lifted.any()
    np.testing.assert_allclose(np.min(seen, axis=0)[not_lifted], low[not_lifted], atol=0.1 * scale)
    assert (np.array(seen).max(axis=-1) >= np.minimum(usual.max(axis=1), 0.1) - 1e-6).all()


def test_moving_colours_take_gaussian_steps() -> None:
    model = two_colors()
    colors = SceneColors(model, 0.3, True)
    colors.seed(0)
    colors.reset()
    colors.colors = np.full((2, 3), 0.5)
    steps = []
    for _ in range(2000):
        before = colors.colors
        colors.step()
        steps.append(colors.colors - before)
        colors.colors = np.full((2, 3), 0.5)
    assert np.std(steps) == pytest.approx(0.03 * 0.3, rel=0.05)


def two_colors() -> Any:
    """A material and three geoms: one in it, one in it with its own colour, and a grey one without a material."""
    import mujoco

    return mujoco.MjModel.from_xml_string("""
        <mujoco><asset><material name="m" rgba="0.4 0.5 0.6 1"/></asset><worldbody>
            <geom size="1" material="m"/><geom size="1" material="m" rgba="0.6 0.5 0.4 0.5"/>
        </worldbody></mujoco>""")


def test_a_geom_in_a_material_has_no_colour_of_its_own_unless_it_is_given_one() -> None:
    model = two_colors()
    colors = SceneColors(model, 0.1, False)
    assert {name: list(rows) for name, rows in colors.rows.items() if len(rows)} == {"mat_rgba": [0], "geom_rgba": [1]}
    colors.reset()
    usual = model.mat_rgba.copy(), model.geom_rgba.copy()
    with colors.on(model):
        np.testing.assert_allclose(model.mat_rgba[0, :3], colors.colors[0], rtol=1e-6)
        np.testing.assert_allclose(model.geom_rgba[1, :3], colors.colors[1], rtol=1e-6)
        assert (model.mat_rgba[0, 3], model.geom_rgba[1, 3]) == (1, 0.5)
    np.testing.assert_array_equal(model.mat_rgba, usual[0])
    np.testing.assert_array_equal(model.geom_rgba, usual[1])
