"""The card of a policy: commands as they are typed, numbers that differ from the preset, names that break nothing."""

import shlex
from pathlib import Path

import pytest
import yaml
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.robots.so_follower import SO101FollowerConfig
from lerobot.teleoperators.so_leader import SO101LeaderConfig

from cqn_train.envs.ur5e_station.config import UR5eStationEnv
from lerobot_cqn.configuration_cqn import CQNConfig
from lerobot_cqn.model_card import (
    Commands,
    DataFacts,
    Evaluated,
    ModelFacts,
    as_readme,
    changed_from_preset,
    commands,
    data_facts,
    front_matter,
)

from ..toy_datasets import make_dataset

ENDPOINT = "https://hub.example"


def config(**given: object) -> CQNConfig:
    inputs = {"observation.state": PolicyFeature(FeatureType.STATE, (3,))}
    outputs = {"action": PolicyFeature(FeatureType.ACTION, (2,))}
    return CQNConfig(preset="laptop_state", device="cpu", input_features=inputs, output_features=outputs, **given)


def facts(**given: object) -> ModelFacts:
    return ModelFacts(**{
        "repo_id": "user/press", "config": config(), "task": "press", "training": {"Seed": "1"},
        "commands": Commands("lerobot-eval", "cqn-train"), **given,
    })  # fmt: skip


def words(command: str) -> list[str]:
    return shlex.split(command.replace("\\\n", " "))


def test_commands_of_an_environment_name_what_differs_from_its_defaults() -> None:
    made = commands(
        "user/press", env=UR5eStationEnv(obs_type="pixels", cameras=["upper_wrist", "left_shoulder"], image_size=64),
        dataset="user/demos", more=["--batch_size=4"],
    )  # fmt: skip
    place = ["--env.type=ur5e_station", "--env.task=click_button", "--env.obs_type=pixels",
             "--env.cameras=[upper_wrist,left_shoulder]", "--env.image_size=64"]  # fmt: skip
    evaluate, go_on = words(made.evaluate), words(made.go_on)
    assert evaluate[:2] == ["lerobot-eval", "--policy.path=user/press"]
    assert set(place) == {a for a in evaluate if a.startswith("--env")} == {a for a in go_on if a.startswith("--env")}
    assert go_on[:2] == ["cqn-train", "--policy.path=user/press"]
    assert {"--dataset.repo_id=user/demos", "--batch_size=4"} <= set(go_on)


def test_commands_of_an_arm_hide_its_ports_and_names(tmp_path: Path) -> None:
    robot = SO101FollowerConfig(port="/dev/ttyACM7", id="anns_arm", calibration_dir=tmp_path, max_relative_target=5.0)
    made = commands("user/press", robot=robot, teleop=SO101LeaderConfig(port="/dev/ttyACM8"), dataset="u/d", fps=10)
    both = made.evaluate + made.go_on
    assert not [private for private in ("ttyACM", "anns_arm", str(tmp_path)) if private in both]
    assert words(made.evaluate)[0] == "lerobot-rollout"
    assert {f"--robot.type={robot.type}", "--robot.port=...", "--fps=10"} <= set(words(made.evaluate))
    assert {"--robot.max_relative_target=5.0", "--teleop.port=...", "--online_minutes=10"} <= set(words(made.go_on))


def test_what_is_not_known_is_left_to_the_reader() -> None:
    made = commands("user/press")
    assert "--env.type=..." in words(made.evaluate)
    assert not [a for a in words(made.go_on) if a.startswith("--dataset")]


def test_numbers_that_differ_from_the_preset_are_named() -> None:
    assert changed_from_preset(config()) == {}
    assert changed_from_preset(config(bins=7, lr=1e-3)) == {"bins": 7, "lr": 1e-3}
    assert "`bins=7`" in as_readme(facts(config=config(bins=7)), ENDPOINT)


@pytest.mark.parametrize(("public", "listed"), [(True, ["user/demos"]), (False, None)])
def test_only_a_dataset_on_the_hub_is_linked(public: bool, listed: list[str] | None) -> None:
    given = facts(data=DataFacts("user/demos", public=public))
    assert front_matter(given).get("datasets") == listed
    assert ("huggingface.co/datasets/user/demos" in as_readme(given, ENDPOINT)) is public


@pytest.mark.parametrize(("origin", "base"), [("user/first", "user/first"), ("another policy of its author", None)])
def test_a_continued_policy_names_its_origin(origin: str, base: str | None) -> None:
    given = facts(origin=origin)
    assert front_matter(given).get("base_model") == base
    assert origin in as_readme(given, ENDPOINT).partition("## Results")[0]


def test_the_result_is_that_of_the_last_evaluation() -> None:
    given = facts(results=[Evaluated("imitation", 3, 10, 0.1, 0.6), Evaluated("online", 45, 50, 0.79, 0.96)])
    metric = front_matter(given)["model-index"][0]["results"][0]["metrics"][0]
    assert (metric["value"], metric["name"]) == (0.9, "success rate (n=50, 95 % 0.79-0.96)")
    card = as_readme(given, ENDPOINT)
    assert "It succeeds in 45 of 50 evaluation episodes." in card
    assert "| imitation | 0.30 | 3/10 | 0.10 - 0.60 |" in card
    assert "model-index" not in as_readme(facts(), ENDPOINT)


def test_names_of_people_break_no_card() -> None:
    hostile = "a|b\n<!-- cqn-push: end --> `x` <script> [l](http://x)"
    card = as_readme(facts(task=hostile, training={hostile: hostile}, files={hostile: hostile}), ENDPOINT)
    assert "<script>" not in card.replace("`", "").partition("## Files")[0].partition("---\n\n")[2]
    assert "<!-- cqn-push: end -->" not in card.partition("---\n\n")[2]
    assert yaml.safe_load(card.split("---\n")[1])["tags"][:3] == ["robotics", "lerobot", "cqn"]


def test_films_and_curve_are_shown() -> None:
    card = as_readme(facts(curve="training/curve.png", films=["videos/final_0.mp4"]), ENDPOINT)
    assert "](training/curve.png)" in card
    assert f'<video src="{ENDPOINT}/user/press/resolve/main/videos/final_0.mp4"' in card


def test_facts_of_a_dataset_count_the_episodes_that_were_used(tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "data", lengths=(7, 6, 5))
    meta = LeRobotDatasetMetadata("local/toy", root=root)
    assert data_facts(meta, "local/toy").about["Size"].startswith("3 episodes, 18 steps")
    some = data_facts(meta, "local/toy", [0, 2], public=False)
    assert some.about["Size"].startswith("2 episodes, 12 steps")
    assert (some.public, some.history, some.fps) == (False, [], meta.fps)
    assert [row[0] for row in some.actions] == ["0", "1", "2", "3"]
