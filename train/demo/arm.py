"""`make demo-arm`: lerobot-record on the simulated arm -> dataset recipe -> CQN online, with a simulated person.

Everything runs as on a real arm: the demonstrations are recorded by LeRobot's own command, the arm moves by the clock,
and the person answers at the operator's page. Interrupted at any moment, it continues where it was when started again.
"""

import json
import os
import secrets
import sys
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from ..interfaces import PAGE_TOKEN
from ..run.metrics import read_rows
from ..run.progress import last_line
from .config import ArmDemoConfig, So101DemoConfig
from .stages import Stages, Watched, fresh, run_once

__all__ = ["arm_progress", "arm_summary", "arm_table", "main", "run_demo"]

AnyArmDemo = ArmDemoConfig | So101DemoConfig

CLOCK = 4  # simulated seconds in a real one
RATE = 10  # control steps in a simulated second


def run_demo(config: ArmDemoConfig, console: Console) -> dict[str, Any]:
    """The demo from recording to picture; returns what `summary.json` holds. Raises DemoError when a command fails."""
    stages = Stages(config.output_dir, console)
    raw, clean, run = (config.output_dir / name for name in ("data/raw", "data/clean", "run"))
    arm = ("--robot.type=sim_ur5e", f"--robot.speed={CLOCK}", "--robot.state=true", f"--robot.seed={config.seed}")
    with stages.timed():
        stages.run(
            "record", f"lerobot-record: {config.demonstrations} demonstrations", raw,
            "cqn_train.sim_arm.keyboard", "lerobot-record", *arm, "--robot.id=demo", "--robot.camera_names=[]",
            "--teleop.type=sim_leader", "--teleop.id=demo", "--teleop.pause_share=0.3", "--teleop.hold_s=0.5",
            "--dataset.repo_id=demo/raw", f"--dataset.root={raw}", f"--dataset.fps={CLOCK * RATE}",
            f"--dataset.num_episodes={config.demonstrations}", "--dataset.single_task=Press the red button.",
            "--dataset.episode_time_s=60", "--dataset.reset_time_s=60", "--dataset.push_to_hub=false",
            "--play_sounds=false",
        )  # fmt: skip
        stages.run(
            "recipe", "cqn-data: pauses out, joint differences, bounds", clean, "cqn_data.cli", "run", "arm_state",
            "--repo_id=demo/raw", f"--root={raw}", "--new_repo_id=demo/clean", f"--new_root={clean}",
        )  # fmt: skip
        _train(stages, config, clean, run, arm)
    return arm_summary(stages, config, run)


def arm_summary(stages: Stages, config: AnyArmDemo, run: Path) -> dict[str, Any]:
    """Draw session.png of a finished run, and write and return what `summary.json` holds."""
    from .figures import arm_session

    episodes, evaluations = read_rows(run / "episodes.csv"), read_rows(run / "evaluations.csv")
    summary = {
        "config": {name: str(value) for name, value in vars(config).items()},
        "wall_s": round(stages.seconds(), 1),
        "online_minutes": round(_online_minutes(run), 2),
        "episodes": len(episodes),
        "taught_steps": sum(int(row["taught"]) for row in episodes),
        **{
            phase: {name: float(row[name]) for name in ("success_rate", "successes", "n", "ci_low", "ci_high")}
            for row in evaluations
            if (phase := row["phase"]) in ("offline", "final")
        },
        "control": last_line(stages.logs / "train.log", "Control:"),
    }
    (config.output_dir / "session.png").write_bytes(arm_session(episodes, evaluations))
    (config.output_dir / "summary.json").write_text(json.dumps(summary, indent=2))
    return summary


def _train(stages: Stages, config: ArmDemoConfig, data: Path, run: Path, arm: tuple[str, ...]) -> None:
    """Online training with a progress bar, from the last checkpoint where there is one."""
    if any(row["phase"] == "final" for row in read_rows(run / "evaluations.csv")):
        return
    stages.environment[PAGE_TOKEN] = os.environ.get(PAGE_TOKEN) or secrets.token_urlsafe(16)
    if (run / "checkpoints" / "last").exists():
        arguments = ["--resume=true", f"--output_dir={run}"]
    else:
        arguments = [
            "--policy.type=cqn", "--policy.preset=laptop_state", "--policy.device=cpu", *arm,
            "--robot.camera_names=[left_shoulder]", "--robot.image_height=168", "--robot.image_width=224",
            f"--robot.person=http://127.0.0.1:{config.port}", "--robot.person_takes_over_s=3.5",
            f"--robot.person_helps_episodes={config.helped_episodes}",
            "--teleop.type=sim_leader", "--dataset.repo_id=demo/clean", f"--dataset.root={data}",
            f"--output_dir={fresh(run)}", f"--seed={config.seed}", f"--offline_updates={config.offline_updates}",
            f"--steps={config.steps}", f"--eval.final_n_episodes={config.eval_episodes}",
            f"--arm.episode_s={config.episode_s / CLOCK}", f"--page.port={config.port}", "--threads=1",
            "--updates_per_episode=100", "--save_freq=500",
        ]  # fmt: skip
    process = stages.start("train", "cqn_train.cli", *arguments)
    page = f"http://127.0.0.1:{config.port}/?token={stages.environment[PAGE_TOKEN]}"
    stages.console.print(f"  watch it at the operator's page: {page}", soft_wrap=True)
    training = Watched(
        process=process, text="online training", total=config.steps,
        progress=partial(arm_progress, run, config.eval_episodes),
    )  # fmt: skip
    stages.watch({"train": training})


def arm_progress(run: Path, eval_episodes: int) -> tuple[int, str]:
    """Steps that a run on an arm has made online, and how it goes."""
    episodes, evaluations = read_rows(run / "episodes.csv"), read_rows(run / "evaluations.csv")
    if not evaluations:
        return 0, f"imitation, then {eval_episodes} episodes to evaluate it"
    if not episodes:
        return 0, f"success {float(evaluations[-1]['success_rate']):.2f} after imitation"
    lately = [int(row["success"]) for row in episodes[-5:]]
    return int(episodes[-1]["env_steps"]), f"episode {len(episodes)}, {sum(lately)} of the last {len(lately)} succeed"


def _online_minutes(run: Path) -> float:
    progress = json.loads((run / "checkpoints/last/training_state/progress.json").read_text())
    return float(progress["counters"]["online_s"]) / 60


def arm_table(title: str, summary: dict[str, Any], config: AnyArmDemo, console: Console) -> None:
    """The short table of a session on an arm, and where its files are."""
    table = Table(title=title, title_justify="left")
    for column, side in (("policy", "left"), ("success", "right"), ("95 % interval", "right")):
        table.add_column(column, justify="right" if side == "right" else "left")
    after = f"after {summary['online_minutes']:.1f} minutes online, {summary['episodes']} episodes"
    for phase, text in (("offline", f"imitation of {config.demonstrations} demonstrations"), ("final", after)):
        row = summary[phase]
        table.add_row(
            text, f"{row['success_rate']:.2f} ({row['successes']:.0f}/{row['n']:.0f})",
            f"{row['ci_low']:.2f} - {row['ci_high']:.2f}",
        )  # fmt: skip
    console.print(table)
    console.print(f"{summary['control']}\npicture  {config.output_dir / 'session.png'}", soft_wrap=True)
    console.print(f"policy   {config.output_dir / 'run' / 'checkpoints' / 'last' / 'pretrained_model'}")


def show(summary: dict[str, Any], config: ArmDemoConfig, console: Console) -> None:
    """The short table at the end."""
    arm_table("click_button on the simulated arm, judged by the simulated person", summary, config, console)


def main() -> int:
    """Entry of `python -m cqn_train.demo.arm`."""
    introduction = "CQN on a simulated arm with a simulated person at the operator's page: about 10 minutes"
    return run_once("demo-arm", ArmDemoConfig, introduction, run_demo, show)


if __name__ == "__main__":
    sys.exit(main())
