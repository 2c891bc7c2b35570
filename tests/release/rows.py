"""How a command of LeRobot is tried, and what came of it is judged: by files and messages, never by a table."""

import json
import re
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .environments import Done

WORKS, NOT, UNCONCERNED = "works", "does not", "not concerned"
KEYBOARD = ("python", "-m", "cqn_train.sim_arm.keyboard")  # a person who presses the keys that lerobot-record asks for

# Long options under the names that the page uses for them.
SHORT: Mapping[str, str] = {
    "CQN": "--policy.type=cqn --policy.preset=laptop_state --policy.hidden_dim=16 --policy.device=cpu",
    "RUN": "--policy.push_to_hub=false --batch_size=4 --num_workers=0 --log_freq=1 --wandb.enable=false",
    "DATA": "--dataset.repo_id=local/clean --dataset.root=clean",
    "STATION": "--env.type=ur5e_station --env.obs_type=state --env.episode_length=10",
    "ONE": "--eval.n_episodes=1 --eval.batch_size=1",
    "EDIT": "lerobot-edit-dataset --repo_id=local/clean --root=clean",
    "ARM": "--robot.type=sim_ur5e --robot.id=sim --robot.state=true --robot.camera_names=[]",
    "HEX": "--robot.type=hex_arm_sim_follower --robot.headless=true --robot.id=hex",
    "LEADER": "--teleop.type=sim_leader --teleop.id=sim",
    "POLICY": "--policy.path=arm_offline/checkpoints/last/pretrained_model",
    "RL": "--policy.type=cqn --policy.discover_packages_path=lerobot_cqn --policy.push_to_hub=false "
    "--env.type=gym_manipulator --job_name=rl",
}

Judge = Callable[[Done, Path], str]  # nothing where it did what it should, otherwise what is wrong


def expand(line: str) -> list[str]:
    """The words of a line, with all its options."""
    return shlex.split(re.sub(r"\$([A-Z]+)", lambda found: SHORT[found[1]], line))


@dataclass(frozen=True)
class Try:
    """One way to run a command.

    Attributes:
        line: the command as the page shows it; $NAME stands for options of SHORT.
        judge: looks at what came of it.
        keys: a person at the keyboard is needed.
        label: for a second way: what it takes, after "works with".
        shown: what the page shows instead of the line.
        hub: it needs a Hub, whose files are found in `hub/` afterwards.
    """

    line: str
    judge: Judge
    keys: bool = False
    label: str = ""
    shown: str = ""
    hub: bool = False

    def command(self) -> list[str]:
        """The command with all its options, as a list."""
        return [*KEYBOARD, *expand(self.line)] if self.keys else expand(self.line)


@dataclass(frozen=True)
class Row:
    """A row of the page.

    Attributes:
        command: console script, or `python -m module`.
        tries: the plain way, then ways around it; the first that succeeds decides.
        notes: pattern -> what to say where a failure's output, or else the success's, contains it; "" always does.
        around: what to do instead where no way succeeds.
        concerned: whether it takes a policy, a dataset or an arm of ours at all.
        then: lines to run afterwards, for the rows that follow.
        target: dataset that it makes of `clean`; it is looked at whether history and bounds were kept.
    """

    command: str
    tries: tuple[Try, ...]
    notes: Mapping[str, str] = field(default_factory=dict)
    around: str = ""
    concerned: bool = True
    then: tuple[str, ...] = ()
    target: str = ""


@dataclass(frozen=True)
class Outcome:
    """What came of a row: its verdict, the line that decided, and what there is to say."""

    row: Row
    verdict: str
    line: str
    remark: str

    def markdown(self) -> str:
        """As a row of the page's table."""
        line = self.line.replace("|", "\\|")
        return f"| `{self.row.command}` | {self.verdict} | `{line}` | {self.remark} |"


def judge_row(row: Row, run: Callable[[Try], Done], folder: Path) -> Outcome:
    """Run the ways of a row until one succeeds."""
    first_wrong = ""
    for number, one in enumerate(row.tries):
        done = run(one)
        wrong = one.judge(done, folder)
        if number == 0:
            first_said, first_wrong = done.said, wrong
        if not wrong:
            verdict = f"works with {one.label}" if number else WORKS
            remark = _remark(row, first_said if number else done.said, first_wrong)
            return Outcome(row, verdict if row.concerned else UNCONCERNED, one.shown or one.line, remark)
    remark = _remark(row, first_said, first_wrong)
    if row.around:
        remark += f" Instead: {row.around}"
    line = row.tries[0].shown or row.tries[0].line
    return Outcome(row, NOT if row.concerned else UNCONCERNED, line, remark)


def _remark(row: Row, said: str, wrong: str) -> str:
    found = [text for pattern, text in row.notes.items() if pattern and re.search(pattern, said)]
    if wrong and not found and (row.concerned or "" not in row.notes):
        plain = re.sub(r"https?://\S+", "...", wrong.replace("|", "/"))
        found = [f"It ends with: {' '.join(plain.split())[:300]}"]
    return " ".join([*found, *([row.notes[""]] if "" in row.notes else [])])


# --- Judges


def ends_well(done: Done, folder: Path) -> str:
    """Exit status 0."""
    return "" if not done.code else done.last_line


def writes(*patterns: str) -> Judge:
    """Exit status 0, and files that match each pattern."""

    def judge(done: Done, folder: Path) -> str:
        missing = [pattern for pattern in patterns if not list(folder.glob(pattern))]
        return ends_well(done, folder) or (f"no {', '.join(missing)}" if missing else "")

    return judge


def says(pattern: str) -> Judge:
    """Exit status 0, and this in what it prints."""
    return lambda done, folder: (
        ends_well(done, folder) or ("" if re.search(pattern, done.said) else f"{pattern} is not said")
    )


def read_json(folder: Path, name: str) -> dict[str, Any]:
    """A file of the folder."""
    return json.loads((folder / name).read_text(encoding="utf-8"))


def reaches(run: str, steps: int) -> Judge:
    """The last checkpoint of a run is of this step."""

    def judge(done: Done, folder: Path) -> str:
        if wrong := ends_well(done, folder):
            return wrong
        found = read_json(folder, f"{run}/checkpoints/last/training_state/training_step.json")["step"]
        return "" if found == steps else f"the last checkpoint is of step {found}, not {steps}"

    return judge


def holds(root: str, episodes: int, feature: str = "", there: bool = True) -> Judge:
    """A dataset with so many episodes; with a feature, or without it."""

    def judge(done: Done, folder: Path) -> str:
        if wrong := ends_well(done, folder):
            return wrong
        info = read_json(folder, f"{root}/meta/info.json")
        if info["total_episodes"] != episodes:
            return f"{info['total_episodes']} episodes instead of {episodes}"
        return f"{feature} is there: {not there}" if feature and (feature in info["features"]) != there else ""

    return judge


def evaluates(folder_name: str) -> Judge:
    """Results and films of lerobot-eval."""
    return writes(f"{folder_name}/eval_info.json", f"{folder_name}/videos/**/*.mp4")


def what_is_kept(source: Path, target: Path) -> str:
    """Whether a dataset kept the history of `cqn-data` and the action bounds of its source."""
    history = (target / "meta/cqn_history.json").exists()
    bounds = [read_json(root, "meta/stats.json")["action"] for root in (source, target)]
    same = all(bounds[0][end] == bounds[1][end] for end in ("min", "max"))
    said = f"The history of `cqn-data` is {'kept' if history else 'left behind'}, action bounds are "
    return said + ("kept." if same else "those of the data again: run `cqn-data bounds` where there was a margin.")
