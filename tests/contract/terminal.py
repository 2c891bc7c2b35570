"""Demonstrations as a person records them with lerobot-record: at a terminal, with its keys."""

import sys
from pathlib import Path

from cqn_train.sim_arm.keyboard import RECORD_KEYS, Terminal


def record_demonstrations(folder: Path, *robot: str, episodes: int) -> Path:
    """Demonstrations `local/demos` of lerobot-record in `folder/demos`, which is returned; `robot`: more of its flags.

    As a person at the terminal: ends the episode when the task is done, and the reset when the arm is home.
    """
    root = folder / "demos"
    terminal = Terminal(
        [
            str(Path(sys.executable).parent / "lerobot-record"),
            "--robot.type=sim_ur5e", "--robot.id=sim", "--robot.speed=4", *robot, "--teleop.type=sim_leader",
            "--teleop.id=leader", "--teleop.hold_s=0.4", "--dataset.repo_id=local/demos", f"--dataset.root={root}",
            "--dataset.fps=40", f"--dataset.num_episodes={episodes}", "--dataset.single_task=Press the red button.",
            "--dataset.episode_time_s=30", "--dataset.reset_time_s=30", "--dataset.push_to_hub=false",
            "--play_sounds=false",
        ],
        folder,
    )  # fmt: skip
    assert terminal.run(RECORD_KEYS, 300) == 0, terminal.said[-3000:]
    return root
