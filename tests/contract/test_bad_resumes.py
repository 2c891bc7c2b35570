"""Options that a resumed run would take no notice of, and errors in other people's plugins: one line for each."""

import logging
import sys
from pathlib import Path

import pytest

from cqn_train.cli import main

from .conftest import TINY_RUN

PLUGIN = """
import gymnasium as gym
from dataclasses import dataclass
from lerobot.envs.configs import EnvConfig
from lerobot.configs.types import FeatureType, PolicyFeature

@EnvConfig.register_subclass("broken_{name}")
@dataclass
class Broken(EnvConfig):
    task: str = "push"
    fps: int = 10
    features: dict = None
    features_map: dict = None

    @property
    def gym_kwargs(self):
        return {{}}

    def create_envs(self, n_envs, use_async_envs=False):
        raise RuntimeError("the simulator's licence\\nhas ended")
"""


@pytest.mark.parametrize(
    "option", ["--policy.lr=0.5", "--policy.bins=7", "--policy.preset=paper_rlbench", "--dataset.episodes=[0]"]
)
def test_options_without_effect_on_resume_are_refused(
    straight: Path, capfd: pytest.CaptureFixture[str], option: str
) -> None:
    before = {path: path.stat().st_mtime_ns for path in straight.rglob("*")}
    assert main(["--resume=true", f"--output_dir={straight}", option]) == 2
    said = capfd.readouterr().err.strip().splitlines()[-1]
    assert said.startswith(f"cqn-train: error: {option} has no effect on --resume: the run goes on with ")
    assert before == {path: path.stat().st_mtime_ns for path in straight.rglob("*")}


def test_the_same_value_again_is_no_mistake(straight: Path, tmp_path: Path) -> None:
    import shutil

    from cqn_train.arguments import parse

    run = shutil.copytree(straight, tmp_path / "run", symlinks=True)
    hidden = next(option for option in TINY_RUN if option.startswith("--policy.hidden_dim"))
    assert parse(["--resume=true", f"--output_dir={run}", hidden, "--steps=70"]).steps == 70


def test_an_error_in_a_plugin_names_it(
    click: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "lab_env_plugin").mkdir()
    (tmp_path / "lab_env_plugin/__init__.py").write_text(PLUGIN.format(name=tmp_path.name[-8:].replace("-", "_")))
    monkeypatch.syspath_prepend(tmp_path)
    kind = f"--env.type=broken_{tmp_path.name[-8:].replace('-', '_')}"
    run = [option for option in TINY_RUN if not option.startswith("--env.")]
    line = [*run, *click, "--env.discover_packages_path=lab_env_plugin", kind, f"--output_dir={tmp_path / 'out'}"]
    assert main(line) == 1
    logging.disable(logging.NOTSET)
    err = capfd.readouterr().err.strip().splitlines()
    assert err[-1].startswith(
        "cqn-train: error: the plugin 'lab_env_plugin' failed: RuntimeError: the simulator's licence has"
    )
    assert "Traceback" not in "\n".join(err)
    with pytest.raises(RuntimeError):
        main([*line, "--debug"])
    sys.modules.pop("lab_env_plugin", None)
