"""Exported agents predict the same, train on and lend their encoder; files of strangers run no code."""

import hashlib
import json
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from safetensors.torch import load_file, save_file
from sb3_contrib import TQC
from small_models import dicts, images, make_model, parameters, pendulum
from stable_baselines3 import PPO, HerReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import ConstantSchedule, LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

from sb3_robust_bisim import BisimSAC, PretrainedEncoder, export_agent, load_agent
from sb3_robust_bisim.export import SETTINGS

KINDS: dict[str, Callable[[], gym.Env]] = {"MlpPolicy": pendulum, "CnnPolicy": images, "MultiInputPolicy": dicts}
ENCODER = "critic.features_extractor.extractor.net.1.weight"  # of MlpPolicy


class MyEncoder(BaseFeaturesExtractor):
    """An encoder of a user, with a layer that behaves differently in training."""

    def __init__(self, observation_space: spaces.Box, features_dim: int = 7) -> None:
        super().__init__(observation_space, features_dim)
        size = observation_space.shape[0]
        self.net = nn.Sequential(nn.Linear(size, features_dim), nn.BatchNorm1d(features_dim), nn.Dropout())

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.net(observations)


@pytest.fixture(scope="module")
def agents(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Any, Path]]:
    """A trained model of each policy and where it was exported. Tests must change neither."""
    made: dict[str, tuple[Any, Path]] = {}

    def agent(policy: str) -> tuple[Any, Path]:
        if policy not in made:
            folder = tmp_path_factory.mktemp(policy) / "agent"
            model = make_model(policy, KINDS[policy]()).learn(14)
            export_agent(model, folder)
            made[policy] = model, folder
        return made[policy]

    return agent


@pytest.fixture
def exported(agents: Callable[[str], tuple[Any, Path]], tmp_path: Path) -> Path:
    """A copy of the files of an MlpPolicy agent, to be damaged."""
    for file in agents("MlpPolicy")[1].iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return tmp_path


def observations(model: Any, n: int = 5) -> Any:
    """As the environment gives them, for ``predict``."""
    model.observation_space.seed(0)
    samples = [model.observation_space.sample() for _ in range(n)]
    if isinstance(samples[0], dict):
        return {key: np.stack([sample[key] for sample in samples]) for key in samples[0]}
    return np.stack(samples)


def weights(module: nn.Module) -> dict[str, th.Tensor]:
    return {name: tensor.clone() for name, tensor in module.state_dict().items()}


def assert_same(left: Any, right: Any) -> None:
    th.testing.assert_close(left, right, rtol=0, atol=0)


# --- agents


@pytest.mark.parametrize("policy", KINDS)
def test_an_agent_comes_back_and_trains_on(agents: Callable[[str], tuple[Any, Path]], policy: str) -> None:
    model, folder = agents(policy)
    assert sorted(file.name for file in folder.iterdir()) == ["config.json", "weights.safetensors"]
    without_env: Any = load_agent(folder)
    obs = observations(model)
    np.testing.assert_array_equal(
        without_env.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0], strict=True
    )
    loaded: Any = load_agent(folder, KINDS[policy](), seed=1)
    assert type(loaded.policy) is type(model.policy)
    assert_same(weights(loaded.policy), weights(model.policy))
    assert_same(loaded.log_ent_coef, model.log_ent_coef)
    assert loaded.observation_space == model.observation_space
    assert (loaded.num_timesteps, loaded._n_updates) == (model.num_timesteps, model._n_updates) == (14, 4)
    before = parameters(loaded.policy.critic.features_extractor)
    loaded.learn(14, reset_num_timesteps=False)
    assert loaded._n_updates > 4
    assert not th.equal(parameters(loaded.policy.critic.features_extractor), before)
    assert loaded.policy.actor.features_extractor is loaded.policy.critic.features_extractor


def test_another_process_predicts_the_same(agents: Callable[[str], tuple[Any, Path]]) -> None:
    model, folder = agents("MlpPolicy")
    obs = observations(model)
    script = (
        "import json, sys, numpy as np; from sb3_robust_bisim import load_agent; "
        "obs = np.array(json.loads(sys.argv[2]), dtype=np.float32); "
        "print(json.dumps(load_agent(sys.argv[1]).predict(obs, deterministic=True)[0].tolist()))"
    )
    command = [sys.executable, "-c", script, str(folder), json.dumps(obs.tolist())]
    output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert json.loads(output) == model.predict(obs, deterministic=True)[0].tolist()


@pytest.mark.parametrize(
    "settings",
    [
        dict(distance="mico", norm_constraint="sphere", dynamics="ensemble", ent_coef=0.2, train_freq=(1, "episode")),
        dict(use_sde=True, c_t=0.5, reward_range=(-2.0, 3.0), metric_kwargs=dict(absorbing=True), target_entropy=-2.5),
        dict(
            policy_kwargs=dict(
                features_extractor_kwargs=dict(features_dim=9, layer_norm=True),
                net_arch=dict(pi=[8], qf=[9, 10]),
                activation_fn=nn.Tanh,
                optimizer_class=th.optim.AdamW,
                optimizer_kwargs=dict(betas=(0.8, 0.9)),
                share_features_extractor=False,
            )
        ),
    ],
)
def test_all_settings_come_back(settings: dict[str, Any], tmp_path: Path) -> None:
    model = make_model(**settings)
    export_agent(model, tmp_path)
    loaded: Any = load_agent(tmp_path, pendulum())

    def plain(agent: Any) -> Any:
        values = {name: getattr(agent, name) for name in SETTINGS}
        return json.loads(
            json.dumps(values, default=lambda value: getattr(value, "__qualname__", str(value)))
        )  # tuples become lists

    assert plain(loaded) == plain(model)
    assert_same(weights(loaded.policy), weights(model.policy))
    assert loaded.radius == model.radius


def test_arguments_replace_the_exported_ones(exported: Path) -> None:
    loaded: Any = load_agent(exported, learning_rate=0.5, ent_coef=0.1, policy_kwargs=dict(optimizer_class=th.optim.SGD))
    assert loaded.critic.optimizer.param_groups[0]["lr"] == 0.5
    assert type(loaded.critic.optimizer) is th.optim.SGD
    assert loaded.log_ent_coef is None
    with pytest.raises(TypeError, match=r"no argument 'learning_rat'.*learning_rate"):
        load_agent(exported, learning_rat=0.5)


def test_what_cannot_be_exported_is_asked_for_by_name(tmp_path: Path) -> None:
    kwargs = dict(features_extractor_class=MyEncoder, net_arch=[16])
    model = make_model(policy_kwargs=kwargs, learning_rate=LinearSchedule(1e-3, 0.0, 1.0)).learn(14)
    export_agent(model, tmp_path)
    mine: Any = dict(features_extractor_class=MyEncoder)
    with pytest.raises(
        ValueError, match=r"MyEncoder' is not one of MlpEncoder, .*policy_kwargs=dict\(features_extractor_class="
    ):
        load_agent(tmp_path)
    with pytest.raises(ValueError, match=r"learning_rate was a Python object .*load_agent\(\.\.\., learning_rate=\.\.\.\)"):
        load_agent(tmp_path, policy_kwargs=mine)
    loaded = load_agent(tmp_path, policy_kwargs=mine, learning_rate=1e-3)
    assert_same(weights(loaded.policy), weights(model.policy))
    with pytest.raises(ValueError, match=r"Pass PretrainedEncoder\(\.\.\., features_extractor_class=\.\.\.\)"):
        PretrainedEncoder(model.observation_space, tmp_path)
    encoder = PretrainedEncoder(model.observation_space, tmp_path, features_extractor_class=MyEncoder)
    statistics = weights(encoder)
    encoder.train()
    encoder(th.rand(4, 3))
    assert_same(weights(encoder), statistics)  # neither batch norm nor dropout is in training mode
    assert_same(encoder(th.ones(4, 3)), encoder(th.ones(4, 3)))


def test_what_must_not_be_exported_is_refused(tmp_path: Path) -> None:
    class Mine(BisimSAC):
        pass

    with pytest.raises(TypeError, match=r"model is a Mine: .* Use its save\(\)"):
        export_agent(Mine("MlpPolicy", pendulum(), buffer_size=10), tmp_path)
    env = gym.wrappers.TransformObservation(pendulum(), lambda _: np.ones(3, dtype=np.int8), spaces.MultiBinary(3))
    with pytest.raises(ValueError, match=r"observation_space is MultiBinary\(3\): only Box"):
        export_agent(make_model(env=env), tmp_path)
    model = make_model()
    with th.no_grad():
        model.actor.mu.bias.fill_(th.nan)
    with pytest.raises(ValueError, match=r"model: actor.mu.bias contains NaN"):
        export_agent(model, tmp_path)
    assert not list(tmp_path.iterdir())
    with pytest.warns(UserWarning, match="VecNormalize is not exported"):
        export_agent(
            make_model(env=VecNormalize(DummyVecEnv([pendulum]), norm_reward=False), intrinsic_reward_scale=0.0), tmp_path
        )


def test_a_compact_export_is_small_and_almost_the_same(agents: Callable[[str], tuple[Any, Path]], tmp_path: Path) -> None:
    model, whole_folder = agents("MlpPolicy")
    export_agent(model, tmp_path, compact=True)
    assert len(whole(tmp_path)) < len(whole(whole_folder)) / 2
    loaded: Any = load_agent(tmp_path, pendulum())
    for name, tensor in weights(model.policy).items():
        if not name.startswith("critic_target"):
            th.testing.assert_close(loaded.policy.state_dict()[name], tensor, rtol=1e-3, atol=1e-6)
    assert_same(weights(loaded.critic_target), weights(loaded.critic))
    obs = observations(model)
    expected, _ = model.predict(obs, deterministic=True)
    np.testing.assert_allclose(loaded.predict(obs, deterministic=True)[0], expected, atol=0.02)
    encoder = PretrainedEncoder(model.observation_space, tmp_path)
    assert_same(weights(encoder.encoder.extractor), weights(loaded.policy.critic.features_extractor.extractor))
    loaded.learn(14, reset_num_timesteps=False)
    assert loaded._n_updates > 4

    large = make_model()
    with th.no_grad():
        large.actor.mu.bias.fill_(1e5)
    with pytest.raises(ValueError, match=r"compact=True: actor.mu.bias has values above 65504.*compact=False"):
        export_agent(large, tmp_path, compact=True)


def test_a_constant_schedule_is_a_number(tmp_path: Path) -> None:
    export_agent(make_model(learning_rate=ConstantSchedule(0.01)), tmp_path)  # as rl-zoo3 passes it
    assert load_agent(tmp_path).learning_rate == 0.01


def test_an_environment_with_other_spaces_is_refused(exported: Path) -> None:
    with pytest.raises(ValueError, match=r"env: its observation_space is Box.*needs Box"):
        load_agent(exported, gym.make("MountainCarContinuous-v0"))


def test_an_agent_with_hindsight_replay_asks_for_its_environment(tmp_path: Path) -> None:
    env = BitFlippingEnv(n_bits=4, continuous=True, discrete_obs_space=True)
    settings: dict[str, Any] = dict(replay_buffer_class=HerReplayBuffer, intrinsic_reward_scale=0.0)
    export_agent(make_model("MultiInputPolicy", env, **settings), tmp_path)
    with pytest.raises(ValueError, match=r"^env=None: the agent's HerReplayBuffer .* Pass env\.$"):
        load_agent(tmp_path)
    assert isinstance(load_agent(tmp_path, env).replay_buffer, HerReplayBuffer)


def test_dicts_keep_the_order_of_their_keys(tmp_path: Path) -> None:
    space = spaces.Dict([("z", spaces.Box(-np.inf, 1, (2,))), ("a", spaces.Discrete(3))])
    env = gym.wrappers.TransformObservation(pendulum(), lambda _: {"z": np.zeros(2, dtype=np.float32), "a": 1}, space)
    model = make_model("MultiInputPolicy", DummyVecEnv([lambda: env]))
    export_agent(model, tmp_path)
    loaded: Any = load_agent(tmp_path)
    assert list(loaded.observation_space) == ["z", "a"]
    assert loaded.observation_space == space
    obs = observations(model)
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])


# --- files of strangers


class Bomb:
    """Its unpickling leaves a file."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> Any:
        return Path.touch, (self.marker,)


def rewrite(folder: Path, key: str, value: Any) -> None:
    """Change an entry of config.json; ``key`` names the way, with dots between the steps."""
    config = json.loads((folder / "config.json").read_text())
    *way, last = key.split(".")
    entry = config
    for step in way:
        entry = entry[step]
    entry[last] = value
    (folder / "config.json").write_text(json.dumps(config))


def replace(folder: Path, content: bytes) -> None:
    """Replace the weights by something with a valid checksum."""
    (folder / "weights.safetensors").write_bytes(content)
    rewrite(folder, "weights_sha256", hashlib.sha256(content).hexdigest())


def with_weights(change: Callable[[dict[str, th.Tensor]], Any]) -> Callable[[Path], None]:
    def damage(folder: Path) -> None:
        tensors = load_file(folder / "weights.safetensors")
        change(tensors)
        save_file(tensors, folder / "other")
        replace(folder, (folder / "other").read_bytes())

    return damage


def whole(folder: Path) -> bytes:
    return (folder / "weights.safetensors").read_bytes()


def unlike(folder: Path) -> None:
    """The weights of another export of the same agent."""
    export_agent(make_model(seed=1), folder / "another")
    (folder / "weights.safetensors").write_bytes(whole(folder / "another"))


HUGE_HEADER = (2**62).to_bytes(8, "little") + b"{}"
DEEP = "[" * 100_000
HOSTILE: dict[str, tuple[Callable[[Path], Any], str]] = {
    "pickle": (lambda f: replace(f, pickle.dumps(Bomb(f / "marker"))), "weights.safetensors is not a whole safetensors file"),
    "torch": (lambda f: th.save(Bomb(f / "marker"), f / "weights.safetensors"), "weights.safetensors is not a whole"),
    "pickled config": (lambda f: (f / "config.json").write_bytes(pickle.dumps(Bomb(f / "marker"))), "config.json is not JSON"),
    "huge header": (lambda f: replace(f, HUGE_HEADER), "is not a whole safetensors file .* get it again"),
    "truncated": (lambda f: replace(f, whole(f)[:-8]), "is not a whole safetensors file .* get it again"),
    "empty": (lambda f: replace(f, b""), "is not a whole safetensors file .* get it again"),
    "checksum": (lambda f: rewrite(f, "weights_sha256", "0"), "is not the file that config.json was written with: get both"),
    "unlike": (unlike, "is not the file that config.json was written with: get both"),
    "shape": (with_weights(lambda w: w.update({ENCODER: th.zeros(2, 2)})), "net.1.weight has shape .2, 2. .*, where .50, 3."),
    "dtype": (with_weights(lambda w: w.update({ENCODER: w[ENCODER].double()})), "net.1.weight has .* torch.float64, where"),
    "NaN": (with_weights(lambda w: w[ENCODER].view(-1)[0:1].fill_(th.nan)), "net.1.weight contains NaN or infinity"),
    "missing": (with_weights(lambda w: w.pop(ENCODER)), "1 missing tensors, such as .*weight. .*Export the agent"),
    "extra": (
        with_weights(lambda w: w.update({"critic.features_extractor.extractor.more": th.zeros(1)})),
        "1 unknown tensors, such as .*more",
    ),
    "no JSON": (lambda f: (f / "config.json").write_text("{"), "config.json is not JSON"),
    "deep JSON": (lambda f: (f / "config.json").write_text(DEEP), "config.json is not JSON"),
    "list": (lambda f: (f / "config.json").write_text("[]"), "format=None, this version reads 1"),
    "format": (lambda f: rewrite(f, "format", 2), "format=2, this version reads 1"),
    "part": (lambda f: rewrite(f, "observation_space", 1), "config.json: observation_space missing or of the wrong type"),
    "more": (lambda f: rewrite(f, "encoder.device", "cuda"), "config.json: unknown device"),
    "space": (lambda f: rewrite(f, "observation_space", {"type": "os.system"}), "is not a Box, Discrete or Dict"),
    "dtype of space": (lambda f: rewrite(f, "observation_space.dtype", "object"), "is not a Box, Discrete or Dict"),
    "size of space": (lambda f: rewrite(f, "observation_space.shape", [10**6, 10**6]), "is not a Box.* at most 16777216"),
}
HOSTILE_TO_ENCODERS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "system": (lambda f: rewrite(f, "encoder.features_extractor_class", "os.system"), "'os.system' is not one of MlpEncoder"),
    "Popen": (
        lambda f: rewrite(f, "encoder.features_extractor_class", "subprocess.Popen"),
        "config.json: features_extractor_class='subprocess.Popen' .* no other class is imported. Pass",
    ),
    "kwargs": (lambda f: rewrite(f, "encoder.features_extractor_kwargs", {"x": 1}), "config.json: no .* unexpected keyword"),
}
HOSTILE_TO_AGENTS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "policy": (lambda f: rewrite(f, "policy", "os.system"), "policy='os.system' is not one of MlpPolicy.*Pass load_agent"),
    "system": (
        lambda f: rewrite(f, "settings.policy_kwargs.features_extractor_class", "os.system"),
        r"features_extractor_class='os.system' .* no other class is imported. Pass load_agent\(\.\.\., policy_kwargs=",
    ),
    "optimizer": (
        lambda f: rewrite(f, "settings.policy_kwargs.optimizer_class", "subprocess.Popen"),
        r"optimizer_class='subprocess.Popen' is not one of Adam.*policy_kwargs=dict\(optimizer_class=",
    ),
    "buffer": (lambda f: rewrite(f, "settings.replay_buffer_class", ["Popen"]), r"replay_buffer_class=\['Popen'\] is not one"),
    "path": (lambda f: rewrite(f, "settings.tensorboard_log", "/tmp"), "BisimSAC has no argument 'tensorboard_log'"),
    "settings": (lambda f: rewrite(f, "settings.gamma", "high"), "config.json: no agent can be built from this"),
    "policy_kwargs": (lambda f: rewrite(f, "settings.policy_kwargs", 1), "policy_kwargs is no dict"),
    "ent_coef": (with_weights(lambda w: w.pop("log_ent_coef")), "1 missing tensors, such as log_ent_coef"),
}


def load_encoder(folder: Path) -> PretrainedEncoder:
    bound = np.array([1, 1, 8], dtype=np.float32)  # of pendulum
    return PretrainedEncoder(spaces.Box(-bound, bound), folder)


@pytest.mark.parametrize(
    ("load", "kind"),
    [(load_agent, kind) for kind in HOSTILE | HOSTILE_TO_AGENTS]
    + [(load_encoder, kind) for kind in HOSTILE | HOSTILE_TO_ENCODERS],
)
def test_a_hostile_file_is_refused_and_runs_nothing(exported: Path, load: Callable[[Path], Any], kind: str) -> None:
    damage, message = {**HOSTILE, **(HOSTILE_TO_AGENTS if load is load_agent else HOSTILE_TO_ENCODERS)}[kind]
    damage(exported)
    with pytest.raises(ValueError, match=message) as refused:
        load(exported)
    assert str(exported) in str(refused.value)
    assert not (exported / "marker").exists()


def test_the_pickle_would_have_run(tmp_path: Path) -> None:
    pickle.loads(pickle.dumps(Bomb(tmp_path / "marker")))
    assert (tmp_path / "marker").exists()


@pytest.mark.parametrize("name", ["config.json", "weights.safetensors"])
def test_a_missing_file_is_named(exported: Path, name: str) -> None:
    (exported / name).unlink()
    with pytest.raises(FileNotFoundError, match=f"{name} does not exist: pass the folder that export_agent wrote"):
        load_agent(exported)


# --- the encoder on its own


def lend(folder: Path, **kwargs: Any) -> dict[str, Any]:
    return dict(
        features_extractor_class=PretrainedEncoder, features_extractor_kwargs=dict(path=folder, **kwargs), net_arch=[8]
    )


def ppo(policy: str, folder: Path, freeze: bool = True, **kwargs: Any) -> Any:
    policy_kwargs = {**lend(folder, freeze=freeze), **kwargs}
    return PPO(policy, KINDS[policy](), n_steps=16, batch_size=8, n_epochs=1, policy_kwargs=policy_kwargs, seed=3)


@pytest.mark.parametrize("policy", KINDS)
def test_ppo_sees_the_same_embeddings(agents: Callable[[str], tuple[Any, Path]], policy: str) -> None:
    model, folder = agents(policy)
    algorithm = ppo(policy, folder)
    obs, _ = model.policy.obs_to_tensor(observations(model))
    with th.no_grad():
        z = model.policy.critic.features_extractor.encode(obs)
    encoder = algorithm.policy.features_extractor
    assert_same(algorithm.policy.extract_features(obs), z)  # divided by 255 by PPO
    assert_same(encoder(obs), z)  # on its own
    if policy != "MlpPolicy":
        unscaled = ppo(policy, folder, normalize_images=False)
        with pytest.raises(ValueError, match=r"observations: pixels up to 25\d.0, .* Use normalize_images=True"):
            unscaled.policy.extract_features({k: v.float() for k, v in obs.items()} if isinstance(obs, dict) else obs.float())


@pytest.mark.parametrize("share", [True, False])
def test_a_frozen_encoder_survives_initialisation_and_training(exported: Path, share: bool) -> None:
    algorithm = ppo("MlpPolicy", exported, share_features_extractor=share)
    trained = load_file(exported / "weights.safetensors")
    algorithm.learn(32)
    for encoder in (algorithm.policy.pi_features_extractor, algorithm.policy.vf_features_extractor):
        assert_same(encoder.encoder.extractor.net[1].weight, trained[ENCODER])
        assert not any(p.requires_grad for p in encoder.parameters())
        assert not encoder(th.ones(2, 3)).requires_grad
        encoder.train()
        assert not any(module.training for module in encoder.modules())


def test_a_thawed_encoder_starts_from_the_same_weights_and_learns(exported: Path) -> None:
    algorithm = ppo("MlpPolicy", exported, freeze=False)
    weight = algorithm.policy.features_extractor.encoder.extractor.net[1].weight
    trained = load_file(exported / "weights.safetensors")
    assert_same(weight.data, trained[ENCODER])
    algorithm.learn(16)
    assert not th.equal(weight, trained[ENCODER])


def test_other_algorithms_take_a_frozen_encoder(exported: Path) -> None:
    tqc: Any = TQC("MlpPolicy", pendulum(), learning_starts=5, batch_size=4, buffer_size=50, policy_kwargs=lend(exported))
    sac = make_model(policy_kwargs=lend(exported))
    trained = load_file(exported / "weights.safetensors")[ENCODER]
    assert_same(tqc.learn(12).critic.features_extractor.encoder.extractor.net[1].weight, trained)
    assert_same(sac.learn(12).critic.features_extractor.extractor.encoder.extractor.net[1].weight, trained)


def test_the_ball_is_part_of_the_encoder(tmp_path: Path) -> None:
    model = make_model(c_t=0.5, reward_range=(0.0, 0.01))  # so small that all embeddings lie on its surface
    export_agent(model, tmp_path)
    z = PretrainedEncoder(model.observation_space, tmp_path)(100 * th.randn(20, 3))
    th.testing.assert_close(z.norm(dim=1), th.full((20,), 0.01))


def test_an_encoder_refuses_other_observations(exported: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"observation_space=Box\(0.0, 1.0, \(2,\).* was trained with Box"):
        PretrainedEncoder(spaces.Box(0, 1, (2,)), exported)
    model = make_model("CnnPolicy", images(), policy_kwargs=dict(normalize_images=False))
    export_agent(model, tmp_path / "images")
    with pytest.raises(ValueError, match="normalize_images=False with images of bytes"):
        PretrainedEncoder(model.observation_space, tmp_path / "images")


def test_the_examples_of_the_documentation_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parents[1] / "docs" / "sharing.md").read_text()
    code = [block.split("```")[0] for block in page.split("```python\n")[1:]]
    assert len(code) >= 3
    monkeypatch.chdir(tmp_path)
    exec("\n".join(code), {})
