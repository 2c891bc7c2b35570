"""Bad command lines of every command: exit code 2, one line that names the option, and nothing written.

What a line must name is the second entry; `.` stands for the option itself. Commands run in this process.
"""

import json
import logging
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from cqn_data.cli import main as cqn_data
from cqn_train.bench.cli import main as cqn_bench
from cqn_train.cli import main as cqn_train
from cqn_train.push.cli import main as cqn_push

from .conftest import STATION, TINY_POLICY

PLAN = {"common": [*STATION, "--steps=5"], "methods": {"a": TINY_POLICY}, "tasks": {"b": []}, "seeds": [1]}
PLANS: dict[str, dict[str, object]] = {
    "plan": {}, "no_seeds": {"seeds": []}, "twice": {"seeds": [1, 1]}, "words": {"common": ["steps=5"]},
    "folder": {"tasks": {"a/b": []}}, "key": {"method": {}}, "score": {"score": "nothing"},
    "option": {"methods": {"a": [*TINY_POLICY, "--policy.nothing=1"]}},
    "number": {"methods": {"a": [*TINY_POLICY, "--policy.bins=0"]}},
}  # fmt: skip
# In the station, with its demonstrations: all that is wrong is the line itself.
TRAIN = {
    "--steps=-1": "steps",
    "--steps=abc": "steps",
    "--steps=1e9999": "steps",
    "--steps=": "steps",
    "--steps": "steps",
    "--offline_updates=-5": "offline_updates",
    "--batch_size=-1": "batch_size",
    "--batch_size=100000000": "batch_size",
    "--demo_batch_size=-1": "demo_batch_size",
    "--batch_size=0 --demo_batch_size=0": "A batch of nothing",
    "--seed=99999999999999": "seed",
    "--seed=-1": "seed",
    "--threads=-1": "threads",
    "--threads=100000": "threads",
    "--eval.freq=-1": "eval.freq",
    "--eval.n_episodes=-1": "eval.n_episodes",
    "--eval.batch_size=0": "eval.batch_size",
    "--eval.final_n_episodes=-3": "eval.final_n_episodes",
    "--eval.videos=-1": "eval.videos",
    "--save_freq=0": "save_freq",
    "--log_freq=0": "log_freq",
    "--policy.bins=0": "bins",
    "--policy.bins=1": "bins",
    "--policy.levels=0": "levels",
    "--policy.levels=99": "levels",
    "--policy.lr=nan": "lr",
    "--policy.lr=-1": "lr",
    "--policy.lr=inf": "lr",
    "--policy.discount=-1": "discount",
    "--policy.discount=2": "discount",
    "--policy.n_step=0": "n_step",
    "--policy.n_step=1000000": "n_step",
    "--policy.frame_stack=99": "frame_stack",
    "--policy.frame_stack=0": "frame_stack",
    "--policy.v_min=5": "v_min",
    "--policy.atoms=1": "atoms",
    "--policy.preset=nothing": "nothing",
    "--policy.device=tpu": "tpu",
    "--policy.hidden_dim=0": "hidden_dim",
    "--policy.state_bound=-1": "state_bound",
    "--policy.weight_decay=-1": "weight_decay",
    "--policy.nothing=1": "--policy.nothing",
    "--nothing=1": "--nothing",
    "-steps=5": "-steps",
    "steps=5": "'steps'",
    "--env.task=nothing": "nothing",
    "--env.obs_type=nothing": "nothing",
    "--env.nothing=1": "--env.nothing",
    "--env.fps=-1": "fps is -1",
    "--dataset.episodes=[0,0]": "dataset.episodes",
    "--dataset.episodes=[99]": "dataset.episodes",
    "--dataset.episodes=[]": "dataset.episodes",
    "--dataset.episodes=abc": "dataset.episodes",
    "--dataset.root=nowhere": "nowhere",
    "--output_dir=full": "full exists",
    "--updates_per_step=-1": "updates_per_step",
    "--updates_per_step=1000000": "updates_per_step",
    "--updates_per_episode=-1": "updates_per_episode",
    "--replay.capacity_gib=-1": "replay.capacity_gib",
    "--replay.capacity_gib=0": "replay.capacity_gib",
    "--replay.capacity_gib=nan": "replay.capacity_gib",
    "--replay.sampling=nothing": "replay.sampling",
    "--relabel=perhaps": "relabel",
    "--async_updates=-1": "async_updates",
    "--online_minutes=-1": "online_minutes",
    "--online_minutes=nan": "online_minutes",
    "--action_bounds=nothing": "action_bounds",
    "--wandb.mode=nothing": "wandb.mode",
    "--page.port=99999": "--page.",
    "--arm.fps=1000": "--arm.",
    "--teleop.type=keyboard": "--teleop.type",
    "--policy.path=nowhere": "nowhere",
    "--policy.path=full": "config.json",
    "--config_path=nowhere.json": "nowhere.json",
    "--config_path=torn.yaml": "torn.yaml",
    "--resume=true --output_dir=nowhere": "nowhere",
    "--resume=true --output_dir=full": "full",
    "--env.discover_packages_path=nothing_there": "nothing_there",
    "--robot.type=sim_ur5e": "--env.type or --robot.type",
    "--policy.type=nothing": "nothing",
    "--env.type=nothing": "nothing",
    "--policy.push_to_hub=true --policy.repo_id=x": "--policy.repo_id",
    "--eval.use_async_envs=2": "eval.use_async_envs",
}
# `.` stands for the toy recording and a new folder.
DATA = {
    "nothing": "nothing",
    "filter": "--repo_id",
    "filter --nothing=1 .": "--nothing",
    "filter --threshold=0 .": "threshold",
    "filter --threshold=nan .": "threshold",
    "filter --threshold=abc .": "threshold",
    "filter --threshold=-1 .": "threshold",
    "filter --auto --threshold=1 .": "--auto",
    "filter --keep_last=0 .": "--keep_last",
    "filter --min_pause=0 .": "--min_pause",
    "filter --compare=sideways .": "--compare",
    "filter --preview=x.gif .": "--preview",
    "filter --joint_thresholds={a:1} .": "--joint_thresholds",
    "filter --joint_thresholds=5 .": "joint_thresholds",
    'filter --joint_thresholds={"a":1} .': "joint 'a'",
    "filter --gripper_names=[nothing] .": "nothing",
    "filter --episode_thresholds={9:1} .": "--episode_thresholds",
    'filter --episode_thresholds={"9":1} .': "No episode 9",
    "trim .": "--head",
    "trim --head=-1 .": "--head",
    "trim --head=1 --head_seconds=1 .": "steps or seconds",
    "trim --head=100000 .": "episode 0",
    'trim --cuts={"0":[1]} .': "--cuts",
    "trim --min_steps=0 --head=1 .": "--min_steps",
    "delta --to=sideways .": "--to",
    "delta --of=nothing .": "--of",
    "delta --to=absolute .": "--actions",
    "delta --keep_absolute=[nothing] .": "nothing",
    "resample .": "--fps",
    "resample --fps=0 .": "--fps",
    "resample --fps=1000 .": "1000",
    "resample --fps=abc .": "fps",
    "resize --size=[0,0] .": "--size",
    "resize --size=[1] .": "--size",
    "resize .": "no camera",
    "label .": "--all",
    "label --all --failed=[0] .": "--failed",
    "label --episodes=[99] .": "No episode 99",
    "label --column=nothing .": "nothing",
    "label --rule=abc .": "abc",
    "label --rule=steps< .": "steps<",
    "bounds --margin=-1 .": "--margin",
    "bounds --quantile=2 .": "--quantile",
    "bounds --margin=abc .": "margin",
    "drop .": "--episodes",
    "drop --episodes=[99] .": "No episode 99",
    "drop --where=abc .": "abc",
    "drop --where=steps>0 .": "Every episode",
    "task .": "--new_task",
    'task --episode_tasks={"9":"x"} .': "No episode 9",
    "run .": "Name a recipe",
    "run nothing .": "nothing",
    "run torn.yaml .": "torn.yaml",
    "run empty.yaml .": "empty.yaml",
    "run list.yaml .": "list.yaml",
    "run simulation --filter.nothing=1 .": "nothing",
    "run simulation --nothing.x=1 .": "--nothing",
    "inspect --nothing=1": "--nothing",
    "inspect --repo_id=local/toy --root=nowhere": "nowhere",
    "inspect --repo_id=local/toy --root=nowhere --html=full": "full exists",
    "record": "--repo_id",
    "record --env.type=nothing --repo_id=a/b": "nothing",
    "record --env.type=ur5e_station --env.task=nothing --repo_id=a/b --root=new": "nothing",
    "record --env.type=ur5e_station --repo_id=a/b --root=full": "full exists",
    "record --env.type=ur5e_station --repo_id=a/b --root=new --episodes=0": "--episodes",
    "record --env.type=ur5e_station --repo_id=a/b --root=new --pause_share=2": "--pause_share",
    "convert": "--from",
    "convert --from=nothing --input=x --new_repo_id=a/b": "--from",
    "convert --from=aloha --input=nowhere --new_repo_id=a/b": "--input",
    "convert --from=aloha --input=full --new_repo_id=a/b --new_root=new": "full",
    "convert --from=robomimic --input=full/x --new_repo_id=a/b --new_root=new": "full/x",
    "convert --from=npz --input=full --fps=0 --new_repo_id=a/b --new_root=new": "--fps",
    "convert --from=npz --input=full --action_keys=[a] --new_repo_id=a/b --new_root=new": "--action_keys",
    "merge": "--repo_ids",
    "merge --repo_ids=[a/b] --new_repo_id=a/c": "--repo_ids",
    "merge --repo_ids=[a/b,c/d] --new_repo_id=": "--new_repo_id",
    "merge --repo_ids=[a/b,c/d] --roots=[toy] --new_repo_id=a/c --new_root=new": "--roots",
    "merge --repo_ids=[a/b,c/d] --roots=[toy,nowhere] --new_repo_id=a/c --new_root=new": "nowhere",
    "push --nothing=1": "--nothing",
    "push --repo_id=nothing": "--repo_id",
    "push --repo_id=user/x --root=toy --license=??": "--license",
    "push --repo_id=user/x --root=nowhere --dry_run": "nowhere",
    "push --repo_id=user/x --root=toy": "HF_HUB_OFFLINE",
    "review --repo_id=local/toy --root=toy --recipe=x.json": "--recipe",
    "review --repo_id=local/toy --root=toy --port=70000": "70000",
    "review --repo_id=local/toy --root=toy --token=a": "token",
    "label --all --crf=100 .": "--crf",
    "label --all --actions=nothing .": "--actions",
    "label --all --private .": "--private",
    "label --all --push_to_hub --new_repo_id=user/x .": "HF_HUB_OFFLINE",
    "label --all --revision=main .": "--revision",
    "label --all --repo_id=local/toy --root=toy --new_root=full": "full exists",
    "label --all --repo_id=local/toy --root=toy --new_root=toy/inside": "inside the source",
    "label --all --repo_id=local/toy --root=nowhere --new_root=new": "nowhere",
    "label --all --report=torn.yaml .": "torn.yaml",
    "label --all --root .": "--root",
    "label all .": "'all'",
}
PUSH = {
    "--run=nowhere --repo_id=user/x --dry_run": "nowhere",
    "--run=full --repo_id=user/x --dry_run": "full",
    "--run=full": "--repo_id",
    "--nothing=1": "--nothing",
    "--run=full --repo_id=x": "--repo_id",
    "--run=full --repo_id=user/x --license=??": "--license",
    "--repo_id=user/x": "--run",
    "--run=torn.yaml --repo_id=user/x --dry_run": "torn.yaml",
    "--run=full --repo_id=user/x": "HF_HUB_OFFLINE",
}
BENCH = {
    "empty.yaml": "--output_dir",
    "--output_dir=out": "Name a plan first",
    "nowhere.yaml --output_dir=out": "nowhere.yaml",
    "torn.yaml --output_dir=out": "torn.yaml",
    "empty.yaml --output_dir=out": "empty.yaml",
    "list.yaml --output_dir=out": "list.yaml",
    "empty.yaml --nothing=1": "--nothing",
    "plan.yaml --output_dir=out --processes=0": "--processes",
    "plan.yaml --output_dir=out --processes=many": "--processes",
    "no_seeds.yaml --output_dir=out": "seeds",
    "twice.yaml --output_dir=out": "seeds",
    "words.yaml --output_dir=out": "common",
    "folder.yaml --output_dir=out": "becomes a folder",
    "key.yaml --output_dir=out": "method",
    "score.yaml --output_dir=out": "score",
    "option.yaml --output_dir=out": "--policy.nothing",
    "number.yaml --output_dir=out": "bins",
}


@pytest.fixture
def desk(rewarded: list[str], click: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with files that are not what a line takes them for, and links to two datasets."""
    for name, given in (("toy", rewarded), ("click", click)):
        (tmp_path / name).symlink_to(given[1].partition("=")[2])
    for name, text in (("torn.yaml", "a: [b"), ("empty.yaml", ""), ("list.yaml", "- a\n")):
        (tmp_path / name).write_text(text)
    for name, change in PLANS.items():
        (tmp_path / f"{name}.yaml").write_text(json.dumps({**PLAN, **change}))
    (tmp_path / "full").mkdir()
    (tmp_path / "full/x").write_text("1")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    return tmp_path


def refused(
    command: Callable[[list[str]], int], line: list[str], desk: Path, capsys: pytest.CaptureFixture[str], said: str
) -> None:
    before, environment = sorted(desk.rglob("*")), dict(os.environ)
    try:
        code = command(line)
    except SystemExit as stopped:
        code = int(stopped.code or 0)
    finally:
        logging.disable(logging.NOTSET)
        os.environ.clear()
        os.environ.update(environment)
    err = capsys.readouterr().err
    lines = [one for one in err.strip().splitlines() if "error:" in one]
    assert code == 2, err
    assert "Traceback" not in err
    assert len(lines) == 1, err
    assert lines == err.strip().splitlines()[-1:]
    assert said in lines[0]
    assert sorted(desk.rglob("*")) == before


@pytest.mark.parametrize("line", TRAIN)
def test_cqn_train(line: str, desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = line.split(" ")
    usual = [*TINY_POLICY, *STATION, "--dataset.repo_id=local/click", "--dataset.root=click", "--output_dir=out"]
    names = [option.partition("=")[0] for option in given]
    kept = [] if "--resume" in names else [option for option in usual if option.partition("=")[0] not in names]
    if "--policy.path" in names:
        kept = [option for option in kept if not option.startswith("--policy.")]
    refused(cqn_train, [*kept, *given], desk, capsys, TRAIN[line])


@pytest.mark.parametrize("line", DATA)
def test_cqn_data(line: str, desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    toy = ["--repo_id=local/toy", "--root=toy", "--new_root=new"]
    given = [part for word in line.split(" ") for part in (toy if word == "." else [word])]
    refused(cqn_data, given, desk, capsys, DATA[line])


@pytest.mark.parametrize("line", PUSH)
def test_cqn_push(line: str, desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    refused(cqn_push, line.split(" "), desk, capsys, PUSH[line])


@pytest.mark.parametrize("line", BENCH)
def test_cqn_bench(line: str, desk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    refused(cqn_bench, line.split(" "), desk, capsys, BENCH[line])


def test_there_are_enough_of_them() -> None:
    assert len({*TRAIN, *DATA, *PUSH, *BENCH}) >= 150
