"""Robots that other people made, from recording to training, the way they are tried (rows.py)."""

from .rows import Row, Try, ends_well, holds, says

__all__ = ["PLUGINS", "ROBOTS"]

# Plugins on the package index that need no hardware, and what they forget to ask for.
PLUGINS = ("lerobot_robot_hex_arm_sim", "lerobot_teleoperator_dummy", "hex_device", "hex_robo_utils")
RECORD = "--dataset.fps=10 --dataset.num_episodes=1 --dataset.episode_time_s=4 --dataset.reset_time_s=0 "
QUIET = "--dataset.single_task=Wait --dataset.push_to_hub=false --play_sounds=false"
TRAIN = (
    "--offline_updates=1 --steps=10 --threads=1 --arm.fps=10 --operator_page --page.port=8791 --arm.go_home=false "
    "--output_dir"
)
POSITIONS = "Refused by name before any work: to hold what is commanded by velocities would be to drive on."

ROBOTS = (
    Row(
        "lerobot-record",
        (
            Try(
                f"lerobot-record $HEX --teleop.type=hex_dummy_leader --dataset.repo_id=local/hex --dataset.root=hex "
                f"{RECORD}{QUIET}",
                holds("hex", 1),
            ),
        ),
        {"": "`lerobot_robot_hex_arm_sim`: an arm in MuJoCo with a camera, and a leader that stands still."},
    ),
    Row(
        "cqn-data inspect",
        (Try("cqn-data inspect --repo_id=local/hex --root=hex", says("No action ever changes")),),
        {"": "Says that its leader never moves, and which dimensions are velocities."},
    ),
    Row(
        "cqn-data run",
        (
            Try(
                "cqn-data run paper_real_world --repo_id=local/hex --root=hex --new_repo_id=local/hex_clean "
                "--new_root=hex_clean",
                holds("hex_clean", 1),
            ),
        ),
    ),
    Row(
        "cqn-train",
        (
            Try(
                f"cqn-train $HEX --policy.type=cqn --policy.preset=laptop_pixels --policy.device=cpu "
                f"--dataset.repo_id=local/hex_clean --dataset.root=hex_clean {TRAIN}=hex_run",
                ends_well,
            ),
        ),
        {"by their names no positions": POSITIONS},
        "a robot that takes joint positions alone.",
    ),
    Row(
        "cqn-train",
        (
            Try(
                f"cqn-train --robot.type=earthrover_mini_plus $CQN $DATA {TRAIN}=rover_run",
                ends_well,
            ),
        ),
        {"by their names no positions": POSITIONS},
        "a robot that takes joint positions alone.",
    ),
)
